//! What files of rows have for themselves in a calibration, each row a pose at which the robot stood still and what was measured
//! there.
//!
//! A fifth of each file is held out: it takes part in nothing, neither in the choice of the errors of joints nor in which rows
//! belong with the rest, and the figures on it are what counts. The result is a last fit to all rows.

mod drift;
mod faulty_runs;
mod figures;
mod implausible;
mod likely;
mod terms;
mod validate;

use super::error::CalibrateError;
use crate::instrument::{
    Deviation, Instrument, PoseError, RejectedRow, Rejection, RowError, Run, faulty, gross_rows, without,
};
use crate::kinematics::Chain;
use crate::model::Model;

pub use drift::Drift;
pub use faulty_runs::{FaultyRun, RunCause};
pub use figures::{PoseFigures, RowErrors, Sizes, Stages, is_surely_better, is_surely_worse};
use implausible::Step;
pub(super) use implausible::unless_implausible;
pub use likely::{Likely, likely, misfit, some_of};
pub(super) use likely::{likely_of_all, unless_other_unit};
pub(crate) use terms::groups;
pub use validate::{Validated, validate};

/// Highest order of the joints' waves that is tried as a rule: there is no finer tooth near the output of a strain wave gear.
pub const WAVES_PER_TURN_MAX: u8 = 64;

/// Parts of a file, of which one is held out.
const PARTS: usize = 5;

/// Rows whose own data contradict each other; all others are measurements, and enough for a fit where they are `alone`.
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

/// A file of rows, what of it was held out, and what the stages of the calibration say of it.
#[derive(Debug, Clone)]
pub struct RowSet {
    /// All rows.
    whole: Instrument,
    /// Each row, rejected or not.
    pub errors: RowErrors,
    /// Rows that did not take part, and why.
    pub rejected: Vec<RejectedRow>,
    /// Faulty runs of rows, with what would explain them.
    pub runs: Vec<FaultyRun>,
    /// Drift of the instrument's zero, where left-out rows asked for it; it is part of the last stage of all figures.
    pub drift: Option<Drift>,
    /// Of each row \[m\].
    drift_m: Vec<f64>,
    /// Rows of the last solve, before its own screening.
    given: Vec<usize>,
    /// A sudden change of where the nominal robot is seen.
    step: Option<Step>,
}

impl RowSet {
    /// All rows of a file but for those `rejected`, a part of them held out where it is `judged`.
    pub(super) fn new(whole: Instrument, rejected: Vec<RejectedRow>, judged: bool) -> Self {
        let parts = if judged { whole.independent(PARTS) } else { Vec::new() };
        // Of rows that are all alike none judges the others.
        let several = parts.len() > 1;
        let mut held_out = parts.into_iter().next().filter(|_| several).unwrap_or_default();
        held_out.sort_unstable();
        let fitted = (0..whole.samples()).filter(|sample| held_out.binary_search(sample).is_err()).collect();
        let errors = RowErrors { fitted, held_out, ..RowErrors::default() };
        Self {
            whole,
            errors,
            rejected,
            runs: Vec::new(),
            drift: None,
            drift_m: Vec::new(),
            given: Vec::new(),
            step: None,
        }
    }

    /// The instrument with all rows, rejected and held-out ones included.
    pub(super) fn whole(&self) -> &Instrument {
        &self.whole
    }

    /// The rows that a fit sees.
    pub(super) fn fitting(&self) -> Instrument {
        self.whole.part(&without(&self.errors.fitted, &self.rejected))
    }

    /// With the nominal robot, the instrument fitted to it.
    pub(super) fn judge_nominal(&mut self, model: &Model) {
        self.errors.stages[0] = self.at(model);
        self.step = implausible::step(&self.whole, model);
    }

    /// With the best offsets of the joints, and with the best links.
    pub(super) fn judge_links(&mut self, offsets: Option<&Model>, links: &Model) {
        self.errors.stages[1] = offsets.map_or_else(Vec::new, |model| self.at(model));
        self.errors.stages[2] = self.at(links);
    }

    /// With everything that the rows ask for.
    pub(super) fn judge_joints(&mut self, model: &Model) {
        self.errors.stages[3] = self.steady().errors(&model.geometry(&[]));
        self.runs = faulty_runs::runs(model, &self.whole, &self.rejected);
        self.reject(&self.whole.misplaced(model));
    }

    /// Leaves out more rows.
    fn reject(&mut self, more: &[RejectedRow]) {
        self.errors.fitted = without(&self.errors.fitted, more);
        self.errors.held_out = without(&self.errors.held_out, more);
        self.rejected.extend(more);
        self.rejected.sort_by_key(|one| one.row);
    }

    /// Rows that neither the nominal robot nor the calibrated one comes near are no measurements, whether a fit saw them or not: a
    /// beam that broke, another target, a length that was read wrong. A calibration that predicts badly leaves its held-out rows
    /// near the nominal robot, and they stay.
    pub(super) fn leave_out_gross(&mut self, model: &Model) {
        let mut whole = self.whole.clone();
        whole.adapt(model);
        let [nominal, .., joints] = &self.errors.stages;
        let is_gross = gross_rows(nominal, joints, &whole.relative_noise());
        let rows = without(&(0..is_gross.len()).collect::<Vec<_>>(), &self.rejected);
        let gross = rows.into_iter().filter(|row| is_gross[*row]).map(|row| {
            let residual_m = joints[row].position_m;
            RejectedRow { row, why: Rejection::GrossResidual { residual_m } }
        });
        self.reject(&gross.collect::<Vec<_>>());
    }

