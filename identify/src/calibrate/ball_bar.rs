//! A robot from a ball-bar recording and the robot's own log.

use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::config::{CostName, IdentifyConfig};
use crate::cost::{CostError, Length, LoopProblem, Position, PositionAngles, Residual, Transform, fill_in};
use crate::kinematics::{BAR_JOINTS, LinkParameter, ball_bar_chain, robot_chain};
use crate::logs::RobotLog;
use crate::model::{Axis, Model, ModelError, ParameterId, Role};
use crate::prepare::{PrepareError, Prepared, prepare};
use crate::solver::{self, Options, Solution, SolveError, Summary, Unidentifiable};

/// Residuals of `length` and `transform` enter as the thesis defines them, unweighted.
const UNWEIGHTED: f64 = 1.0;

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

/// Prepares and solves.
///
/// `encoders` are those of the recording, in its order.
///
/// # Errors
/// [`CalibrateError`]: a calibration that is returned has converged and every free parameter of it is identified.
pub fn calibrate(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    log: &RobotLog,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    config: &IdentifyConfig,
) -> Result<BallBarCalibration, CalibrateError> {
    let mut prepared = prepare(cycles, encoders, log, robot, bar, &config.prepare)?;
    let cost = config.cost.unwrap_or_else(|| CostName::for_encoders(&prepared.measured));
    let mut model = start_model(&prepared, robot, bar)?;
    let solution = match cost {
        CostName::Transform => solve(&mut prepared, &mut model, || Transform, config)?,
        CostName::PositionAngles => solve(&mut prepared, &mut model, || PositionAngles, config)?,
        CostName::Position => solve(&mut prepared, &mut model, || Position, config)?,
        CostName::Length => solve(&mut prepared, &mut model, || Length, config)?,
    };
    Ok(BallBarCalibration { cost, prepared, model, solution })
}

/// Nominal robot and bar, at the place and with the encoder offsets that the preparation found.
fn start_model(prepared: &Prepared, robot: &RobotConfig, bar: &BallBarConfig) -> Result<Model, ModelError> {
    let mut model = Model::ball_bar(&robot_chain(robot, bar), &ball_bar_chain(bar));
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

/// Selects, solves, and leaves the model at the solution.
fn solve<R: Residual>(
    prepared: &mut Prepared,
    model: &mut Model,
    residual: impl Fn() -> R,
    config: &IdentifyConfig,
) -> Result<Solution, CalibrateError> {
    model.select(config.selection.into(), R::tells)?;
    for (names, role) in [(&config.free, Role::Free), (&config.fix, Role::Fixed)] {
        for name in names {
            model.set_role(name.parse()?, role)?;
        }
    }
    let solution = solve_once(prepared, model, residual())?;
    if R::ENCODERS.is_empty() || !prepared.measured.contains(&false) {
        return Ok(solution);
    }
    // Angles without encoder were those of the nominal geometry; now they are those of the solution.
    solve_once(prepared, model, residual())
}

fn solve_once<R: Residual>(
    prepared: &mut Prepared,
    model: &mut Model,
    residual: R,
) -> Result<Solution, CalibrateError> {
    if !R::ENCODERS.is_empty() {
        fill_in(&model.geometry(&model.start()), &prepared.motion, &mut prepared.observations);
    }
    let problem = LoopProblem::new(model, &prepared.motion, &prepared.observations, residual, UNWEIGHTED)?;
    let solution = solver::solve(&problem, &model.start(), &Options::default())?.identified()?;
    if !solution.summary.termination.converged() {
        return Err(CalibrateError::NotConverged { summary: solution.summary });
    }
    model.adopt(&solution.x);
    Ok(solution)
}
