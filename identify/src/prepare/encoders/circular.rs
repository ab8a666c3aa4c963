//! Statistics of angles that outliers do not touch.

use std::f64::consts::TAU;

/// A median deviation times this is the standard deviation of normal numbers.
const NORMAL: f64 = 1.4826;

/// The angle less whole turns, within half a turn of zero \[rad\].
pub(in crate::prepare) fn wrapped(angle_rad: f64) -> f64 {
    angle_rad - (angle_rad / TAU).round() * TAU
}

/// Median; infinite where there is nothing.
pub(in crate::prepare) fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return f64::INFINITY;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Median on the circle, about the mean direction \[rad\]; 0 where there is nothing.
pub(in crate::prepare) fn circular_median(angles_rad: &[f64]) -> f64 {
    let (sin, cos) = angles_rad.iter().fold((0.0, 0.0), |(s, c), angle| (s + angle.sin(), c + angle.cos()));
    let mean = sin.atan2(cos);
    let mut about: Vec<f64> = angles_rad.iter().map(|angle| wrapped(angle - mean)).collect();
    if about.is_empty() { 0.0 } else { wrapped(mean + median(&mut about)) }
}

/// Distance of each angle from their circular median \[rad\].
pub(in crate::prepare) fn deviations(angles_rad: Vec<f64>) -> Vec<f64> {
    let middle = circular_median(&angles_rad);
    angles_rad.into_iter().map(|angle| wrapped(angle - middle).abs()).collect()
}

/// A standard deviation from distances to a middle.
pub(in crate::prepare) fn spread_of(mut deviations: Vec<f64>) -> f64 {
    NORMAL * median(&mut deviations)
}
