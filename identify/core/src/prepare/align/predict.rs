//! Predicts bar joints from the robot's log with nominal geometry.

use nalgebra::{Translation3, Vector3};

use crate::kinematics::{
    BAR_JOINTS, Chain, Configuration, DhLink, InverseError, Joints, Trace, Tracer, first_ball_bar_inverse,
    singularity_margin_rad,
};
use crate::logs::CubicSpline;

/// The bar at one instant, predicted from the robot's log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedBar {
    /// Joints in the first configuration, each in (-pi, pi] \[rad\]; [`Configuration::carry`] converts them
    /// to the other configurations.
    pub joints_rad: [f64; BAR_JOINTS],
    /// Distance from the bar's nearest singular pose \[rad\].
    pub margin_rad: f64,
}

impl PredictedBar {
    /// Configuration of all predictions.
    pub const CONFIGURATION: Configuration = Configuration::ALL[0];
}

/// Predicts the bar with the nominal robot and the nominal bar. The position of the base was found from the robot's positions.
#[derive(Debug, Clone)]
pub struct Predictor<'a> {
    log: &'a CubicSpline<Joints>,
    robot: Tracer,
    bar: Chain,
}

impl<'a> Predictor<'a> {
    /// Creates a predictor for `log` with the nominal chains. The bar is upright at `base_m`.
    ///
    /// # Errors
    /// [`InverseError`] if `bar` does not have the structure of a ball-bar.
    pub fn new(
        log: &'a CubicSpline<Joints>,
        robot: &Chain,
        bar: &Chain,
        base_m: Vector3<f64>,
    ) -> Result<Self, InverseError> {
        let bar = Chain::new(Translation3::from(base_m).into(), bar.links.clone());
        // Checks the structure of the bar at an arbitrary pose. With a valid structure, predictions at other poses do not fail.
        first_ball_bar_inverse(&bar, &bar.forward(&[0.1; BAR_JOINTS]))?;
        Ok(Self { log, robot: Tracer::new(robot), bar })
    }

    /// Links of the nominal bar.
    pub fn bar_links(&self) -> &[DhLink] {
        &self.bar.links
    }

    /// Position of the bar's base \[m\].
    pub fn base_m(&self) -> Vector3<f64> {
        self.bar.root_from_base.translation.vector
    }

    /// The bar at `tau_s`, the time since the log's first stamp \[s\]; `None` outside the log.
    pub fn at(&self, tau_s: f64) -> Option<PredictedBar> {
        let joints = self.log.at(tau_s)?;
        let mut trace = Trace::default();
        self.robot.trace(&joints.value, &mut trace);
        let joints_rad = first_ball_bar_inverse(&self.bar, trace.end()).ok()?;
        let margin_rad = singularity_margin_rad(&self.bar.links, &joints_rad);
        Some(PredictedBar { joints_rad, margin_rad })
    }

    /// The robot's joints at `tau_s`, the time since the log's first stamp \[rad\]; `None` outside the log.
    pub fn robot_at(&self, tau_s: f64) -> Option<Joints> {
        self.log.at(tau_s).map(|joints| joints.value)
    }
}
