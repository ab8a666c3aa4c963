//! The robot's motion as a function of the time since the reference time.

use std::sync::Arc;

use crate::kinematics::Joints;
use crate::logs::CubicSpline;
use crate::model::{ClockRelation, JointState, RobotMotion};

/// An interpolated robot log. Its time counts from the reference time instead of from the log's first stamp.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedLog {
    log: Arc<CubicSpline<Joints>>,
    origin_s: f64,
}

impl AlignedLog {
    /// Creates the motion of `log`. The zero of its time is `origin_s` after the first stamp of the log \[s\].
    pub fn new(log: Arc<CubicSpline<Joints>>, origin_s: f64) -> Self {
        Self { log, origin_s }
    }

    /// Time from the first stamp of the log to the zero of this motion \[s\].
    pub fn origin_s(&self) -> f64 {
        self.origin_s
    }

    /// Converts a clock that a solve has estimated with this motion. The robot times of this clock count from the zero of
    /// the motion. The robot times of the returned clock count from the log's first stamp.
    pub(in crate::prepare) fn solved(&self, clock: ClockRelation) -> ClockRelation {
        ClockRelation { shift_s: self.origin_s + clock.shift_s, skew: clock.skew }
    }

    /// Whether the log has values at `tau_s`, at `tau_s - edge_s` and at `tau_s + edge_s` \[s\].
    pub(in crate::prepare) fn covers(&self, tau_s: f64, edge_s: f64) -> bool {
        [-edge_s, 0.0, edge_s].iter().all(|by_s| self.log.covers(self.origin_s + (tau_s + by_s)))
    }
}

impl RobotMotion for AlignedLog {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        let point = self.log.at(self.origin_s + tau_s)?;
        Some(JointState { q: point.value, qd: point.rate, qdd: point.acceleration })
    }
}
