//! Motion of the true bar and of the robot that follows.

use super::Pull;
use crate::kinematics::{BAR_JOINTS, Chain, InverseError, Joints, Pose, ROD_LINK, robot_inverse_centred};
use crate::logs::CubicSpline;
use crate::plan::Path;

/// Where the bar's joints are, whatever its links are like.
pub trait BarPath {
    /// At `t_s`, 0 to [`Self::duration_s`]; it holds still before and after \[rad\].
    fn bar_rad(&self, t_s: f64) -> [f64; BAR_JOINTS];

    /// \[s\]
    fn duration_s(&self) -> f64;
}

impl BarPath for Path {
    fn bar_rad(&self, t_s: f64) -> [f64; BAR_JOINTS] {
        self.at(t_s)
    }

    fn duration_s(&self) -> f64 {
        self.duration_s
    }
}

/// A path that was driven, through samples of it.
impl BarPath for CubicSpline<[f64; BAR_JOINTS]> {
    fn bar_rad(&self, t_s: f64) -> [f64; BAR_JOINTS] {
        self.at(t_s.clamp(0.0, self.duration_s())).map_or([0.0; BAR_JOINTS], |point| point.value)
    }

    fn duration_s(&self) -> f64 {
        self.duration_s()
    }
}

impl<P: BarPath + ?Sized> BarPath for &P {
    fn bar_rad(&self, t_s: f64) -> [f64; BAR_JOINTS] {
        (**self).bar_rad(t_s)
    }

    fn duration_s(&self) -> f64 {
        (**self).duration_s()
    }
}

/// The error-free motion of the true bar and the true robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion<P = Path> {
    /// The bar's path.
    pub path: P,
    /// The true robot.
    pub robot: Chain,
    /// The true bar on its true base.
    pub bar: Chain,
    /// Joints of the nominal robot at the start of the path \[rad\].
    pub start_rad: Joints,
    /// Of its joints \[rad, m\].
    pub limits: Vec<[f64; 2]>,
    /// What makes the bar longer and shorter; none leaves it rigid.
    pub pull: Option<Pull>,
}

impl<P: BarPath> Motion<P> {
    /// Pose of the common end frame at `t_s`.
    pub fn pose(&self, t_s: f64) -> Pose {
        let joints_rad = self.path.bar_rad(t_s);
        let Some(pull) = &self.pull else { return self.bar.forward(&joints_rad) };
        let mut bar = self.bar.clone();
        for rod in bar.links.iter_mut().skip(ROD_LINK).take(1) {
            rod.d_m += pull.extension_m(t_s, &joints_rad);
        }
        bar.forward(&joints_rad)
    }

    /// Force along the bar at `t_s`, tension positive \[N\].
    pub fn force_n(&self, t_s: f64) -> f64 {
        self.pull.as_ref().map_or(0.0, |pull| pull.force_n(t_s, &self.path.bar_rad(t_s)))
    }

    /// Joints of the true robot at `t_s` \[rad\], the solution nearest to `near_rad`; in the middle of its limits, as its path was planned,
    /// where it has more axes than it needs.
    ///
    /// # Errors
    /// Those of the inverse kinematics.
    pub fn robot_joints(&self, t_s: f64, near_rad: &[f64]) -> Result<Joints, InverseError> {
        robot_inverse_centred(&self.robot, &self.pose(t_s), near_rad, &self.limits)
    }
}
