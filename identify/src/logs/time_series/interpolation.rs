//! The robot's joints at any instant between its stamps.

use std::sync::Arc;

use super::spline::{CubicSpline, KNOTS_MIN, SplinePoint};
use crate::kinematics::Joints;
use crate::logs::{LogError, RobotLog};

/// Cubic spline through a robot log: joint variables and their rates at any time of the log's clock.
///
/// Never beyond the first and last stamp, and never across a hole of the log. Clones share their samples: a log of ten
/// hours takes a gigabyte.
#[derive(Debug, Clone, PartialEq)]
pub struct InterpolatedLog {
    spline: Arc<CubicSpline<Joints>>,
}

/// Longest distance of two stamps that is bridged \[s\]: 50 ms, or 3.5 periods of a slower log. A joint that swings by
/// 1 rad/s² at 1 Hz is followed through 50 ms to better than 1 urad.
pub fn default_gap_limit_s(log: &RobotLog) -> f64 {
    gap_limit_s(log.quality.period_s)
}

/// The same of values that are so far apart \[s\].
pub fn gap_limit_s(period_s: f64) -> f64 {
    (3.5 * period_s).max(0.05)
}

impl InterpolatedLog {
    /// Through all rows of `log`; stamps further apart than `gap_limit_s` are not bridged.
    ///
    /// # Errors
    /// [`LogError::NoContinuousPart`] where nothing can be interpolated.
    pub fn new(log: &RobotLog, gap_limit_s: f64) -> Result<Self, LogError> {
        CubicSpline::new(&log.t_s, &log.q_rad, gap_limit_s)
            .map(|spline| Self { spline: Arc::new(spline) })
            .ok_or(LogError::NoContinuousPart { needed: KNOTS_MIN, gap_limit_s })
    }

    /// Joint variables \[rad\] and rates \[rad/s\] at `tau_s`, seconds after the log's first stamp.
    pub fn joints(&self, tau_s: f64) -> Option<SplinePoint<Joints>> {
        self.spline.at(tau_s)
    }

    /// First and last time that the log covers \[s after its first stamp\].
    pub fn range_s(&self) -> (f64, f64) {
        self.spline.range_s()
    }
}
