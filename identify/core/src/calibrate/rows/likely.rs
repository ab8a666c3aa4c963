//! Finds the mistake that explains why rows do not fit the nominal robot. Each possible mistake is corrected in the rows,
//! the pose of the instrument is estimated again, and the errors before and after are compared. Used when a calibration is
//! refused, and by `identify inspect`.

use std::fmt;

use super::PoseFigures;
use crate::calibrate::CalibrateError;
use crate::calibrate::pipeline::{Plan, estimate};
use crate::instrument::{Instrument, Mistake, PoseError, Rows, Run};
use crate::kinematics::Chain;
use crate::model::Model;
use crate::solver::LossName;
use crate::statistics::{mean, median_size, rms};

/// A mistake whose correction makes the rows fit the nominal robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Likely {
    /// The mistake that explains the rows.
    pub mistake: Mistake,
    /// Error of the nominal robot for the rows as read \[m\]. It is a root mean square, or a median if the mistake is the
    /// unit of lengths. Infinite if the rows as read do not determine the pose of the instrument.
    pub as_read_m: f64,
    /// Error after correction of the mistake \[m\].
    pub undone_m: f64,
}

impl fmt::Display for Likely {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { mistake, as_read_m, undone_m } = self;
        write!(
            f,
            "{mistake}: with this corrected the nominal robot is {:.1} mm from the rows",
            undone_m * 1e3
        )?;
        if as_read_m.is_finite() { write!(f, ", without {:.1} mm", as_read_m * 1e3) } else { Ok(()) }
    }
}

/// Estimates the pose of an instrument for a robot, which is not changed. `None` if the rows do not determine the pose.
pub(super) fn placed(instrument: Instrument, model: Model) -> Result<Option<Model>, CalibrateError> {
    let model = instrument.fitted_out(model);
    let mut run = Run { instrument, model };
    if !run.instrument.place(&mut run.model, &[])? {
        return Ok(None);
    }
    estimate(std::slice::from_mut(&mut run), &Plan::new(LossName::Huber))?;
    Ok(Some(run.model))
}

/// Root mean square errors of a robot for samples. The pose of the instrument is estimated from the same samples. `None`
/// if they do not determine this pose.
pub fn misfit(instrument: &Instrument, robot: &Chain) -> Option<PoseError> {
    instrument.contradicting(robot).ok().filter(|_| instrument.samples() >= instrument.samples_min())?;
    let model = placed(instrument.clone(), Model::alone(robot)).ok()??;
    Some(PoseFigures::from_errors(instrument.errors(&model.geometry(&[]))).rms())
}

/// Thins the samples evenly. Few samples are sufficient to compare robots and mistakes,
/// because a mistake affects all samples.
pub fn some_of(instrument: &Instrument) -> Instrument {
    const TRIED: usize = 60;
    let (samples, wanted) = (instrument.samples(), TRIED.max(instrument.samples_min()));
    let every = (samples / wanted).max(1);
    instrument.part(&(0..samples).step_by(every).collect::<Vec<_>>())
}

/// Root mean square error of a robot at the end of a tool, for a thinned set of the samples \[m\].
fn misfit_m(instrument: &Instrument, robot: &Chain) -> Option<f64> {
    /// Length of the tool, which converts orientation errors to positions \[m\].
    const TOOL_M: f64 = 0.1;
    let PoseError { position_m, rotation_rad } = misfit(&some_of(instrument), robot)?;
    Some(position_m.hypot(TOOL_M * rotation_rad.unwrap_or(0.0)))
}

/// Error of the nominal robot after correction of the mistake \[m\]. `None` if the samples do not
/// determine the pose of the instrument.
fn corrected_misfit_m(mistake: Mistake, instrument: &Instrument, robot: &Chain) -> Option<f64> {
    match mistake {
        Mistake::Moved(row) => {
            // Estimate the pose of the instrument separately for the samples before and after the displacement.
            let count = instrument.samples();
            let sum_of_squares = |samples: std::ops::Range<usize>| {
                let (rows, samples) = (samples.len() as f64, samples.collect::<Vec<_>>());
                Some(misfit_m(&instrument.part(&samples), robot)?.powi(2) * rows)
            };
            let row = row.min(count);
            Some(((sum_of_squares(0..row)? + sum_of_squares(row..count)?) / count as f64).sqrt())
        }
        Mistake::ModifiedTable => {
            // A table of modified DH parameters lists `a` and `alpha` of a link in the row of the next link.
            let mut read = robot.clone();
            let next = robot.links.iter().skip(1).map(|link| (link.a_m, link.alpha_rad));
            for (link, (a_m, alpha_rad)) in read.links.iter_mut().zip(next.chain([(0.0, 0.0)])) {
                (link.a_m, link.alpha_rad) = (a_m, alpha_rad);
            }
            misfit_m(instrument, &read)
        }
        _ => {
            let corrected = instrument.undone(mistake, robot);
            corrected.iter().filter_map(|rows| misfit_m(rows, robot)).min_by(f64::total_cmp)
        }
    }
}

