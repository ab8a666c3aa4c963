//! Robust statistics of angles. They are used for the differences between predicted and measured angles
//! (`encoder_map`, `segments`, `slip`, `samples::angle_errors`).

use crate::kinematics::wrapped;
use crate::statistics::median;

/// Median of angles on the circle, relative to the mean direction \[rad\]; 0 without angles.
pub(in crate::prepare) fn circular_median(angles_rad: &[f64]) -> f64 {
    let (sin, cos) = angles_rad.iter().fold((0.0, 0.0), |(s, c), angle| (s + angle.sin(), c + angle.cos()));
    let mean = sin.atan2(cos);
    let mut about: Vec<f64> = angles_rad.iter().map(|angle| wrapped(angle - mean)).collect();
    median(&mut about).map_or(0.0, |about| wrapped(mean + about))
}

/// Distance of each angle from the circular median of all \[rad\].
pub(in crate::prepare) fn deviations(angles_rad: Vec<f64>) -> Vec<f64> {
    let middle = circular_median(&angles_rad);
    angles_rad.into_iter().map(|angle| wrapped(angle - middle).abs()).collect()
}

/// Robust standard deviation, computed from the distances to a median; infinite without distances.
pub(in crate::prepare) fn spread_of(mut deviations: Vec<f64>) -> f64 {
    /// Ratio of the standard deviation to the median absolute deviation, for a normal distribution.
    const SIGMA_PER_MEDIAN: f64 = 1.4826;
    SIGMA_PER_MEDIAN * median(&mut deviations).unwrap_or(f64::INFINITY)
}
