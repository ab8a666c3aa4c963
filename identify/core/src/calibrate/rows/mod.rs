//! The parts of a calibration that are specific to files of rows. A row contains a measurement and the joints of the robot,
//! which usually stands still during the measurement.
//!
//! A fifth of the rows of each file is held out. These rows are used neither to choose error terms nor to detect outliers,
//! so their errors validate the calibration. The final result is a fit to all rows.
//!
//! The driver calls the methods of [`RowSet`] in the order of its stages ([`Stages`]). Each stage fits more parameters than
//! the previous one. After each stage the errors of all rows are recorded:
//!
//! 1. `RowSet::new` splits the rows, and `judge_nominal` records the errors of the nominal robot.
//! 2. `judge_links` records the errors with the best joint offsets, and with the best link parameters.
//! 3. `screen` rejects outliers and removes a drift of the offset.
//! 4. `judge_joints` records the errors with error terms.
//! 5. `leave_out_gross` rejects rows far from both robots, and `everything` returns all other rows for the last fit.

mod drift;
mod faulty_runs;
mod figures;
mod implausible;
mod likely;
mod validate;

use super::error::CalibrateError;
use super::pipeline::Solved;
pub(crate) use super::selection::candidates::groups;
use crate::instrument::{
    Deviation, Instrument, PoseError, RejectedRow, Rejection, RowError, Run, faulty, gross_rows, without,
};
use crate::kinematics::Chain;
use crate::model::{Model, ParameterId, Role};
use crate::statistics::rms;

pub use drift::Drift;
pub use faulty_runs::{FaultyRun, RunCause};
pub use figures::{INDEPENDENT_OF_GROUP, PoseFigures, Stages, is_surely_better, is_surely_worse};
use implausible::Step;
pub(super) use implausible::unless_implausible;
pub use likely::{Likely, likely, misfit, some_of};
pub(super) use likely::{likely_of_all, unless_other_unit};
pub use validate::{Validated, validate};

/// Default maximum order of joint waves. The teeth of strain wave gears cause no higher orders per turn of the joint.
pub const WAVES_PER_TURN_MAX: u8 = 64;

/// Number of equal parts of a file. A calibration holds one of them out. A validation holds each of them out in turn.
const PARTS: usize = 5;

/// Minimum number of rows of a file from which a robot can be calibrated without other data. Includes the held-out rows.
pub(crate) fn rows_min(instrument: &Instrument) -> usize {
    (instrument.samples_min() * PARTS).div_ceil(PARTS - 1)
}

/// Widens the covariance of a fit to all rows. The fit assumes that the drift of an instrument is known, but the drift was
/// estimated. The last elements of `runs` belong to the files of rows.
pub(super) fn widen_for_drifts(
    runs: &[Run],
    rows: &[RowSet],
    solved: &mut Solved,
) -> Result<(), CalibrateError> {
    let first_of_rows = runs.len() - rows.len();
    for ((number, run), set) in runs.iter().enumerate().skip(first_of_rows).zip(rows) {
        let factor = set.widens(&run.model, solved.sigmas[number])?;
        solved.solution.covariance.widen(number, factor);
    }
    Ok(())
}

/// Checks the rows and returns those whose own data contradict each other. If the file is the only input (`alone`),
/// enough other rows must remain for a fit.
pub(super) fn checked(
    instrument: &Instrument,
    alone: bool,
    robot: &Chain,
) -> Result<Vec<RejectedRow>, RowError> {
    let contradicting = instrument.contradicting(robot)?;
    let rows = (instrument.samples() - contradicting.len()) * (PARTS - 1) / PARTS;
    let needed = instrument.samples_min();
    if alone && rows < needed {
        return Err(RowError::TooFewRows { rows, needed });
    }
    Ok(contradicting)
}

/// A file of rows, with its split into fitted and held-out rows and the results of each stage of the calibration.
#[derive(Debug, Clone)]
pub struct RowSet {
    /// All rows of the file.
    whole: Instrument,
    /// Errors of all rows after each stage, including the errors of rejected rows.
    pub errors: Stages<Vec<PoseError>>,
    /// Rows that the fits of the stages use.
    pub fitted_rows: Vec<usize>,
    /// Rows that are held out.
    pub held_out_rows: Vec<usize>,
    /// Rejected rows with the reason, in ascending order.
    pub rejected: Vec<RejectedRow>,
    /// Faulty runs, which are consecutive rows with a common error, with possible causes.
    pub runs: Vec<FaultyRun>,
    /// Drift of the instrument's offset. `None` if no drift improves the prediction of left-out rows at the best link
    /// parameters. A drift is removed from the errors of each stage: this drift from the errors of the last two stages, and
    /// a separately estimated drift from those of each of the first two.
    pub drift: Option<Drift>,
    /// Drift of each row \[m\]; empty without a drift.
    drift_m: Vec<f64>,
    /// Rows that were given to the last solve. The solve may have excluded some of them as outliers.
    given: Vec<usize>,
    /// A significant step of the measured positions relative to the nominal robot.
    step: Option<Step>,
    /// Model with the nominal robot. Its instrument parameters were fitted to the rows.
    nominal: Option<Model>,
}

