//! Motion of the bar's joints, smooth to the second derivative, and of the robot that follows.

use super::Pull;
use crate::kinematics::{Chain, InverseError, Joints, Pose, ROD_LINK, robot_inverse};

/// One move from point to point along the minimum-jerk profile `10 u^3 - 15 u^4 + 6 u^5`: speed and acceleration are
/// zero at both ends (Flash and Hogan 1985).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// When it begins \[s\].
    pub start_s: f64,
    /// How long it takes \[s\].
    pub duration_s: f64,
    /// By how much each joint moves \[rad\].
    pub by_rad: [f64; 5],
    /// Bar joints when all moves before it are over \[rad\].
    pub from_rad: [f64; 5],
}

impl Move {
    /// Peak of the profile's speed over its mean.
    pub(super) const PEAK_SPEED: f64 = 1.875;

    /// When it ends \[s\].
    pub fn end_s(&self) -> f64 {
        self.start_s + self.duration_s
    }

    /// Bar joints when it and all moves before it are over \[rad\].
    pub(super) fn end_rad(&self) -> [f64; 5] {
        std::array::from_fn(|joint| self.from_rad[joint] + self.by_rad[joint])
    }

    fn progress(&self, t_s: f64) -> f64 {
        let u = ((t_s - self.start_s) / self.duration_s).clamp(0.0, 1.0);
        u * u * u * (10.0 + u * (6.0 * u - 15.0))
    }
}

/// A start and moves that are added up: where two overlap in time the corner between them is rounded.
#[derive(Debug, Clone, PartialEq)]
pub struct Path {
    /// Bar joints before the first move \[rad\].
    pub start_rad: [f64; 5],
    /// In the order of their beginning; at most neighbours overlap.
    pub moves: Vec<Move>,
    /// Length of the recording that is taken of it \[s\]; the path holds still before 0 and after its last move.
    pub duration_s: f64,
}

impl Path {
    /// Bar joints at `t_s` \[rad\].
    pub fn at(&self, t_s: f64) -> [f64; 5] {
        let begun = self.moves.partition_point(|step| step.start_s <= t_s);
        // All but the last two are over: a path of ten hours costs as little as one of two minutes.
        let going_on = self.moves.get(begun.saturating_sub(2)..begun).unwrap_or_default();
        let mut joints = going_on.first().map_or(self.start_rad, |step| step.from_rad);
        for step in going_on {
            let progress = step.progress(t_s);
            for (joint, by) in joints.iter_mut().zip(step.by_rad) {
                *joint += progress * by;
            }
        }
        joints
    }
}

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
