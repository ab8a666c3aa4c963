//! A calibrated robot on rows of another day: only tracker and probe are found anew.

use super::{PoseError, PoseFigures, ROWS_MIN, check_rows, placed};
use crate::calibrate::split;
use crate::instrument::{Apart, PoseRow, Standing, Tracker, standing};
use crate::kinematics::Chain;
use crate::model::{Model, ParameterId, Role};

/// Parts of the rows, each judged by a place that the others gave.
const FOLDS: usize = 5;

/// Figures of other rows with the nominal and with a calibrated robot.
///
/// The tracker stands elsewhere and the probe was mounted again, so these twelve numbers are found from four fifths of the
/// rows and the errors taken on the last fifth, in turn. Nothing of the robot is changed.
///
/// # Errors
/// [`PoseError`] for rows that allow no place of tracker and probe.
pub fn validate(
    rows: &[PoseRow],
    robot: &Chain,
    calibrated: &Model,
    seed: u64,
) -> Result<[PoseFigures; 2], PoseError> {
    check_rows(rows)?;
    let mut robot_only = calibrated.clone();
    let ids: Vec<ParameterId> = robot_only.parameters().iter().map(|parameter| parameter.id).collect();
    robot_only.set_roles(ids, Role::Fixed)?;
    Ok([judged(rows, &Model::measured_pose(robot), seed)?, judged(rows, &robot_only, seed)?])
}

fn judged(rows: &[PoseRow], robot: &Model, seed: u64) -> Result<PoseFigures, PoseError> {
    let all: Vec<usize> = (0..rows.len()).collect();
    let tracker =
        Tracker::new(Standing::new(rows, &standing(rows.iter().map(|row| row.joints_rad)), &all, seed));
    let mut errors: Vec<Apart> = Vec::new();
    for judged in split::folds(&all, &all, FOLDS, seed, |_| 0) {
        let fitting: Vec<usize> = all.iter().copied().filter(|row| !judged.contains(row)).collect();
        if fitting.len() < ROWS_MIN {
            return Err(PoseError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
        }
        let model = placed(&tracker.chosen(&fitting), robot.clone(), &[])?;
        let found = tracker.apart(&model.geometry(&[]));
        errors.extend(judged.iter().filter_map(|&row| found.get(row)));
    }
    Ok(PoseFigures::of(&errors))
}