impl RowSet {
    /// Splits a file of rows without the `rejected` rows. If `hold_out` is true, one part of the rows is held out.
    pub(super) fn new(whole: Instrument, rejected: Vec<RejectedRow>, hold_out: bool) -> Self {
        let parts = if hold_out { whole.independent(PARTS) } else { Vec::new() };
        // If all rows are in one group, nothing can be held out, because groups are not split.
        let can_hold_out = parts.len() > 1;
        let mut held_out_rows = parts.into_iter().next().filter(|_| can_hold_out).unwrap_or_default();
        held_out_rows.sort_unstable();
        let is_fitted = |row: &usize| held_out_rows.binary_search(row).is_err();
        Self {
            fitted_rows: (0..whole.samples()).filter(is_fitted).collect(),
            held_out_rows,
            whole,
            errors: Stages::default(),
            rejected,
            runs: Vec::new(),
            drift: None,
            drift_m: Vec::new(),
            given: Vec::new(),
            step: None,
            nominal: None,
        }
    }

    /// The instrument with all rows, including rejected and held-out ones.
    pub(super) fn whole(&self) -> &Instrument {
        &self.whole
    }

    /// The instrument with the rows that a fit uses.
    pub(super) fn fitting(&self) -> Instrument {
        self.whole.part(&without(&self.fitted_rows, &self.rejected))
    }

    /// Records the errors of the nominal robot. `model` is the nominal robot with the instrument fitted to the rows.
    ///
    /// # Errors
    /// [`CalibrateError::Model`] if the role of the scale cannot be set.
    pub(super) fn judge_nominal(&mut self, model: &Model) -> Result<(), CalibrateError> {
        self.errors.nominal = self.errors_with(model);
        self.step = implausible::step(&self.whole, model);
        let mut nominal = model.clone();
        // Fix the scale, as it was when the instrument was placed. The nominal robot has no scale of its own.
        if nominal.role(ParameterId::Scale).is_some() {
            nominal.set_role(ParameterId::Scale, Role::Fixed)?;
        }
        self.nominal = Some(nominal);
        Ok(())
    }

    /// Records the errors with the best joint offsets alone, and with the best link parameters.
    pub(super) fn judge_links(&mut self, offsets: Option<&Model>, links: &Model) {
        self.errors.offsets = offsets.map_or_else(Vec::new, |model| self.errors_with(model));
        self.errors.links = self.errors_with(links);
    }

    /// Records the errors with all accepted error terms, and rejects misplaced rows.
    pub(super) fn judge_joints(&mut self, model: &Model) {
        self.errors.joints = self.without_drift().errors(&model.geometry(&[]));
        self.runs = faulty_runs::runs(model, &self.whole, &self.rejected);
        self.reject(&self.whole.misplaced(model));
    }

    /// Rejects additional rows; `more` is in ascending order.
    fn reject(&mut self, more: &[RejectedRow]) {
        self.fitted_rows = without(&self.fitted_rows, more);
        self.held_out_rows = without(&self.held_out_rows, more);
        self.rejected.extend(more);
        self.rejected.sort_by_key(|rejected| rejected.row);
    }

    /// Rejects rows that are far from both the nominal and the calibrated robot, whether they were fitted or held out.
    /// Causes of such rows are a broken beam, a wrong target or a misread length. If only the calibrated robot predicts
    /// held-out rows poorly, they are kept, because they are near the nominal robot.
    ///
    /// A drift is not removed from the errors with the nominal robot. The drift of a held-out segment is not known. If a
    /// wrong drift were removed, the rows of this segment would be far from both robots.
    pub(super) fn leave_out_gross(&mut self, model: &Model) {
        let mut whole = self.whole.clone();
        whole.adapt(model);
        let nominal = self.nominal.as_ref().map_or_else(Vec::new, |nominal| self.errors_with(nominal));
        let is_gross = gross_rows(&nominal, &self.errors.joints, &whole.relative_noise());
        let rows = without(&(0..is_gross.len()).collect::<Vec<_>>(), &self.rejected);
        let residuals_m = self.without_drift().residuals_m(&model.geometry(&[]));
        let gross = rows.into_iter().filter(|row| is_gross[*row]).map(|row| {
            let residual_m = residuals_m[row];
            RejectedRow { row, why: Rejection::GrossResidual { residual_m } }
        });
        self.reject(&gross.collect::<Vec<_>>());
    }

