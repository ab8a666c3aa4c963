//! Motion of the true bar, and of the true robot, which follows the bar. The robot's force on the bar changes the bar's
//! length (TFRT-6017 section 5.3).

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::kinematics::{BAR_JOINTS, Chain, InverseError, Joints, Pose, ROD_LINK, robot_inverse_centred};
use crate::logs::CubicSpline;
use crate::plan::Path;

/// A path of the bar's joints over time. It does not depend on the bar's links.
pub trait BarPath {
    /// Joints of the bar at `t_s` \[rad\]. The bar is at rest before 0 and after [`Self::duration_s`].
    fn bar_rad(&self, t_s: f64) -> [f64; BAR_JOINTS];

    /// Duration of the path \[s\].
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

/// A recorded path, interpolated between its samples.
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
    /// Chain of the true robot.
    pub robot: Chain,
    /// Chain of the true bar on its true base.
    pub bar: Chain,
    /// Joints of the nominal robot at the start of the path \[rad\].
    pub start_rad: Joints,
    /// Limits of the robot's joints \[rad, m\].
    pub limits: Vec<[f64; 2]>,
    /// Force along the bar, which changes its length; `None` for a rigid bar.
    pub pull: Option<PathLoad>,
}

impl<P: BarPath> Motion<P> {
    /// Pose of the end frame that robot and bar share, at `t_s`.
    pub fn pose(&self, t_s: f64) -> Pose {
        let joints_rad = self.path.bar_rad(t_s);
        let Some(pull) = &self.pull else { return self.bar.forward(&joints_rad) };
        let mut bar = self.bar.clone();
        if let Some(rod) = bar.links.get_mut(ROD_LINK) {
            rod.d_m += pull.extension_m(t_s, &joints_rad);
        }
        bar.forward(&joints_rad)
    }

    /// Force along the bar at `t_s`, tension positive \[N\].
    pub fn force_n(&self, t_s: f64) -> f64 {
        self.pull.as_ref().map_or(0.0, |pull| pull.force_n(t_s, &self.path.bar_rad(t_s)))
    }

    /// Joints of the true robot at `t_s` \[rad, m\]: the solution nearest to `near_rad`. If the arm has more axes than a
    /// pose needs, the solution nearest to the middle of the limits is used instead, as in planning.
    ///
    /// # Errors
    /// The errors of the inverse kinematics.
    pub fn robot_joints(&self, t_s: f64, near_rad: &[f64]) -> Result<Joints, InverseError> {
        robot_inverse_centred(&self.robot, &self.pose(t_s), near_rad, &self.limits)
    }
}

/// Size of the force of the robot on the bar, and its effect on the bar's length.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BarLoad {
    /// Largest force along the bar \[N\]; about 150 in the thesis. If zero, the bar is rigid, and the log does
    /// not contain a force.
    pub force_n: f64,
    /// Elongation of the bar per newton of tension \[um/N\]. The thesis computes 0.055 and measures 0.17.
    pub compliance_um_per_n: f64,
    /// Half of the play of the bar's joints \[um\]. The bar is longer by this value under any tension, and
    /// shorter under any compression.
    pub play_um: f64,
    /// Standard deviation of the white noise of the force in the log \[N\].
    pub noise_n: f64,
}

impl BarLoad {
    /// All four values with their keys.
    pub(super) fn sizes(&self) -> [(&'static str, f64); 4] {
        [
            ("force_n", self.force_n),
            ("compliance_um_per_n", self.compliance_um_per_n),
            ("play_um", self.play_um),
            ("noise_n", self.noise_n),
        ]
    }
}

/// Fraction of the force that depends on the posture, like a force due to errors of the robot's geometry. The remaining
/// force depends on time, like a force due to following errors of the drives.
const BY_POSTURE: f64 = 0.6;
/// Period of the force that depends on time \[s\].
const PERIOD_S: f64 = 7.3;

/// The force on the bar as a function of posture and time, with random phases.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathLoad {
    load: BarLoad,
    phases: [f64; 3],
}

impl PathLoad {
    pub(super) fn new(load: BarLoad, random: &mut ChaCha8Rng) -> Option<Self> {
        let phases = std::array::from_fn(|_| random.random_range(0.0..TAU));
        (load.force_n > 0.0).then_some(Self { load, phases })
    }

    /// Force along the bar at time `t_s` and the bar's joints `joints_rad`, tension positive \[N\].
    pub fn force_n(&self, t_s: f64, joints_rad: &[f64; 5]) -> f64 {
        let [a, b, c] = self.phases;
        let posture = 0.5 * ((2.0 * joints_rad[0] + a).sin() + (3.0 * joints_rad[1] + b).sin());
        let following = (TAU * t_s / PERIOD_S + c).sin();
        self.load.force_n * (BY_POSTURE * posture + (1.0 - BY_POSTURE) * following)
    }

    /// Elongation of the bar due to the force \[m\].
    pub fn extension_m(&self, t_s: f64, joints_rad: &[f64; 5]) -> f64 {
        let force_n = self.force_n(t_s, joints_rad);
        1e-6 * (self.load.compliance_um_per_n * force_n + self.load.play_um * force_n.signum())
    }
}
