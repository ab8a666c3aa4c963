//! Calibration from poses with a position or a whole pose measured at each: a tracker and its probe on the flange.

use shared::config::RobotConfig;

use super::implausible::{self, likely_of_all, reasons, step};
use super::{PoseFigures, RowCalibration, RowError, RowErrors, RowOptions};
use crate::calibrate::ball_bar::CalibrateError;
use crate::calibrate::change::changes;
use crate::calibrate::deployment::{Deployment, deployed, fitted};
use crate::calibrate::pipeline::{Plan, Solved, estimate, refit};
use crate::calibrate::split::{self, Split};
use crate::instrument::{Apart, Instrument, Measures, PoseRow, Run, Standing, Tracker, standing};
use crate::kinematics::{Chain, flange_chain};
use crate::model::{DriveTrain, Model, ParameterId, Role};
use crate::solver::LossName;

/// Fewest rows of a fit: as many numbers as tracker, probe and links together, twice.
pub const ROWS_MIN: usize = 20;

pub(super) fn check_rows(rows: &[PoseRow]) -> Result<(), RowError> {
    for (index, row) in rows.iter().enumerate() {
        let rotation = row.rotation.iter().flat_map(|rotation| rotation.matrix().iter());
        let mut numbers = row.joints_rad.iter().chain(row.position_m.iter()).chain(rotation);
        if !numbers.all(|number| number.is_finite()) {
            return Err(RowError::BadRow { row: index + 1, what: "a number that is not finite" });
        }
    }
    Ok(())
}

/// The model with tracker and probe where they are for its robot, which stays.
pub(super) fn placed(tracker: &Tracker, mut model: Model, fix: &[ParameterId]) -> Result<Model, RowError> {
    if !tracker.place(&mut model, fix)? {
        return Err(RowError::PosesOnALine);
    }
    let mut runs = [Run { instrument: Instrument::Tracker(tracker.clone()), model }];
    estimate(&mut runs, &Plan::new(LossName::Huber, Vec::new()))?;
    let [Run { model, .. }] = runs;
    Ok(model)
}