    fn errors_with(&self, model: &Model) -> Vec<PoseError> {
        self.whole.errors(&model.geometry(&[]))
    }

    /// Errors of all rows at this model, after the drift at this model is removed. The drift is the one that predicts
    /// left-out rows among `rows` best. If no drift improves the prediction, none is removed. Each model needs its own
    /// drift. Otherwise a comparison of two models would also compare their drifts.
    fn errors_with_own_drift(&self, model: &Model, rows: &[usize]) -> Result<Vec<PoseError>, CalibrateError> {
        let mut model = model.clone();
        // `sigma_m` only determines the magnitude of the drifts to try.
        let without = self.errors_with(&model);
        let sigma_m = rms(rows.iter().filter_map(|&row| Some(without.get(row)?.position_m)));
        let found = drift::find(&mut model, &self.whole, rows, sigma_m)?;
        let corrected = found.and_then(|(_, drift_m)| self.whole.longer_by(&drift_m));
        Ok(corrected.map_or(without, |whole| whole.errors(&model.geometry(&[]))))
    }

    /// The instrument. If there is a drift, it is removed from the lengths.
    fn without_drift(&self) -> Instrument {
        let corrected = self.drift.as_ref().and_then(|_| self.whole.longer_by(&self.drift_m));
        corrected.unwrap_or_else(|| self.whole.clone())
    }

    /// Detects outliers, and a drift of the offset, in the lengths of a run. The model of the run contains the best link
    /// parameters for the fitting rows, and `offsets` contains only the best joint offsets. Later stages assume this drift
    /// to be known. The errors of the previous stages are computed again without drift.
    ///
    /// A single gross residual is rejected only if its row is fitted. A faulty run is rejected with all its rows, fitted and
    /// held out, but only its fitted rows are used to find it. If a drift is found, the rows of faulty runs are used again,
    /// because the drift contains the change of their offset. Lengths of held-out rows have no influence.
    pub(super) fn screen(
        &mut self,
        data_set: usize,
        run: &mut Run,
        offsets: Option<&Model>,
        sigma_m: f64,
    ) -> Result<(), CalibrateError> {
        if self.whole.lengths_m().is_empty() {
            return Ok(());
        }
        let fitting = without(&self.fitted_rows, &self.rejected);
        let faulty = self.faulty_rows(run, &fitting);
        let kept = without(&fitting, &faulty).len();
        if kept < fitting.len() / 2 {
            let error = RowError::TooManyRejected { kept, rows: fitting.len() };
            return Err(CalibrateError::Rows { data_set, error });
        }
        let already_rejected: Vec<usize> = self.rejected.iter().map(|rejected| rejected.row).collect();
        self.rejected.extend(faulty.iter().filter(|faulty| !already_rejected.contains(&faulty.row)));
        self.rejected.sort_by_key(|rejected| rejected.row);
        self.remove_drift(run, offsets, &self.usable_with_drift(&fitting), sigma_m)
    }

    /// Finds rows that contradict the other rows at the model of the run. The run contains only the `fitting` rows. The
    /// noise of all rows is estimated from the rows that the run's fit did not reject.
    fn faulty_rows(&mut self, run: &Run, fitting: &[usize]) -> Vec<RejectedRow> {
        // The run numbers only the rows in `fitting`. Convert these numbers to row numbers of the file.
        let in_file = |rejected: &RejectedRow| RejectedRow { row: fitting[rejected.row], ..*rejected };
        let rejected_by_fit = run.instrument.rejected().iter().map(in_file).collect::<Vec<_>>();
        let kept = without(fitting, &rejected_by_fit);
        self.whole.weigh_by(&run.model, &kept);
        let residuals_m = self.whole.residuals_m(&run.model.geometry(&[]));
        faulty(&residuals_m, &self.whole.relative_noise(), fitting, &kept)
    }

    /// Removes a drift from the lengths if `rows` have one. The run then contains these rows with the corrected lengths.
    fn remove_drift(
        &mut self,
        run: &mut Run,
        offsets: Option<&Model>,
        rows: &[usize],
        sigma_m: f64,
    ) -> Result<(), CalibrateError> {
        let mut links = run.model.clone();
        let Some((drift, drift_m)) = drift::find(&mut links, &self.whole, rows, sigma_m)? else {
            return Ok(());
        };
        let with_own_drift = |model: Option<&Model>| {
            model.map_or_else(|| Ok(Vec::new()), |model| self.errors_with_own_drift(model, rows))
        };
        let (nominal, offsets) = (with_own_drift(self.nominal.as_ref())?, with_own_drift(offsets)?);
        (self.drift, self.drift_m) = (Some(drift), drift_m);
        let corrected = self.without_drift();
        self.errors =
            Stages { nominal, offsets, links: corrected.errors(&links.geometry(&[])), ..Stages::default() };
        run.instrument = corrected.part(rows);
        Ok(())
    }

