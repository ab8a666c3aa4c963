//! Refuses rows that are not plausible for the configured robot, and reports the most likely mistake.
//!
//! A fit with priors always has a solution, even if the rows contain a mistake. The mistake is visible in the solution:
//!
//! - a correction of a link parameter exceeds its tolerance (`furthest_link`),
//! - orientations differ although positions fit (`turned`),
//! - residuals are larger than joint errors can cause (`too_far`),
//! - the calibrated robot predicts held-out rows worse than the nominal one (`worse_than_nominal`),
//! - the measured positions have a step in time (`step`).
//!
//! The driver runs these tests after the last stage of [`super::Stages`], before the fit to all rows. If a test
//! fails, `likely` finds the mistake.

use std::fmt;

use nalgebra::{DMatrix, DVector, Vector3};
use statrs::distribution::{ContinuousCDF, StudentsT};

use super::likely::{likely, likely_of_all};
use super::{RowSet, is_surely_worse};
use crate::calibrate::CalibrateError;
use crate::instrument::{Apart, Instrument, Mistake, PoseError, Rows, Run};
use crate::kinematics::Chain;
use crate::model::{Model, ParameterId, Role, Unit};
use crate::statistics::{median_size, quantile};

/// A step in time of the measured positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// First row after the step, from 1.
    pub row: usize,
    /// Magnitude of the step \[m\].
    pub moved_m: f64,
}

impl Step {
    /// Whether the nominal robot fits the rows much better if the rows before the step and those after it
    /// are fitted separately. The robot's own errors may also cause a step, if the path continues in
    /// another region, but this step is smaller.
    fn explains(&self, instrument: &Instrument, robot: &Chain) -> bool {
        likely(instrument, robot, &[Mistake::Moved(self.row - 1)]).is_some()
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { row, moved_m } = self;
        write!(
            f,
            "near row {row} the positions step by {:.2} mm: tracker, target or robot were moved; give the rows before and after it \
             different names in a column, and name that as `station` in the mapping",
            moved_m * 1e3
        )
    }
}

/// Refuses a calibration that is not plausible for a robot like the nominal one. `sets` contains the set of each file, in
/// the order of `files`. The models of `runs` are at the solution.
///
/// # Errors
/// [`CalibrateError::Implausible`] with the most likely mistake.
pub(in crate::calibrate) fn unless_implausible(
    files: &[Rows],
    sets: &[RowSet],
    runs: &[Run],
    robot: &Chain,
) -> Result<(), CalibrateError> {
    let link = runs.first().and_then(|run| furthest_link(&run.model));
    let mut found: Vec<String> = link.into_iter().collect();
    // Ball-bar runs are first in `runs`.
    let bars = runs.len() - sets.len();
    for ((number, run), (file, set)) in runs.iter().enumerate().skip(bars).zip(files.iter().zip(sets)) {
        let place = if runs.len() > 1 { format!("data set {}: ", number + 1) } else { String::new() };
        let reasons = reasons_of_set(set, &file.instrument, &run.model, robot);
        found.extend(reasons.iter().map(|reason| format!("{place}{reason}")));
    }
    if found.is_empty() {
        return Ok(());
    }
    Err(CalibrateError::Implausible { found: found.join("; "), likely: likely_of_all(files, robot) })
}

/// Reasons why the rows of a set are not plausible. Empty if they are plausible.
fn reasons_of_set(set: &RowSet, instrument: &Instrument, model: &Model, robot: &Chain) -> Vec<String> {
    let steps = [step(set.whole(), model), set.step];
    let step = steps.into_iter().flatten().find(|step| step.explains(instrument, robot));
    let step = step.map(|step| step.to_string());
    let reasons = [turned(set), too_far(&set.errors.joints, robot), worse_than_nominal(set), step];
    reasons.into_iter().flatten().collect()
}

/// Limit of the correction of a link parameter, in standard deviations. By chance, one of 50 000 robots
/// has a larger correction among 30 parameters.
const SIGMAS_MAX: f64 = 5.0;
/// Standard deviation of length errors \[m\]. It is large enough for robot files that were typed by hand.
const LINK_M: f64 = 1e-2;
/// Standard deviation of angle errors, including joint offsets \[rad\].
const LINK_RAD: f64 = 2e-2;