/// If the error of the nominal robot is less than this, the rows contain no mistake \[m\].
const NEAR_M: f64 = 0.05;

/// Finds the mistake whose correction makes the samples fit the nominal robot best. `None` if no correction is sufficient.
pub fn likely(instrument: &Instrument, robot: &Chain, mistakes: &[Mistake]) -> Option<Likely> {
    /// A correction must reduce the error to less than this fraction. Errors of a robot are millimetres,
    /// errors due to mistakes are centimetres.
    const REMAINING_MAX: f64 = 0.3;
    // If the rows as read do not determine the pose of the instrument, any correction that determines it is an improvement.
    let as_read_m = misfit_m(instrument, robot).unwrap_or(f64::INFINITY);
    let corrected = |&mistake: &Mistake| {
        Some(Likely { mistake, as_read_m, undone_m: corrected_misfit_m(mistake, instrument, robot)? })
    };
    // A correction that makes lengths shorter also makes errors smaller, even if the unit was correct. Therefore convert all
    // errors to the lengths as read before they are compared.
    let at_length_read_m = |likely: &Likely| likely.undone_m / likely.mistake.shortening();
    let found = mistakes.iter().filter_map(corrected);
    let best = found.min_by(|a, b| at_length_read_m(a).total_cmp(&at_length_read_m(b)))?;
    (best.undone_m < NEAR_M && at_length_read_m(&best) < REMAINING_MAX * as_read_m).then_some(best)
}

/// Finds the most likely mistake in the first of the files that has one.
pub(in crate::calibrate) fn likely_of_all(files: &[Rows], robot: &Chain) -> Option<Likely> {
    let likely_of =
        |Rows { instrument, .. }: &Rows| likely(instrument, robot, &instrument.mistakes(robot.links.len()));
    files.iter().find_map(likely_of)
}

/// Refuses lengths if their unit is not the one that the mapping states. `nominal` is the nominal
/// robot with the instrument fitted to it.
///
/// The unit is wrong if two conditions are true. The nominal robot does not explain the variation of the lengths as read.
/// The nominal robot does explain the variation if another usual unit is assumed.
///
/// # Errors
/// [`CalibrateError::Implausible`] with the correct unit.
pub(in crate::calibrate) fn unless_other_unit(
    whole: &Instrument,
    nominal: &Model,
    robot: &Chain,
) -> Result<(), CalibrateError> {
    /// If the unit is right, the nominal robot leaves at most this fraction of the variation of the lengths unexplained. The
    /// errors are millimetres, the variation is decimetres.
    const UNEXPLAINED: f64 = 0.3;
    if whole.lengths_m().is_empty() {
        return Ok(());
    }
    let variation_m = |rows: &Instrument| {
        let lengths_m = rows.lengths_m();
        let mean_m = mean(&lengths_m);
        rms(lengths_m.iter().map(|length_m| length_m - mean_m))
    };
    let median_error_m = |rows: &Instrument, model: &Model| {
        median_size(rows.errors(&model.geometry(&[])).iter().map(|error| error.position_m))
    };
    let (varies_m, as_read_m) = (variation_m(whole), median_error_m(whole, nominal));
    if as_read_m < NEAR_M.min(UNEXPLAINED * varies_m) {
        return Ok(());
    }
    let in_unit = |mistake: Mistake| {
        let corrected = whole.undone(mistake, robot).into_iter().next()?;
        let undone_m = median_error_m(&corrected, &placed(corrected.clone(), Model::alone(robot)).ok()??);
        let unexplained = undone_m / variation_m(&corrected);
        (undone_m < NEAR_M && unexplained < UNEXPLAINED)
            .then_some((unexplained, Likely { mistake, as_read_m, undone_m }))
    };
    let units = whole.mistakes(0).into_iter().filter(|mistake| matches!(mistake, Mistake::LengthUnit(_)));
    let best = units.filter_map(in_unit).min_by(|a, b| a.0.total_cmp(&b.0));
    let Some((_, likely)) = best else { return Ok(()) };
    let found = format!(
        "the lengths vary by {:.3} mm (RMS), which the nominal robot does not explain",
        varies_m * 1e3
    );
    Err(CalibrateError::Implausible { found, likely: Some(likely) })
}
