//! The robot's motion seen from the reference time.

use std::sync::Arc;

use crate::kinematics::Joints;
use crate::logs::CubicSpline;
use crate::model::{JointState, RobotMotion};

/// An interpolated robot log whose time begins at the reference time instead of at its first stamp.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedLog {
    log: Arc<CubicSpline<Joints>>,
    origin_s: f64,
}

impl AlignedLog {
    /// `log` with its time `origin_s` (after the first stamp) called zero.
    pub fn new(log: Arc<CubicSpline<Joints>>, origin_s: f64) -> Self {
        Self { log, origin_s }
    }

    /// The log's time, after its first stamp, that is called zero \[s\].
    pub fn origin_s(&self) -> f64 {
        self.origin_s
    }
}

impl RobotMotion for AlignedLog {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        let point = self.log.at(self.origin_s + tau_s)?;
        Some(JointState { q: point.value, qd: point.rate, qdd: point.acceleration })
    }
}
