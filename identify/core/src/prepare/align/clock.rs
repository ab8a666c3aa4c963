//! Bar time to robot time.

/// The correlation of speeds gives the shift this well \[s\].
pub(in crate::prepare) const SHIFT_SIGMA_S: f64 = 0.05;
/// Clocks of controllers and instruments differ by this much.
pub(in crate::prepare) const SKEW_SIGMA: f64 = 100e-6;
/// A step that takes a sample out of the robot's log is refused as a whole, and a fit ends where the first sample stands at the
/// log's end: samples that such a shift could take out do not take part \[s\].
pub(in crate::prepare) const EDGE_S: f64 = 2.0 * SHIFT_SIGMA_S;

/// Robot time against bar time: `tau = shift + (1 + skew) t`, both from their own zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockFit {
    /// Robot time, after the log's first stamp, at bar time zero \[s\].
    pub shift_s: f64,
    /// Relative rate of the robot's clock minus one.
    pub skew: f64,
}

impl ClockFit {
    /// Robot time, after the log's first stamp, at bar time `t_s` \[s\].
    pub fn tau_s(&self, t_s: f64) -> f64 {
        self.shift_s + t_s + self.skew * t_s
    }

    /// The same for bar times that count from `by_s` later.
    pub fn counted_from(&self, by_s: f64) -> Self {
        Self { shift_s: self.tau_s(by_s), skew: self.skew }
    }
}
