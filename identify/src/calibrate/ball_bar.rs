//! A robot from a ball-bar recording and the robot's own log.

use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::config::{CostName, IdentifyConfig};
use super::robust::{solve_from_subsets, solve_robust};
use crate::cost::{
    CostError, Length, LoopProblem, Position, PositionAngles, Residual, Transform, WhitenedPose, fill_in,
};
use crate::kinematics::{BAR_JOINTS, LinkParameter, ball_bar_chain, robot_chain};
use crate::logs::RobotLog;
use crate::model::{Axis, DriveTrain, Geometry, Model, ModelError, ParameterId};
use crate::prepare::{PrepareError, Prepared, prepare};
use crate::solver::{Options, Solution, SolveError, Summary, Unidentifiable, Watch};

/// The thesis' residuals enter as it defines them; `pose` is whitened by itself.
const UNWEIGHTED: f64 = 1.0;
/// Residuals without any error still count as this uncertain against priors \[m, m^2 or matrix entry\].
const SIGMA_MIN: f64 = 1e-9;

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// The logs do not fit together, or are not enough.
    #[error(transparent)]
    Prepare(#[from] PrepareError),
    /// A named parameter or prior does not exist.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The samples do not suit the cost.
    #[error(transparent)]
    Cost(#[from] CostError),
    /// The solve could not start.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// The samples do not determine what is free.
    #[error(transparent)]
    Unidentifiable(#[from] Unidentifiable),
    /// The solve ended elsewhere than at a minimum.
    #[error(
        "the solve did not converge ({}, {} iterations, residual RMS {:.3e}); robot, bar or log may be the wrong one, \
         or its motion too small",
        summary.termination, summary.iterations, summary.residual_rms
    )]
    NotConverged {
        /// How it went.
        summary: Summary,
    },
}

/// A calibrated robot.
#[derive(Debug, Clone)]
pub struct BallBarCalibration {
    /// Cost that was minimised.
    pub cost: CostName,
    /// How the logs were brought together.
    pub prepared: Prepared,
    /// Parameters, at the solution.
    pub model: Model,
    /// The solve.
    pub solution: Solution,
}

/// [`calibrate_watched`] with nobody looking on.
///
/// # Errors
/// As there.
pub fn calibrate(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    log: &RobotLog,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    config: &IdentifyConfig,
) -> Result<BallBarCalibration, CalibrateError> {
    calibrate_watched(cycles, encoders, log, robot, bar, config, None)
}

/// Prepares and solves.
///
/// `encoders` are those of the recording, in its order.
///
/// # Errors
/// [`CalibrateError`]: a calibration that is returned has converged and every free parameter of it is identified.
pub fn calibrate_watched(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    log: &RobotLog,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<BallBarCalibration, CalibrateError> {
    let mut prepared = prepare(cycles, encoders, log, robot, bar, &config.prepare)?;
    let cost = config.cost.unwrap_or_else(|| CostName::for_encoders(&prepared.measured));
    let mut model = start_model(&prepared, robot, bar)?;
    let solution = match cost {
        CostName::Pose => {
            let whitened = |prepared: &Prepared, geometry: &Geometry| {
                WhitenedPose::new(geometry, &prepared.motion, &prepared.observations, config.noise.into())
            };
            solve(&mut prepared, &mut model, cost, whitened, config, watch)?
        }
        CostName::Transform => solve(&mut prepared, &mut model, cost, |_, _| Transform, config, watch)?,
        CostName::PositionAngles => {
            solve(&mut prepared, &mut model, cost, |_, _| PositionAngles, config, watch)?
        }
        CostName::Position => solve(&mut prepared, &mut model, cost, |_, _| Position, config, watch)?,
        CostName::Length => solve(&mut prepared, &mut model, cost, |_, _| Length, config, watch)?,
    };
    Ok(BallBarCalibration { cost, prepared, model, solution })
}

/// Nominal robot and bar, at the place and with the encoder offsets that the preparation found.
fn start_model(prepared: &Prepared, robot: &RobotConfig, bar: &BallBarConfig) -> Result<Model, ModelError> {
    let arm = robot_chain(robot, bar);
    let mut model = Model::ball_bar(&arm, &ball_bar_chain(bar)).with_drives(DriveTrain::of(robot, &arm));
    let initial = &prepared.initial;
    for axis in Axis::ALL {
        model.set_value(ParameterId::Base(axis), initial.base_m[axis.index()])?;
    }
    for link in 0..BAR_JOINTS {
        let theta = ParameterId::Bar { link, parameter: LinkParameter::Theta };
        let nominal = model.parameter(theta).map_or(0.0, |parameter| parameter.nominal);
        model.set_value(theta, nominal + initial.btheta_rad[link])?;
    }
    model.set_value(ParameterId::ClockShift, initial.clock_shift_s)?;
    model.set_value(ParameterId::ClockSkew, initial.clock_skew)?;
    Ok(model)
}

/// Selects, solves, and leaves the model at the solution. `residual` makes the cost for a geometry.
fn solve<R: Residual>(
    prepared: &mut Prepared,
    model: &mut Model,
    cost: CostName,
    residual: impl Fn(&Prepared, &Geometry) -> R,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Solution, CalibrateError> {
    config.set_roles(model, R::tells)?;
    let loss = config.loss_for(cost);
    let options = Options { watch, ..Options::default() };
    let mut solve_once = |sigma: f64| {
        let geometry = model.geometry(&model.start());
        if !R::ENCODERS.is_empty() {
            fill_in(&geometry, &prepared.motion, &mut prepared.observations);
        }
        let residual = residual(prepared, &geometry);
        let problem = LoopProblem::new(model, &prepared.motion, &prepared.observations, residual, sigma)?;
        let solve_by = if config.ransac { solve_from_subsets } else { solve_robust };
        let mut solution = solve_by(&problem, &model.start(), loss, &options)?.identified()?;
        solution.summary.residual_rms_start *= sigma;
        solution.summary.residual_rms *= sigma;
        if !solution.summary.termination.converged() {
            return Err(CalibrateError::NotConverged { summary: solution.summary });
        }
        model.adopt(&solution.x);
        Ok(solution)
    };
    let first = solve_once(UNWEIGHTED)?;
    // Whitening, angles without encoder and the worth of a residual against priors were those of the nominal geometry;
    // now they are those of the solution.
    let sigma = if cost == CostName::Pose { UNWEIGHTED } else { first.summary.residual_rms.max(SIGMA_MIN) };
    let mut second = solve_once(sigma)?;
    second.summary.residual_rms_start = first.summary.residual_rms_start;
    Ok(second)
}
