//! A robot from a ball-bar recording and the robot's own log.

use std::collections::BTreeSet;

use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::change::{self, Changed};
use super::config::{CostName, IdentifyConfig, SelectionName};
use super::pipeline::{Plan, Solved, estimate};
use super::rows::{Likely, RowError};
use super::selection::structure::{StructureError, identifiable};
use super::selection::terms::Candidate;
use crate::cost::{CostError, SharedColumns};
use crate::instrument::{BallBar, Instrument, Run};
use crate::kinematics::{BAR_JOINTS, Joints, LinkParameter, ball_bar_chain, robot_chain};
use crate::logs::{RobotLog, Unwrapped};
use crate::model::{Axis, DriveTrain, Group, Model, ModelError, Parameter, ParameterId, Role};
use crate::prepare::{PrepareError, Prepared, prepare};
use crate::solver::{NotConverged, Solution, SolveError, Unidentifiable, Watch};

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// The logs do not fit together, or are not enough.
    #[error("{error}")]
    Prepare {
        /// Which run, from 0.
        run: usize,
        /// What is wrong with it.
        error: Box<PrepareError>,
    },
    /// A named parameter or prior does not exist.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The samples do not suit the cost.
    #[error(transparent)]
    Cost(#[from] CostError),
    /// The solve could not start.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// What the samples determine cannot be found.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// Nothing was given.
    #[error("there is no run to calibrate from; give at least one recording with its robot log")]
    NoRun,
    /// An option that a mix of instruments cannot follow.
    #[error(
        "option `{option}` is for the ball-bar alone; leave it out, or calibrate from runs with the ball-bar only"
    )]
    Mixed {
        /// In the configuration.
        option: &'static str,
    },
    /// An option that has no effect on rows.
    #[error("option `{option}` is for runs with the ball-bar, and there are none; leave it out")]
    NoEffect {
        /// In the configuration.
        option: &'static str,
    },
    /// Where an instrument stands does not follow from its rows.
    #[error(
        "data set {data_set}: where the instrument stands does not follow from its rows, which lie in a plane, on a line or \
         in a point; measure poses further apart"
    )]
    NoPlace {
        /// From 1: ball-bars, trackers, wires, contacts, each in their order.
        data_set: usize,
    },
    /// A tracker's log and the robot's do not fit together.
    #[error("data set {data_set}: {error}")]
    Align {
        /// From 1: ball-bars, trackers, wires, contacts, each in their order.
        data_set: usize,
        /// What is wrong with them.
        error: Box<PrepareError>,
    },
    /// Rows that calibrate no robot.
    #[error("data set {data_set}: {error}")]
    Rows {
        /// From 1: ball-bars, trackers, wires, contacts, each in their order.
        data_set: usize,
        /// What is wrong with it.
        error: RowError,
    },
    /// No robot like the configured one gives such rows.
    #[error("{found}; {}", .likely.map_or_else(
        || "rows, their mapping, the table of sockets or the robot's file are wrong; see `identify inspect --propose`".to_owned(),
        |likely| format!("most likely {likely}; mend the mapping or the robot's file"),
    ))]
    Implausible {
        /// What gave it away.
        found: String,
        /// What went wrong.
        likely: Option<Likely>,
    },
    /// The samples do not determine what is free.
    #[error(transparent)]
    Unidentifiable(#[from] Unidentifiable),
    /// The solve ended elsewhere than at a minimum.
    #[error(transparent)]
    NotConverged(#[from] NotConverged),
}

/// A calibrated robot.
#[derive(Debug, Clone)]
pub struct BallBarCalibration {
    /// Cost that was minimised.
    pub cost: CostName,
    /// What was measured in the first run.
    pub instrument: Instrument,
    /// Parameters of robot and first run, at the solution. Their columns come first in `solution`.
    pub model: Model,
    /// The other runs; the robot is that of `model`.
    pub others: Vec<Run>,
    /// Which columns of the solution are whose.
    pub columns: SharedColumns,
    /// The solve of all runs.
    pub solution: Solution,
    /// Kinds of terms that were tried, and what became of them.
    pub candidates: Vec<Candidate>,
    /// Tolerances of the links were multiplied by this.
    pub prior_scale: f64,
    /// What a residual of each run is worth against priors, one standard deviation.
    pub sigmas: Vec<f64>,
    /// What did not stay during a run, but so little that it is not refused.
    pub changed: Vec<Changed>,
}

impl BallBarCalibration {
    /// Preparation and parameters of each run, the first one first.
    pub fn runs(&self) -> impl Iterator<Item = (&Prepared, &Model)> {
        self.instruments().filter_map(|(instrument, model)| Some((&instrument.bar()?.prepared, model)))
    }

    /// Runs with a ball-bar, the first one first.
    pub fn bars(&self) -> impl Iterator<Item = &BallBar> {
        self.instruments().filter_map(|(instrument, _)| instrument.bar())
    }

    /// How the logs of the first run with a ball-bar were brought together; none without any.
    pub fn prepared(&self) -> Option<&Prepared> {
        self.runs().next().map(|(prepared, _)| prepared)
    }

    /// Bar joints with an encoder in every run.
    pub fn measured(&self) -> [bool; BAR_JOINTS] {
        measured(self.runs().map(|(prepared, _)| prepared))
    }

    /// What the robot reports at each sample of all runs.
    pub fn poses(&self) -> impl Iterator<Item = Joints> {
        self.instruments().flat_map(|(instrument, model)| instrument.poses(model))
    }

    /// Copies of the runs with at most so many samples in all, evenly taken: for figures that need no more.
    pub(super) fn thinned(&self, samples_max: usize) -> Vec<Run> {
        let samples: usize = self.instruments().map(|(instrument, _)| instrument.samples()).sum();
        let every = samples.div_ceil(samples_max.max(1)).max(1);
        let thinned = |(instrument, model): (&Instrument, &Model)| Run {
            instrument: instrument.part(&(0..instrument.samples()).step_by(every).collect::<Vec<_>>()),
            model: model.clone(),
        };
        self.instruments().map(thinned).collect()
    }

    /// Copies of the runs.
    pub(crate) fn all_runs(&self) -> Vec<Run> {
        let run = |(instrument, model): (&Instrument, &Model)| Run {
            instrument: instrument.clone(),
            model: model.clone(),
        };
        self.instruments().map(run).collect()
    }

    fn instruments(&self) -> impl Iterator<Item = (&Instrument, &Model)> {
        let others = self.others.iter().map(|run| (&run.instrument, &run.model));
        std::iter::once((&self.instrument, &self.model)).chain(others)
    }
}

/// Bar joints whose encoder all runs have.
fn measured<'p>(runs: impl Iterator<Item = &'p Prepared>) -> [bool; BAR_JOINTS] {
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
) -> Result<BallBarCalibration, CalibrateError> {
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
) -> Result<BallBarCalibration, CalibrateError> {
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
) -> Result<BallBarCalibration, CalibrateError> {
    solved(runs_at_start(prepared, robot, config)?, config, watch)
}