/// Describes the link parameter with the largest correction, in standard deviations. `None` if the correction
/// is within the tolerances.
fn furthest_link(model: &Model) -> Option<String> {
    let link = |id: ParameterId| {
        let parameter = model.parameter(id)?;
        let Role::Prior { value, .. } = parameter.role else { return None };
        let sigma = if id.unit() == Unit::Metre { LINK_M } else { LINK_RAD };
        Some((id, parameter.value - value, sigma))
    };
    let links = model.ids().into_iter();
    let links = links.filter(|id| matches!(id, ParameterId::Robot { .. })).filter_map(link);
    let size = |(_, correction, sigma): &(ParameterId, f64, f64)| (correction / sigma).abs();
    let (id, correction, sigma) = links.max_by(|a, b| size(a).total_cmp(&size(b)))?;
    let unit = id.unit();
    (correction.abs() > SIGMAS_MAX * sigma).then(|| {
        format!(
            "{id} would be {:.1} {} from nominal, {:.0} times its tolerance",
            correction * unit.display_factor(),
            unit.display_symbol(),
            (correction / sigma).abs()
        )
    })
}

/// Describes orientations that differ more than those of any real robot, although the positions fit. `None`
/// if the orientations are plausible.
fn turned(set: &RowSet) -> Option<String> {
    /// Limit of the orientation errors \[rad\]. Orientation errors of a nominal robot are smaller. Those of a
    /// wrong angle convention are larger.
    const WRONG_RAD: f64 = 0.1;
    /// Quantile of the orientation errors that is compared with the limit. It allows one row in five to be an outlier.
    const PART: f64 = 0.78;
    let nominal = || set.fitted_rows.iter().filter_map(|row| set.errors.nominal.get(*row));
    let mut turned_rad: Vec<f64> = nominal().map(|error| error.rotation_rad).collect::<Option<_>>()?;
    let turned_rad = quantile(&mut turned_rad, PART);
    let positions_fit = median_size(nominal().map(|error| error.position_m)) < SIGMAS_MAX * LINK_M;
    (positions_fit && turned_rad > WRONG_RAD).then(|| {
        format!(
            "the orientations differ by {turned_rad:.2} rad from those of the nominal robot: their angles are in another order, frame or \
             unit than [rotation] of the mapping states, or it is another robot"
        )
    })
}

/// Maximum joint errors of industrial arms whose link parameters are known \[rad\]. They include errors of gears and
/// resolvers, and the rounding of commanded angles to a tenth of a degree.
const JOINT_ERROR_RAD_MAX: f64 = 2e-3;

/// Describes residuals of the calibrated robot that are larger than joint errors can cause. `None` if they are plausible.
fn too_far(errors: &[PoseError], robot: &Chain) -> Option<String> {
    let limit_m = JOINT_ERROR_RAD_MAX * robot.reach_m();
    let median_m = median_size(errors.iter().map(|error| error.position_m));
    (median_m > limit_m).then(|| {
        format!(
            "the median distance of the rows from the calibrated robot is {:.1} mm, joint errors explain at most {:.1} mm",
            median_m * 1e3,
            limit_m * 1e3
        )
    })
}

/// Describes held-out rows whose errors are significantly larger with the calibrated robot than with the
/// nominal one. `None` if they are not.
fn worse_than_nominal(set: &RowSet) -> Option<String> {
    let held_out = set.held_out();
    let [nominal_m, calibrated_m] = [held_out.nominal.position_m.rms, held_out.joints.position_m.rms];
    let independent = set.independent_held_out().min(held_out.nominal.rows);
    is_surely_worse(independent, [nominal_m, calibrated_m]).then(|| {
        format!(
            "held-out rows are {:.3} mm from the calibrated robot and {:.3} mm from the nominal one",
            calibrated_m * 1e3,
            nominal_m * 1e3
        )
    })
}

/// Number of blocks of consecutive rows.
const BLOCKS: usize = 40;