    fn at(&self, model: &Model) -> Vec<PoseError> {
        self.whole.errors(&model.geometry(&[]))
    }

    /// The instrument without the drift of its zero.
    fn steady(&self) -> Instrument {
        let steady = self.drift.as_ref().and_then(|_| self.whole.longer_by(&self.drift_m));
        steady.unwrap_or_else(|| self.whole.clone())
    }

    /// Finds the rows of lengths that do not belong with the rest, and a drift of their zero, where the run, which sees the fitting
    /// rows, is at its best links. From then on the drift is known.
    ///
    /// Single gross residuals are rejected from the fit only; faulty runs everywhere, but judged by their fitting rows alone;
    /// with a drift they take part again: what moved their zero is part of it. Lengths of held-out rows decide nothing.
    pub(super) fn screen(
        &mut self,
        data_set: usize,
        run: &mut Run,
        sigma_m: f64,
    ) -> Result<(), CalibrateError> {
        if self.whole.lengths_m().is_empty() {
            return Ok(());
        }
        let fitting = without(&self.errors.fitted, &self.rejected);
        let row_of = |one: &RejectedRow| RejectedRow { row: fitting[one.row], ..*one };
        let seen = run.instrument.rejected().iter().map(row_of).collect::<Vec<_>>();
        let kept = without(&fitting, &seen);
        self.whole.weigh_by(&run.model, &kept);
        let deviations = self.whole.deviations(&run.model.geometry(&[]));
        let residuals_m: Vec<f64> = deviations.iter().map(|deviation| deviation.signed_m()).collect();
        let faulty = faulty(&residuals_m, &self.whole.relative_noise(), &fitting, &kept);
        let kept = without(&fitting, &faulty);
        if kept.len() < fitting.len() / 2 {
            let error = RowError::TooManyRejected { kept: kept.len(), rows: fitting.len() };
            return Err(CalibrateError::Rows { data_set, error });
        }
        let known: Vec<usize> = self.rejected.iter().map(|one| one.row).collect();
        self.rejected.extend(faulty.iter().filter(|one| !known.contains(&one.row)));
        self.rejected.sort_by_key(|one| one.row);
        let fitting = self.beside_drift(&fitting);
        if let Some((drift, drift_m)) = drift::find(&mut run.model.clone(), &self.whole, &fitting, sigma_m)? {
            (self.drift, self.drift_m) = (Some(drift), drift_m);
            run.instrument = self.steady().part(&fitting);
        }
        Ok(())
    }

    /// Rows without those that are wrong even where the zero drifts.
    fn beside_drift(&self, rows: &[usize]) -> Vec<usize> {
        without(rows, &self.rejected_where(|why| !matches!(why, Rejection::FaultyRun { .. })))
    }

    fn rejected_where(&self, wanted: impl Fn(Rejection) -> bool) -> Vec<RejectedRow> {
        self.rejected.iter().filter(|one| wanted(one.why)).copied().collect()
    }

    /// All rows that may take part once the held-out ones have judged.
    pub(super) fn everything(&mut self, model: &Model) -> Result<Instrument, CalibrateError> {
        let all: Vec<usize> = (0..self.whole.samples()).collect();
        if let Some(drift) = &self.drift {
            self.given = self.beside_drift(&all);
            self.drift_m = drift::fit(&mut model.clone(), &self.whole, &self.given, drift)?;
            return Ok(self.steady().part(&self.given));
        }
        let judges_gross = self.whole.judges_gross();
        let wrong = self.rejected_where(|why| match why {
            Rejection::FlangeContradicts { .. } => true,
            Rejection::GrossResidual { .. } => !judges_gross,
            Rejection::FaultyRun { .. } => false,
        });
        self.given = without(&all, &wrong);
        Ok(self.whole.part(&self.given))
    }

    /// Robot minus measurement in every row at the last solution, with the reason of a row that it left out; `run` is its data set.
    pub fn deviations(&self, run: &Run) -> Vec<(Deviation, Option<Rejection>)> {
        let geometry = run.model.geometry(&[]);
        let deviations = self.steady().deviations(&geometry);
        let mut all: Vec<_> = deviations.into_iter().map(|deviation| (deviation, None)).collect();
        let not_given = |one: &&RejectedRow| self.given.binary_search(&one.row).is_err();
        for one in self.rejected.iter().filter(not_given) {
            all[one.row].1 = Some(one.why);
        }
        for one in run.instrument.rejected() {
            all[self.given[one.row]].1 = Some(one.why);
        }
        all
    }

    /// How many times less certain all rows leave the robot than they would with a drift that is known.
    pub(super) fn widens(&self, model: &Model, sigma_m: f64) -> Result<f64, CalibrateError> {
        let Some(drift) = &self.drift else { return Ok(1.0) };
        drift::widens(model, &self.whole, &self.given, drift, sigma_m)
    }

    /// Rows that the fit saw, without rejected ones.
    pub fn fitted(&self) -> Stages {
        self.errors.of(&without(&self.errors.fitted, &self.rejected))
    }

    /// Held-out rows, without those whose own data contradict each other and those in faulty runs.
    pub fn held_out(&self) -> Stages {
        self.errors.of(&without(&self.errors.held_out, &self.rejected))
    }

    /// All held-out rows.
    pub fn held_out_with_rejected(&self) -> Stages {
        self.errors.of(&self.errors.held_out)
    }
}