fn solved(
    mut runs: Vec<Run>,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<BallBarCalibration, CalibrateError> {
    let cost = runs.first().and_then(|run| run.instrument.bar()).ok_or(CalibrateError::NoRun)?.cost;
    let Solved { columns, solution, candidates, prior_scale, sigmas, .. } = solve(&mut runs, config, watch)?;
    let changed = change::checked(&runs, &sigmas, &config.prepare)?;
    let mut runs = runs.into_iter();
    let Run { instrument, model } = runs.next().ok_or(CalibrateError::NoRun)?;
    let others = runs.collect();
    Ok(BallBarCalibration {
        cost,
        instrument,
        model,
        others,
        columns,
        solution,
        candidates,
        prior_scale,
        sigmas,
        changed,
    })
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
        let known_m = config.known_lengths_m(bar);
        let bar = BallBar { prepared, cost, configured: config.noise, found: None, measured, known_m };
        Ok(Run { instrument: Instrument::BallBar(Box::new(bar)), model })
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
    let BallBar { prepared, cost, measured, .. } = first.instrument.bar().ok_or(CalibrateError::NoRun)?;
    let (cost, measured) = (*cost, *measured);
    config.require_known(runs.iter().map(|run| &run.model))?;
    let free = match config.selection.fixed() {
        Some(_) => Vec::new(),
        None => {
            let Prepared { motion, observations, .. } = prepared;
            identifiable(&first.model, motion, observations, cost.unweighed(&measured))?
        }
    };
    set_roles(runs, config, &free)?;
    let Some(Run { instrument, model }) = runs.first() else { return Err(CalibrateError::NoRun) };
    let groups = config.groups(model, |id| instrument.identifies(id));
    let plan = Plan {
        loss: config.loss_for(cost),
        ransac: config.ransac,
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
    held.extend((config.selection == SelectionName::Thesis).then_some(ParameterId::PLATE));
    for Run { instrument, model } in &mut *runs {
        config.set_roles(model, identifiable, |id| instrument.identifies(id))?;
        instrument.place(model, &held)?;
        if let Some(force) = instrument.bar().and_then(|bar| bar.prepared.force.as_ref()) {
            config.free_for_force(model, force.parameter())?;
        }
    }
    Ok(())
}

/// Numbers of links whose tolerances are widened where samples ask for it: what a person stated stays as it is.
pub(super) fn tolerances(runs: &[Run], config: &IdentifyConfig) -> Vec<ParameterId> {
    let has_tolerance = |one: &&Parameter| {
        let is_link = matches!(one.id.group(), Group::Link | Group::InPlaceOfAnother);
        let is_stated =
            ParameterId::KNOWN_LENGTHS.contains(&one.id) || config.priors.contains_key(&one.id.to_string());
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
