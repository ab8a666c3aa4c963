//! The robot's motion at times since the reference time.

use std::sync::Arc;

use crate::kinematics::Joints;
use crate::logs::CubicSpline;
use crate::model::{Clock, JointState, RobotMotion};

/// An interpolated robot log whose time begins at the reference time instead of at its first stamp.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedLog {
    log: Arc<CubicSpline<Joints>>,
    origin_s: f64,
}

impl AlignedLog {
    /// `log` with its zero moved to `origin_s` after the first stamp.
    pub fn new(log: Arc<CubicSpline<Joints>>, origin_s: f64) -> Self {
        Self { log, origin_s }
    }

    /// Time of the log's zero after its first stamp \[s\].
    pub fn origin_s(&self) -> f64 {
        self.origin_s
    }

    /// The clock that a solve on this motion has found, with robot times after the log's first stamp.
    pub(in crate::prepare) fn solved(&self, clock: Clock) -> Clock {
        Clock { shift_s: self.origin_s + clock.shift_s, skew: clock.skew }
    }

    /// Whether the log has values at `tau_s` and `edge_s` to either side \[s\].
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
