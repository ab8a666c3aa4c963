//! The clock `tau = t + shift + skew t` from bar time `t` to robot time `tau`, each from its own zero: what is known in advance.

use crate::model::Clock;

/// Standard deviation of the shift that the correlation of speeds gives \[s\].
pub(in crate::prepare) const SHIFT_SIGMA_S: f64 = 0.05;
/// Standard deviation of the relative rates of the clocks of controllers and instruments.
pub(in crate::prepare) const SKEW_SIGMA: f64 = 100e-6;
/// Fits do not use samples nearer to an end of the robot's log \[s\]. A solver's step that takes a sample out of the log is
/// refused as a whole, so the fit would end where the first sample reaches the end of the log.
pub(in crate::prepare) const EDGE_S: f64 = 2.0 * SHIFT_SIGMA_S;

impl Clock {
    /// The same clock for bar times that count from `by_s` later; robot times keep their zero.
    pub(in crate::prepare) fn counted_from(&self, by_s: f64) -> Self {
        Self { shift_s: self.robot_time_s(by_s), skew: self.skew }
    }
}