/// For each block of consecutive rows: the index of its first row, and the median error along each axis.
fn blocks(errors_m: &[Vector3<f64>]) -> Vec<(usize, Vector3<f64>)> {
    let size = errors_m.len().div_ceil(BLOCKS).max(1);
    let median = |(number, block): (usize, &[Vector3<f64>])| {
        let median_of = |axis: usize| {
            let mut errors_m: Vec<f64> = block.iter().map(|error| error[axis]).collect();
            quantile(&mut errors_m, 0.5)
        };
        (number * size, Vector3::new(median_of(0), median_of(1), median_of(2)))
    };
    errors_m.chunks(size).enumerate().map(median).collect()
}

/// Number of columns of the regression in [`step_before`]: mean, drift and step.
const COEFFICIENTS: usize = 3;

/// Finds the most significant step in time of the position errors. `None` if no step is significant.
///
/// The rows are divided into blocks, and the median of each block is used, so that single outliers cause no step. A linear
/// regression of these medians has a mean, a linear drift and a step. Student's t of the step is tested along each of the
/// three axes and for each possible position of the step. The limit is corrected for this number of tests (Bonferroni). The
/// errors of consecutive rows may be correlated, because the variance is estimated from the blocks.
pub(super) fn step(instrument: &Instrument, model: &Model) -> Option<Step> {
    /// Probability of a false alarm in a file without a step.
    const FALSE_ALARMS: f64 = 1e-4;
    /// Minimum number of blocks before and after a step.
    const BESIDE: usize = 3;
    // Only a tracker measures positions and can therefore have this mistake.
    if !instrument.mistakes(0).iter().any(|mistake| matches!(mistake, Mistake::Moved(_))) {
        return None;
    }
    let deviations = instrument.deviations(&model.geometry(&[])).into_iter();
    let offsets_m = deviations.filter_map(|deviation| match deviation.apart {
        Apart::Place(offset_m) => Some(offset_m),
        Apart::Length(_) => None,
    });
    let blocks = blocks(&offsets_m.collect::<Vec<_>>());
    let count = blocks.len();
    let freedom = count.checked_sub(COEFFICIENTS).filter(|freedom| *freedom > 2 * BESIDE)? as f64;
    let first_after = BESIDE..=count - BESIDE;
    // Number of tests: both signs of the three coordinates, for each position of the step.
    let tests = 2.0 * 3.0 * first_after.clone().count() as f64;
    let limit = StudentsT::new(0.0, 1.0, freedom).ok()?.inverse_cdf(1.0 - FALSE_ALARMS / tests);
    let steps = first_after.filter_map(|block| step_before(&blocks, block, freedom));
    let (student, step) = steps.max_by(|a, b| a.0.total_cmp(&b.0))?;
    (student > limit).then_some(step)
}

/// Computes the step before the block `first_after` by a linear regression of the medians of the blocks. Also returns the
/// largest Student's t of the three coordinates of the step. `freedom`, the degrees of freedom of one axis, is the number of
/// blocks minus the [`COEFFICIENTS`] of the regression.
fn step_before(blocks: &[(usize, Vector3<f64>)], first_after: usize, freedom: f64) -> Option<(f64, Step)> {
    let count = blocks.len();
    let design = DMatrix::from_fn(count, COEFFICIENTS, |block, column| match column {
        0 => 1.0,
        1 => block as f64 / count as f64,
        _ => f64::from(u8::from(block >= first_after)),
    });
    let inverse = design.tr_mul(&design).try_inverse()?;
    let mut moved_m = Vector3::zeros();
    let mut student: f64 = 0.0;
    for axis in 0..3 {
        let medians = DVector::from_iterator(count, blocks.iter().map(|(_, median)| median[axis]));
        let fit = &inverse * design.tr_mul(&medians);
        let variance = (&medians - &design * &fit).norm_squared() / freedom;
        moved_m[axis] = fit[2];
        student = student.max(fit[2].abs() / (variance * inverse[(2, 2)]).sqrt().max(f64::MIN_POSITIVE));
    }
    Some((student, Step { row: blocks[first_after].0 + 1, moved_m: moved_m.norm() }))
}
