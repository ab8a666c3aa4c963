//! Motion of the true bar and of the robot that follows.

use super::Pull;
use crate::kinematics::{Chain, InverseError, Joints, Pose, ROD_LINK, robot_inverse};
use crate::plan::Path;

/// The error-free motion of the true bar and the true robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// The bar's path.
    pub path: Path,
    /// The true robot.
    pub robot: Chain,
    /// The true bar on its true base.
    pub bar: Chain,
    /// Joints of the nominal robot at the start of the path \[rad\].
    pub start_rad: Joints,
    /// What makes the bar longer and shorter; none leaves it rigid.
    pub pull: Option<Pull>,
}

impl Motion {
    /// Pose of the common end frame at `t_s`.
    pub fn pose(&self, t_s: f64) -> Pose {
        let joints_rad = self.path.at(t_s);
        let Some(pull) = &self.pull else { return self.bar.forward(&joints_rad) };
        let mut bar = self.bar.clone();
        for rod in bar.links.iter_mut().skip(ROD_LINK).take(1) {
            rod.d_m += pull.extension_m(t_s, &joints_rad);
        }
        bar.forward(&joints_rad)
    }

    /// Force along the bar at `t_s`, tension positive \[N\].
    pub fn force_n(&self, t_s: f64) -> f64 {
        self.pull.as_ref().map_or(0.0, |pull| pull.force_n(t_s, &self.path.at(t_s)))
    }

    /// Joints of the true robot at `t_s` \[rad\], the solution nearest to `near_rad`.
    ///
    /// # Errors
    /// Those of the inverse kinematics.
    pub fn robot_joints(&self, t_s: f64, near_rad: &[f64]) -> Result<Joints, InverseError> {
        robot_inverse(&self.robot, &self.pose(t_s), near_rad)
    }
}