/// Calibrates a robot from poses measured by a tracker; rows in the order in which the robot went there.
///
/// # Errors
/// [`RowError`] for rows, options or geometry that allow no calibration.
pub fn calibrate(
    rows: &[PoseRow],
    robot: &RobotConfig,
    options: &RowOptions,
) -> Result<RowCalibration, RowError> {
    check_rows(rows)?;
    options.check()?;
    let chain = &flange_chain(robot);
    let joints = || rows.iter().map(|row| row.joints_rad);
    let (groups, states) = (options.hold_out.groups(chain, joints()), standing(joints()));
    let Split { fitting, held_out } = split::split(&groups, options.held_out, options.seed);
    if fitting.len() < ROWS_MIN {
        return Err(RowError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
    }
    let mut model = Model::measured_pose(chain).with_drives(DriveTrain::of(robot, chain));
    let kinds = options.kinds(&model, options.waves_per_turn_max)?;
    let all = Tracker::new(Standing::new(rows, &states, &groups, options.seed));
    let chosen = all.chosen(&fitting);
    let placed = placed(&chosen, model, &options.fix);
    model = placed.map_err(|error| explained(error, rows, chain))?;
    let explained = |error: CalibrateError| explained(error.into(), rows, chain);
    let nominal = all.apart(&model.geometry(&[]));
    let nominal_step = step(&all, &model);
    options.free_links(&mut model, chain)?;
    if options.joint_errors {
        model = model.with_joint_waves(ParameterId::joint_waves(options.waves_per_turn_max));
    }
    let mut runs = [Run { instrument: Instrument::Tracker(chosen), model }];
    let estimated = estimate(&mut runs, &Plan::new(options.loss, kinds));
    let Solved { without_terms, candidates, .. } = estimated.map_err(explained)?;
    let apart = |model: Option<&Model>| model.map_or_else(Vec::new, |model| all.apart(&model.geometry(&[])));
    let offsets = fitted(&runs, Deployment::Offsets, options.loss).map_err(explained)?;
    let offsets = apart(offsets.as_ref().and_then(|found| Some(&found.runs.first()?.model)));
    let links = apart(without_terms.first());
    let [Run { model, .. }] = runs;
    let joints = apart(Some(&model));
    let steps = [step(&all, &model), nominal_step];
    // What was held out has judged: now it takes part.
    let mut runs = [Run { instrument: Instrument::Tracker(all), model }];
    let (_, solution, sigmas) = refit(&mut runs, options.loss).map_err(explained)?;
    let deployed = deployed(&runs, options.loss).map_err(explained)?;
    let changed = changes(&runs, &sigmas).map_err(explained)?;
    let [Run { instrument, model }] = runs;
    let Instrument::Tracker(tracker) = instrument else { return Err(CalibrateError::NoRun.into()) };
    let found = RowCalibration {
        cost: tracker.cost(),
        errors: RowErrors { stages: [nominal, offsets, links, joints], fitted: fitting, held_out },
        rejected: Vec::new(),
        runs: Vec::new(),
        drift: None,
        terms: candidates,
        sigma_m: tracker.noise.position_m * sigmas.first().copied().unwrap_or(1.0),
        solution,
        model,
        changed,
        deployed,
    };
    let step = steps.into_iter().flatten().find(|step| step.explains(rows, chain));
    let reasons = reasons(&found, step, chain, options);
    implausible::unless(found, &reasons, || likely_of_all(rows, chain))
}

/// A solve that failed, with the mistake that explains it, where one does.
fn explained(error: RowError, rows: &[PoseRow], robot: &Chain) -> RowError {
    let RowError::Calibrate(error) = error else { return error };
    match likely_of_all(rows, robot) {
        Some(likely) => RowError::Implausible { found: error.to_string(), likely: Some(likely) },
        None => error.into(),
    }
}

/// Parts of the rows, each judged by a place that the others gave.
const FOLDS: usize = 5;

/// Figures of other rows with the nominal and with a calibrated robot.
///
/// The tracker stands elsewhere and the probe was mounted again, so these twelve numbers are found from four fifths of the
/// rows and the errors taken on the last fifth, in turn. Nothing of the robot is changed.
///
/// # Errors
/// [`RowError`] for rows that allow no place of tracker and probe.
pub fn validate(
    rows: &[PoseRow],
    robot: &RobotConfig,
    calibrated: &Model,
    seed: u64,
) -> Result<[PoseFigures; 2], RowError> {
    check_rows(rows)?;
    let mut robot_only = calibrated.clone();
    let ids: Vec<ParameterId> = robot_only.parameters().iter().map(|parameter| parameter.id).collect();
    robot_only.set_roles(ids, Role::Fixed)?;
    Ok([judged(rows, &Model::measured_pose(&flange_chain(robot)), seed)?, judged(rows, &robot_only, seed)?])
}

fn judged(rows: &[PoseRow], robot: &Model, seed: u64) -> Result<PoseFigures, RowError> {
    let all: Vec<usize> = (0..rows.len()).collect();
    let tracker =
        Tracker::new(Standing::new(rows, &standing(rows.iter().map(|row| row.joints_rad)), &all, seed));
    let mut errors: Vec<Apart> = Vec::new();
    for judged in split::folds(&all, &all, FOLDS, seed, |_| 0) {
        let fitting: Vec<usize> = all.iter().copied().filter(|row| !judged.contains(row)).collect();
        if fitting.len() < ROWS_MIN {
            return Err(RowError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
        }
        let model = placed(&tracker.chosen(&fitting), robot.clone(), &[])?;
        let found = tracker.apart(&model.geometry(&[]));
        errors.extend(judged.iter().filter_map(|&row| found.get(row)));
    }
    Ok(PoseFigures::of(&errors))
}