    /// Removes the rows that are outliers even if there is a drift: all rejected rows except those of faulty runs.
    fn usable_with_drift(&self, rows: &[usize]) -> Vec<usize> {
        without(rows, &self.rejected_where(|why| !matches!(why, Rejection::FaultyRun { .. })))
    }

    fn rejected_where(&self, wanted: impl Fn(Rejection) -> bool) -> Vec<RejectedRow> {
        self.rejected.iter().filter(|rejected| wanted(rejected.why)).copied().collect()
    }

    /// The instrument with all valid rows, including held-out ones, for the last fit. `model` is at the solution
    /// of the fitted rows.
    pub(super) fn everything(&mut self, model: &Model) -> Result<Instrument, CalibrateError> {
        let all: Vec<usize> = (0..self.whole.samples()).collect();
        if let Some(drift) = &self.drift {
            self.given = self.usable_with_drift(&all);
            self.drift_m = drift::fit(&mut model.clone(), &self.whole, &self.given, drift)?;
            return Ok(self.without_drift().part(&self.given));
        }
        // If the fit detects outliers itself, it also receives the rows with gross residuals. They may fit now,
        // because the model has more parameters.
        let fit_detects_gross = self.whole.judges_gross();
        let unusable = self.rejected_where(|why| match why {
            Rejection::FlangeContradicts { .. } => true,
            Rejection::GrossResidual { .. } => !fit_detects_gross,
            Rejection::FaultyRun { .. } => false,
        });
        self.given = without(&all, &unusable);
        Ok(self.whole.part(&self.given))
    }

    /// Difference of robot and measurement at every row, at the last solution. For excluded rows, also the reason.
    /// `run` is the data set of these rows.
    pub fn deviations(&self, run: &Run) -> Vec<(Deviation, Option<Rejection>)> {
        let geometry = run.model.geometry(&[]);
        let deviations = self.without_drift().deviations(&geometry);
        let mut all: Vec<_> = deviations.into_iter().map(|deviation| (deviation, None)).collect();
        let not_given = |rejected: &&RejectedRow| self.given.binary_search(&rejected.row).is_err();
        for rejected in self.rejected.iter().filter(not_given) {
            all[rejected.row].1 = Some(rejected.why);
        }
        for rejected in run.instrument.rejected() {
            all[self.given[rejected.row]].1 = Some(rejected.why);
        }
        all
    }

    /// Factor, at least 1, by which the standard deviations of the robot must be multiplied after a fit that assumed the
    /// drift to be known. `sigma_m` is the residual standard deviation of this fit \[m\].
    fn widens(&self, model: &Model, sigma_m: f64) -> Result<f64, CalibrateError> {
        let Some(drift) = &self.drift else { return Ok(1.0) };
        drift::widens(model, &self.whole, &self.given, drift, sigma_m)
    }

    /// Statistics of the errors of the chosen rows after each stage.
    fn figures(&self, chosen: &[usize]) -> Stages {
        let of = |errors: &[PoseError]| {
            PoseFigures::from_errors(chosen.iter().filter_map(|&row| errors.get(row).copied()))
        };
        let Stages { nominal, offsets, links, joints } = &self.errors;
        Stages { nominal: of(nominal), offsets: of(offsets), links: of(links), joints: of(joints) }
    }

    /// Statistics of the rows that the fit used, without rejected rows.
    pub fn fitted(&self) -> Stages {
        self.figures(&without(&self.fitted_rows, &self.rejected))
    }

    /// Statistics of the held-out rows, without rejected rows (contradictory data, faulty runs,
    /// gross residuals, misplaced rows).
    pub fn held_out(&self) -> Stages {
        self.figures(&without(&self.held_out_rows, &self.rejected))
    }

    /// Number of independent errors among all held-out rows. The rows of one pose, segment or region have one common
    /// error along each measured direction.
    pub fn independent_held_out(&self) -> usize {
        let rows = self.whole.part(&self.held_out_rows);
        let of_group = if rows.lengths_m().is_empty() { INDEPENDENT_OF_GROUP } else { 1 };
        let groups = rows.independent(rows.samples());
        (of_group * groups.len()).min(rows.samples())
    }

    /// Statistics of all held-out rows, including rejected ones.
    pub fn held_out_with_rejected(&self) -> Stages {
        self.figures(&self.held_out_rows)
    }
}
