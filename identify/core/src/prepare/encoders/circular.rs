//! Robust statistics of angles, for the differences of predicted and measured angles (`encoder_map`, `segments`, `slip`,
//! `samples::angle_errors`).

use crate::kinematics::wrapped;
use crate::statistics::median;

/// Median on the circle, about the mean direction \[rad\]; 0 of no angles.
pub(in crate::prepare) fn circular_median(angles_rad: &[f64]) -> f64 {
    let (sin, cos) = angles_rad.iter().fold((0.0, 0.0), |(s, c), angle| (s + angle.sin(), c + angle.cos()));
    let mean = sin.atan2(cos);
    let mut about: Vec<f64> = angles_rad.iter().map(|angle| wrapped(angle - mean)).collect();
    median(&mut about).map_or(0.0, |about| wrapped(mean + about))
}

/// Distance of each angle from their circular median \[rad\].
pub(in crate::prepare) fn deviations(angles_rad: Vec<f64>) -> Vec<f64> {
    let middle = circular_median(&angles_rad);
    angles_rad.into_iter().map(|angle| wrapped(angle - middle).abs()).collect()
}

/// Robust standard deviation from the distances to a median; infinite without any.
pub(in crate::prepare) fn spread_of(mut deviations: Vec<f64>) -> f64 {
    /// A median absolute deviation times this is the standard deviation of normal numbers.
    const SIGMA_PER_MEDIAN: f64 = 1.4826;
    SIGMA_PER_MEDIAN * median(&mut deviations).unwrap_or(f64::INFINITY)
}
