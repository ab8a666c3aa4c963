//! The nominal robot with a bar fitted to it. It is the reference for the improvement by a calibration.

use std::array;

use crate::cost::{Length, LoopProblem, Position, Residual, Transform};
use crate::kinematics::{BAR_JOINTS, LinkParameter};
use crate::model::{Geometry, Model, Observation, Owner, ParameterId, RobotMotion};
use crate::solver::{Options, minimise};

/// Relative tolerance of the cost. Because the cost is a sum of squares, a root mean square changes by half of this.
const COST_TOLERANCE: f64 = 1e-6;

/// Geometry of the uncalibrated robot: the robot is reset to nominal, and the bar's base and encoder offsets are
/// fitted to this robot.
///
/// Without the fit, all errors of the robot would appear as a displacement of the bar. If the fit fails, the
/// bar stays as calibrated.
pub fn uncalibrated(model: &Model, motion: &impl RobotMotion, observations: &[Observation]) -> Geometry {
    let mut nominal = model.clone();
    nominal.reset_to_nominal(|id| id.owner() == Owner::Robot);
    bar_fitted(nominal, motion, observations)
}

/// Geometry with the model's robot unchanged, and the bar's base and encoder offsets fitted to this robot. If
/// the fit fails, the bar stays unchanged as well.
pub(super) fn bar_fitted(
    mut model: Model,
    motion: &impl RobotMotion,
    observations: &[Observation],
) -> Geometry {
    let measured: [bool; BAR_JOINTS] =
        array::from_fn(|joint| observations.iter().all(|observation| observation.measured[joint]));
    let (measures_end, all_encoders) = (measured[0] && measured[1], measured == [true; BAR_JOINTS]);
    let is_fitted = |id: ParameterId| match id {
        ParameterId::Base { .. } | ParameterId::BaseRotation { .. } => true,
        ParameterId::Bar { link, parameter } => {
            // The first offset is the bar's rotation about z. Offsets of the first two joints need both encoders, the
            // others all five.
            parameter == LinkParameter::Theta && (all_encoders || measures_end && link < 2)
        }
        _ => false,
    };
    model.free_only(is_fitted);
    let x = if all_encoders {
        fit(&model, motion, observations, Transform)
    } else if measures_end {
        fit(&model, motion, observations, Position)
    } else {
        fit(&model, motion, observations, Length)
    };
    if let Some(x) = x {
        model.adopt(&x);
    }
    model.geometry(&model.start())
}

fn fit<R: Residual>(
    model: &Model,
    motion: &impl RobotMotion,
    observations: &[Observation],
    residual: R,
) -> Option<Vec<f64>> {
    let problem = LoopProblem::new(model, motion, observations, residual, 1.0).ok()?;
    let options = Options { cost_tolerance: COST_TOLERANCE, ..Options::default() };
    let (x, reached) = minimise(&problem, &model.start(), &options).ok()?;
    reached.termination.converged().then_some(x)
}
