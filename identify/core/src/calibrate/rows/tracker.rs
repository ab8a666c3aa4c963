//! Poses with a position or a whole pose measured at each: a tracker and its probe on the flange.

use shared::config::RobotConfig;

use super::{PoseFigures, RowError, each_has_rows};
use crate::calibrate::CalibrateError;
use crate::calibrate::pipeline::{Plan, estimate};
use crate::instrument::split;
use crate::instrument::{Instrument, Measures, PoseError, PoseRow, Run, Standing, Tracker, poses, standing};
use crate::kinematics::{Joints, flange_chain};
use crate::model::Model;
use crate::solver::LossName;

/// Fewest rows of a fit: as many numbers as tracker, probe and links together, twice.
pub const ROWS_MIN: usize = 20;
/// Of each station, where there are several: its six numbers twice, and a part is held out.
const STATION_ROWS_MIN: usize = 5;
/// Of each target.
const TARGET_ROWS_MIN: usize = 3;

pub(super) fn check_rows(rows: &[PoseRow]) -> Result<(), RowError> {
    for (index, row) in rows.iter().enumerate() {
        let rotation = row.rotation.iter().flat_map(|rotation| rotation.matrix().iter());
        let mut numbers = row.joints_rad.iter().chain(row.position_m.iter()).chain(rotation);
        if !numbers.all(|number| number.is_finite()) {
            return Err(RowError::BadRow { row: index + 1, what: "a number that is not finite" });
        }
    }
    each_has_rows(
        rows.iter().map(|row| row.set_up),
        [("station", STATION_ROWS_MIN), ("target", TARGET_ROWS_MIN)],
    )
}

/// The model with tracker and probe where they are for its robot, which stays.
pub(super) fn placed(tracker: &Tracker, model: Model) -> Result<Model, CalibrateError> {
    let mut model = tracker.fitted_out(model);
    if !tracker.place(&mut model, &[])? {
        return Err(CalibrateError::NoPlace { data_set: 1 });
    }
    let mut runs = [Run { instrument: Instrument::Tracker(tracker.clone()), model }];
    estimate(&mut runs, &Plan::new(LossName::Huber, Vec::new()))?;
    let [Run { model, .. }] = runs;
    Ok(model)
}

/// Parts of the rows, each judged by a place that the others gave.
const FOLDS: usize = 5;

/// Figures of other rows with the nominal and with a calibrated robot, whose model is that of a tracker.
///
/// The tracker stands elsewhere and the probe was mounted again, so these twelve numbers are found from four fifths of the
/// rows and the errors taken on the last fifth, in turn. Nothing of the robot is changed.
///
/// # Errors
/// [`CalibrateError`] for rows that allow no place of tracker and probe.
pub fn validate(
    rows: &[PoseRow],
    robot: &RobotConfig,
    calibrated: &Model,
    seed: u64,
) -> Result<[PoseFigures; 2], CalibrateError> {
    let bad = |error| CalibrateError::Rows { data_set: 1, error };
    check_rows(rows).map_err(bad)?;
    let needed = ROWS_MIN * FOLDS / (FOLDS - 1);
    if rows.len() < needed {
        return Err(bad(RowError::TooFewRows { rows: rows.len(), needed }));
    }
    let mut robot_only = calibrated.clone();
    robot_only.free_only(|_| false);
    Ok([judged(rows, &Model::measured_pose(&flange_chain(robot)), seed)?, judged(rows, &robot_only, seed)?])
}

fn judged(rows: &[PoseRow], robot: &Model, seed: u64) -> Result<PoseFigures, CalibrateError> {
    let all: Vec<usize> = (0..rows.len()).collect();
    let joints_rad: Vec<Joints> = rows.iter().map(|row| row.joints_rad).collect();
    let poses = poses(&joints_rad);
    let tracker = Tracker::new(Standing::new(rows, &standing(joints_rad.into_iter()), &poses, seed));
    let mut errors: Vec<PoseError> = Vec::new();
    for judged in split::folds(&poses, &all, FOLDS, seed, |row| rows[row].set_up.station) {
        let fitting: Vec<usize> = all.iter().copied().filter(|row| !judged.contains(row)).collect();
        let model = placed(&tracker.chosen(&fitting), robot.clone())?;
        let found = tracker.errors(&model.geometry(&[]));
        errors.extend(judged.iter().filter_map(|&row| found.get(row)));
    }
    Ok(PoseFigures::of(&errors))
}
