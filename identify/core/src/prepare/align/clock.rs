//! Prior knowledge about the clock `tau = t + shift + skew t`. The clock converts bar time `t` to robot time `tau`. Each of
//! the two times counts from its own zero.

use crate::model::ClockRelation;

/// Standard deviation of the shift that the correlation of speeds finds \[s\].
pub(in crate::prepare) const SHIFT_SIGMA_S: f64 = 0.05;
/// Standard deviation of the relative rate between the clocks of controllers and instruments.
pub(in crate::prepare) const SKEW_SIGMA: f64 = 100e-6;
/// Fits do not use samples nearer than this to an end of the robot's log \[s\]. The solver refuses a whole step if the step
/// moves a single sample out of the log. With samples near an end, a fit would therefore stop before its minimum, as soon as
/// one sample reaches the end of the log.
pub(in crate::prepare) const EDGE_S: f64 = 2.0 * SHIFT_SIGMA_S;

impl ClockRelation {
    /// Returns the same clock for bar times whose zero is `by_s` later. The zero of robot times does not change.
    pub(in crate::prepare) fn counted_from(&self, by_s: f64) -> Self {
        Self { shift_s: self.robot_time_s(by_s), skew: self.skew }
    }
}
