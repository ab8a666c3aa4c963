//! Any mix of instruments on one robot, in one solve: they share the robot, and each data set counts as much as what its own
//! residuals show it to be worth.

use shared::config::RobotConfig;

use super::IdentifyConfig;
use super::ball_bar::{CalibrateError, RunInput, prepared_runs, solve};
use super::config::SelectionName;
use super::links::{free_links, link_ids};
use super::measured_pose::{self, WAVES_PER_TURN_MAX};
use super::pipeline::{Plan, Solved, estimate};
use super::split::HoldOut;
use crate::instrument::{Instrument, LengthRow, PoseRow, Run, Standing, Tracker, Wire};
use crate::kinematics::{Chain, flange_chain};
use crate::model::{DriveTrain, Model, ModelError, ParameterId, Phase, Role};
use crate::solver::{LossName, Watch};

/// Decides which groups of rows come together where nobody says so.
const SEED: u64 = 1;

/// What was measured on one robot.
#[derive(Debug, Clone, Default)]
pub struct DataSets<'a> {
    /// Runs with the ball-bar.
    pub bars: Vec<RunInput<'a>>,
    /// Files of trackers.
    pub trackers: Vec<Rows<'a, PoseRow>>,
    /// Files of draw-wires or telescoping bars.
    pub wires: Vec<Rows<'a, LengthRow>>,
}

/// Rows of one set-up, in the order in which the robot went there.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a, R> {
    /// The rows.
    pub rows: &'a [R],
    /// Which are left out together; none: those of a region where there are poses, of a part of the file where lengths.
    pub hold_out: Option<HoldOut>,
    /// Decides which groups come together.
    pub seed: Option<u64>,
}

impl<'a, R> From<&'a [R]> for Rows<'a, R> {
    fn from(rows: &'a [R]) -> Self {
        Self { rows, hold_out: None, seed: None }
    }
}

/// A robot calibrated from a mix.
#[derive(Debug, Clone)]
pub struct MixedCalibration {
    /// Data sets with their parameters at the solution: ball-bars, trackers, wires, each in their order.
    pub runs: Vec<Run>,
    /// The solve of all.
    pub solved: Solved,
}

/// Options of the ball-bar alone that a mix cannot follow.
///
/// # Errors
/// [`CalibrateError::Mixed`] names one that was given.
fn check(config: &IdentifyConfig) -> Result<(), CalibrateError> {
    let given = [
        ("selection", config.selection != SelectionName::default()),
        ("free", !config.free.is_empty()),
        ("priors", !config.priors.is_empty()),
        ("ransac", config.ransac),
    ];
    match given.into_iter().find(|(_, given)| *given) {
        Some((option, _)) => Err(CalibrateError::Mixed { option }),
        None => Ok(()),
    }
}

