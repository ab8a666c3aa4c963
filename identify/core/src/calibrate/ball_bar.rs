//! A robot from a ball-bar recording and the robot's own log.

use std::collections::BTreeSet;

use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::calibration::Calibration;
use super::change;
use super::config::{IdentifyConfig, SelectionName};
use super::error::CalibrateError;
use super::pipeline::{Plan, Solved, estimate};
use super::selection::structure::identifiable;
use crate::instrument::{BallBar, CostName, Run};
use crate::kinematics::{BAR_JOINTS, LinkParameter, ball_bar_chain, robot_chain};
use crate::logs::{RobotLog, Unwrapped};
use crate::model::{Axis, DriveTrain, Group, Model, ModelError, Parameter, ParameterId, Role};
use crate::prepare::{Prepared, prepare};
use crate::solver::Watch;

/// Bar joints whose encoder all runs have.
pub(super) fn measured<'p>(runs: impl Iterator<Item = &'p Prepared>) -> [bool; BAR_JOINTS] {
    runs.fold([true; BAR_JOINTS], |all, run| std::array::from_fn(|joint| all[joint] && run.measured[joint]))
}

/// What one run left behind.
#[derive(Debug, Clone, Copy)]
pub struct RunInput<'a> {
    /// Of the recording.
    pub cycles: &'a [CycleRecord],
    /// Encoders of the recording, in its order.
    pub encoders: &'a [EncoderInfo],
    /// What the reader of the recording has unwrapped itself: its records then show what no counter showed.
    pub unwrapped: Option<&'a [Unwrapped]>,
    /// The robot's own log.
    pub log: &'a RobotLog,
    /// The bar of this run: bars of several runs may differ in length.
    pub bar: &'a BallBarConfig,
}

/// Prepares and solves one run.
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
) -> Result<Calibration, CalibrateError> {
    calibrate_runs(&[RunInput { cycles, encoders, unwrapped: None, log, bar }], robot, config, None)
}

