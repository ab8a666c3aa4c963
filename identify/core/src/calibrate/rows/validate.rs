//! A calibrated robot on rows of another file, which it was not calibrated from.

use shared::config::RobotConfig;

use super::PoseFigures;
use super::likely::placed;
use crate::calibrate::CalibrateError;
use crate::instrument::{HoldOut, Instrument, PoseError, RowError, Rows, gross_rows};
use crate::kinematics::flange_chain;
use crate::model::Model;

/// Parts of the rows, each predicted with the instrument placed by the others.
const FOLDS: usize = 5;

/// What other rows say of a calibrated robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Validated {
    /// With the nominal and with the calibrated robot.
    pub figures: [PoseFigures; 2],
    /// Rows that neither robot comes near: no measurements, and not in the figures.
    pub gross: Vec<usize>,
}

/// Compares other rows with the nominal and with a calibrated robot, whose model is that of a file of rows.
///
/// The instrument stands elsewhere and was mounted again, so its own numbers are found from four fifths of the rows and the errors
/// taken on the last fifth, in turn. Nothing of the robot is changed.
///
/// # Errors
/// [`CalibrateError`] for rows that allow no place of the instrument.
pub fn validate(
    instrument: &Instrument,
    robot: &RobotConfig,
    calibrated: &Model,
    seed: u64,
) -> Result<Validated, CalibrateError> {
    let bad = |error| CalibrateError::Rows { data_set: 1, error };
    let nominal = flange_chain(robot);
    instrument.contradicting(&nominal).map_err(bad)?;
    let (rows, needed) = (instrument.samples(), instrument.samples_min() * FOLDS / (FOLDS - 1));
    if rows < needed {
        return Err(bad(RowError::TooFewRows { rows, needed }));
    }
    let mut robot_only = calibrated.clone();
    robot_only.free_only(|_| false);
    let rows = Rows { hold_out: Some(HoldOut::Rows), seed: Some(seed), ..instrument.clone().into() };
    let instrument = rows.grouped(&nominal);
    let errors = [predicted(&instrument, &Model::alone(&nominal))?, predicted(&instrument, &robot_only)?];
    let is_gross = gross_rows(&errors[0], &errors[1], &instrument.relative_noise());
    let (gross, kept): (Vec<usize>, Vec<usize>) = (0..is_gross.len()).partition(|row| is_gross[*row]);
    let figures =
        errors.map(|errors| PoseFigures::of(&kept.iter().map(|row| errors[*row]).collect::<Vec<_>>()));
    Ok(Validated { figures, gross })
}

/// The error of each row with a robot, the instrument placed by other rows.
fn predicted(instrument: &Instrument, robot: &Model) -> Result<Vec<PoseError>, CalibrateError> {
    let mut errors = vec![PoseError::default(); instrument.samples()];
    for left_out in instrument.independent(FOLDS) {
        let fitting: Vec<usize> = (0..instrument.samples()).filter(|row| !left_out.contains(row)).collect();
        let model = placed(instrument.part(&fitting), robot.clone())?;
        let model = model.ok_or(CalibrateError::NoPlace { data_set: 1 })?;
        let found = instrument.errors(&model.geometry(&[]));
        left_out.iter().for_each(|&row| errors[row] = found[row]);
    }
    Ok(errors)
}