/// Estimates the robot from all data sets together, each number of its links expected at nominal within the configured
/// tolerance, which is scaled until left-out groups of samples are predicted best; runs with the ball-bar alone as
/// [`super::ball_bar::calibrate_runs`] does. `watch` sees each solve and may end it.
///
/// # Errors
/// [`CalibrateError`].
pub fn calibrate(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<MixedCalibration, CalibrateError> {
    if data.trackers.is_empty() && data.wires.is_empty() {
        let mut runs = prepared_runs(&data.bars, robot, config)?;
        let solved = solve(&mut runs, config, watch)?;
        return Ok(MixedCalibration { runs, solved });
    }
    check(config)?;
    let fix = config.fix.iter().map(|name| name.parse()).collect::<Result<Vec<ParameterId>, ModelError>>()?;
    let flange = flange_chain(robot);
    let mut runs = prepared_runs(&data.bars, robot, config)?;
    for Run { instrument, model } in &mut runs {
        let named = IdentifyConfig { fix: Vec::new(), ..config.clone() };
        named.set_roles(model, &[], |id| instrument.tells(id))?;
        if let Some(force) = instrument.bar().and_then(|bar| bar.prepared.force.as_ref()) {
            config.free_for_force(model, force.parameter())?;
        }
    }
    let bars = runs.len();
    runs.extend(data.trackers.iter().map(|Rows { rows, hold_out, seed }| {
        let (hold_out, seed) = (hold_out.unwrap_or(HoldOut::Regions), seed.unwrap_or(SEED));
        let at = Standing::of_file(rows, |row| row.joints_rad, &flange, hold_out, seed);
        let instrument = Instrument::Tracker(Tracker::new(at));
        Run { instrument, model: Model::measured_pose(&flange).with_drives(DriveTrain::of(robot, &flange)) }
    }));
    runs.extend(data.wires.iter().map(|Rows { rows, hold_out, seed }| {
        let (hold_out, seed) = (hold_out.unwrap_or(HoldOut::Blocks), seed.unwrap_or(SEED));
        let at = Standing::of_file(rows, |row| row.joints_rad, &flange, hold_out, seed);
        let instrument = Instrument::Wire(Wire::new(at));
        Run { instrument, model: Model::measured_length(&flange).with_drives(DriveTrain::of(robot, &flange)) }
    }));
    for (number, Run { instrument, model }) in runs.iter_mut().enumerate() {
        if !instrument.place(model, &fix)? {
            return Err(CalibrateError::NoPlace { data_set: number + 1 });
        }
        free_robot(model, &flange, &fix, config.tolerance_mm_mrad * 1e-3)?;
    }
    known_somewhere(&runs, &fix)?;
    let kinds = if bars > 0 {
        let Run { instrument, model } = &runs[0];
        config.kinds(model, |id| instrument.tells(id))
    } else {
        let last = waves_per_turn(&runs, flange.links.len())?;
        for run in &mut runs {
            run.model = run.model.clone().with_joint_waves(ParameterId::joint_waves(last));
        }
        let known = |id: &ParameterId| runs.iter().any(|run| run.model.parameter(*id).is_some());
        measured_pose::kinds(last, |id| known(id) && !fix.contains(id))
    };
    let plan = Plan {
        loss: config.loss.unwrap_or(LossName::Huber),
        ransac: false,
        kinds,
        fix,
        tolerances: link_ids(&flange),
        prepare: config.prepare.clone(),
        watch,
    };
    let solved = estimate(&mut runs, &plan)?;
    Ok(MixedCalibration { runs, solved })
}

/// Highest order of the joints' waves that is tried: no left-out group could support more than one wave's number for four
/// measured ones of each axis.
fn waves_per_turn(runs: &[Run], axes: usize) -> Result<u8, CalibrateError> {
    const MEASURED_PER_WAVE: usize = 4;
    let measured =
        |run: &Run| Ok(run.instrument.samples() * run.instrument.data_set(&run.model, 1.0)?.rows());
    let measured: usize = runs.iter().map(measured).sum::<Result<_, CalibrateError>>()?;
    let orders = measured / (MEASURED_PER_WAVE * Phase::ALL.len() * axes.max(1));
    Ok(u8::try_from(orders).unwrap_or(u8::MAX).min(WAVES_PER_TURN_MAX))
}

/// The same numbers of the robot's links are free in every model; those of the last one belong to what is mounted there.
fn free_robot(model: &mut Model, flange: &Chain, fix: &[ParameterId], sigma: f64) -> Result<(), ModelError> {
    let last = flange.links.len().saturating_sub(1);
    let all: Vec<ParameterId> = model.parameters().iter().map(|parameter| parameter.id).collect();
    let of_links = |id: &ParameterId| matches!(id, ParameterId::Robot { link, .. } if *link < last);
    model.set_roles(all.into_iter().filter(|id| of_links(id) || fix.contains(id)), Role::Fixed)?;
    free_links(model, &link_ids(flange), fix, [sigma, sigma])
}

/// Every parameter that is fixed by name belongs to some data set.
fn known_somewhere(runs: &[Run], fix: &[ParameterId]) -> Result<(), ModelError> {
    let is_known = |id: &ParameterId| {
        matches!(id, ParameterId::JointWave { .. })
            || runs.iter().any(|run| run.model.parameter(*id).is_some())
    };
    fix.iter().find(|id| !is_known(id)).map_or(Ok(()), |id| Err(ModelError::NotInModel { id: *id }))
}