/// Prepares each run and solves all in one: they share the robot and the bar's links, each has its own clock, place of the
/// bar, encoder offsets and, where it differs, length. `watch` sees each solve and may end it.
///
/// # Errors
/// As [`calibrate`].
pub fn calibrate_runs(
    inputs: &[RunInput<'_>],
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    solved(prepared_runs(inputs, robot, config)?, config, watch)
}

/// The same from samples that are prepared already, each of a bar.
///
/// # Errors
/// As [`calibrate`].
pub fn calibrate_prepared(
    prepared: Vec<(Prepared, &BallBarConfig)>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    solved(runs_at_start(prepared, robot, config)?, config, watch)
}

fn solved(
    mut runs: Vec<Run>,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    let cost = runs.iter().find_map(|run| run.instrument.in_unit_of()).ok_or(CalibrateError::NoRun)?;
    let solved = solve(&mut runs, config, watch)?;
    let changed = change::checked(&runs, &solved.sigmas, &config.prepare)?;
    Ok(Calibration { runs, rows: Vec::new(), solved, changed, loss: config.loss_for(cost) })
}

/// Each run with its logs brought together and its parameters where the preparation found them.
///
/// # Errors
/// [`CalibrateError`].
pub(super) fn prepared_runs<'a>(
    inputs: &[RunInput<'a>],
    robot: &RobotConfig,
    config: &IdentifyConfig,
) -> Result<Vec<Run>, CalibrateError> {
    let prepare = |(run, input): (usize, &RunInput<'a>)| {
        let mut prepared =
            prepare(input.cycles, input.encoders, input.log, robot, input.bar, &config.prepare)
                .map_err(|error| CalibrateError::Prepare { run, error: Box::new(error) })?;
        if let Some(unwrapped) = input.unwrapped {
            prepared.timeline.unwrapped_encoders = unwrapped.to_vec();
        }
        Ok((prepared, input.bar))
    };
    let all = inputs.iter().enumerate().map(prepare).collect::<Result<Vec<_>, CalibrateError>>()?;
    runs_at_start(all, robot, config)
}

fn runs_at_start(
    all: Vec<(Prepared, &BallBarConfig)>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
) -> Result<Vec<Run>, CalibrateError> {
    let measured = measured(all.iter().map(|(prepared, _)| prepared));
    let cost = config.cost.unwrap_or_else(|| CostName::for_encoders(&measured));
    let run = |(prepared, bar): (Prepared, &BallBarConfig)| {
        // Hundreds of waves have a name: a model has those that somebody means, and later those that are found.
        let named = config.named().filter(|id| matches!(id, ParameterId::JointWave { .. }));
        let model = start_model(&prepared, robot, bar)?.with(named);
        let known_m = config.known_lengths_m(bar, model.axes());
        let bar = BallBar { prepared, cost, configured: config.noise, found: None, measured, known_m };
        Ok(Run { instrument: bar.into(), model })
    };
    all.into_iter().map(run).collect()
}

/// Gives the parameters of runs with the ball-bar their roles and estimates them.
///
/// # Errors
/// [`CalibrateError`].
pub(super) fn solve(
    runs: &mut [Run],
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Solved, CalibrateError> {
    let first = runs.first().ok_or(CalibrateError::NoRun)?;
    let cost = first.instrument.in_unit_of().ok_or(CalibrateError::NoRun)?;
    config.require_known(runs.iter().map(|run| &run.model))?;
    let free = match (config.selection.fixed(), first.instrument.prepared()) {
        (None, Some(Prepared { motion, observations, measured, .. })) => {
            identifiable(&first.model, motion, observations, cost.unweighed(measured))?
        }
        _ => Vec::new(),
    };
    set_roles(runs, config, &free)?;
    let Some(Run { instrument, model }) = runs.first() else { return Err(CalibrateError::NoRun) };
    let groups = config.groups(model, |id| instrument.identifies(id));
    let plan = Plan {
        loss: config.loss_for(cost),
        groups,
        fix: config.fixed(),
        tolerances: tolerances(runs, config),
        alike: config.alike().collect(),
        watch,
    };
    estimate(runs, &plan)
}

/// Gives the parameters of runs with the ball-bar their roles; `identifiable` is the set of a selection that depends on the poses.
///
/// # Errors
/// [`ModelError`].
pub(super) fn set_roles(
    runs: &mut [Run],
    config: &IdentifyConfig,
    identifiable: &[ParameterId],
) -> Result<(), ModelError> {
    let mut held = config.fixed();
    let plate = runs.first().map(|run| ParameterId::plate(run.model.axes()));
    held.extend(plate.filter(|_| config.selection == SelectionName::Thesis));
    for Run { instrument, model } in &mut *runs {
        config.set_roles(model, identifiable, |id| instrument.identifies(id))?;
        instrument.place(model, &held)?;
        if let Some(force) = instrument.prepared().and_then(|prepared| prepared.force.as_ref()) {
            config.free_for_force(model, force.parameter())?;
        }
    }
    Ok(())
}

/// Numbers of links whose tolerances are widened where samples ask for it: what a person stated stays as it is.
pub(super) fn tolerances(runs: &[Run], config: &IdentifyConfig) -> Vec<ParameterId> {
    let known = ParameterId::known_lengths(runs.first().map_or(0, |run| run.model.axes()));
    let has_tolerance = |one: &&Parameter| {
        let is_link = matches!(one.id.group(), Group::Link | Group::InPlaceOfAnother);
        let is_stated = known.contains(&one.id) || config.priors.contains_key(&one.id.to_string());
        is_link && matches!(one.role, Role::Prior { .. }) && !is_stated
    };
    let of_runs = runs.iter().flat_map(|run| run.model.columns());
    let ids: BTreeSet<ParameterId> = of_runs.filter(has_tolerance).map(|one| one.id).collect();
    ids.into_iter().collect()
}

/// Nominal robot and bar, at the place and with the encoder offsets that the preparation found.
fn start_model(prepared: &Prepared, robot: &RobotConfig, bar: &BallBarConfig) -> Result<Model, ModelError> {
    let arm = robot_chain(robot, bar);
    let mut model = Model::ball_bar(&arm, &ball_bar_chain(bar))
        .with_drives(DriveTrain::of(robot, &arm))
        .with(changed_offsets(prepared));
    let initial = &prepared.initial;
    for axis in Axis::ALL {
        model.set_value(ParameterId::Base { axis }, initial.base_m[axis.index()])?;
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

/// Encoders whose counters lost their origin, with samples left since.
fn changed_offsets(prepared: &Prepared) -> impl Iterator<Item = ParameterId> {
    let has_samples = |number: usize| prepared.observations.iter().any(|one| one.origin == number);
    let spans = prepared.origins.iter().filter(move |span| {
        (1..=ParameterId::LAST_ORIGIN).contains(&span.number) && has_samples(span.number)
    });
    spans.flat_map(|span| {
        let changed = (0..BAR_JOINTS).filter(|joint| span.shift_rad[*joint] != 0.0);
        changed.map(|joint| ParameterId::EncoderOffset { origin: span.number, joint })
    })
}
