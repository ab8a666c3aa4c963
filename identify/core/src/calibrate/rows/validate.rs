//! Validation of a calibrated robot with rows that were not used in its calibration.

use shared::config::RobotConfig;

use super::likely::placed;
use super::{PARTS, PoseFigures, rows_min};
use crate::calibrate::CalibrateError;
use crate::instrument::{HoldOut, Instrument, PoseError, RowError, Rows, gross_rows};
use crate::kinematics::flange_chain;
use crate::model::Model;

/// Errors of the nominal and of the calibrated robot for validation rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Validated {
    /// Statistics with the nominal robot, then with the calibrated one.
    pub figures: [PoseFigures; 2],
    /// Rows that are outliers for both robots. They are excluded from the statistics.
    pub gross: Vec<usize>,
}

/// Compares validation rows with the nominal and with a calibrated robot. `calibrated` must be a model for a file of rows.
/// `data_set` is the number (from 1) of the data set with the same instrument, for messages.
///
/// The link parameters of the robot are not changed, but the instrument has a new pose and mounting. These are estimated
/// from four fifths of the rows, and the errors of the last fifth are computed. This is repeated for each fifth.
///
/// # Errors
/// [`CalibrateError`] if there are too few rows, or if they do not determine the pose of the instrument.
pub fn validate(
    instrument: &Instrument,
    data_set: usize,
    robot: &RobotConfig,
    calibrated: &Model,
    seed: u64,
) -> Result<Validated, CalibrateError> {
    let rows_error = |error| CalibrateError::Rows { data_set, error };
    let nominal = flange_chain(robot);
    instrument.contradicting(&nominal).map_err(rows_error)?;
    let (rows, needed) = (instrument.samples(), rows_min(instrument));
    if rows < needed {
        return Err(rows_error(RowError::TooFewRows { rows, needed }));
    }
    let mut robot_only = calibrated.clone();
    robot_only.free_only(|_| false);
    let rows = Rows { hold_out: Some(HoldOut::Rows), seed: Some(seed), ..instrument.clone().into() };
    let instrument = rows.grouped(&nominal);
    let predicted_by =
        |robot: &Model| predicted(&instrument, robot)?.ok_or(CalibrateError::NoPlace { data_set });
    let errors = [predicted_by(&Model::alone(&nominal))?, predicted_by(&robot_only)?];
    let is_gross = gross_rows(&errors[0], &errors[1], &instrument.relative_noise());
    let (gross, kept): (Vec<usize>, Vec<usize>) = (0..is_gross.len()).partition(|row| is_gross[*row]);
    let figures = errors.map(|errors| PoseFigures::from_errors(kept.iter().map(|row| errors[*row])));
    Ok(Validated { figures, gross })
}

/// Errors of each row for a robot. The pose of the instrument is estimated from the parts of
/// the file that do not contain the row. `None` if these parts do not determine the pose.
fn predicted(instrument: &Instrument, robot: &Model) -> Result<Option<Vec<PoseError>>, CalibrateError> {
    let mut errors = vec![PoseError::default(); instrument.samples()];
    for left_out in instrument.independent(PARTS) {
        let fitting: Vec<usize> = (0..instrument.samples()).filter(|row| !left_out.contains(row)).collect();
        let Some(model) = placed(instrument.part(&fitting), robot.clone())? else { return Ok(None) };
        let all = instrument.errors(&model.geometry(&[]));
        left_out.iter().for_each(|&row| errors[row] = all[row]);
    }
    Ok(Some(errors))
}
