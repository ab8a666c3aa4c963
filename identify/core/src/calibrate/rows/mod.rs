//! What files of rows have for themselves in a calibration, each row a pose at which the robot stood still and what was measured
//! there: by a tracker ([`tracker`]), by a draw-wire or telescoping bar ([`wire`]) or by a ball in sockets.
//!
//! A fifth of each file is held out: it takes part in nothing, neither in the choice of the errors of joints nor in which rows
//! belong with the rest, and the figures on it are what counts. The result is a last fit to all rows.

mod drift;
mod error;
mod faulty_runs;
mod figures;
mod implausible;
mod terms;
pub mod tracker;
mod wire;

use std::collections::BTreeMap;

use super::error::CalibrateError;
use crate::instrument::{
    Deviation, Instrument, Measured, Measures, PoseError, RejectedRow, Rejection, Run, Wire, faulty,
    gross_rows, without,
};
use crate::kinematics::Chain;
use crate::model::{Model, ParameterId, SetUp};

pub use drift::Drift;
pub use error::RowError;
pub use faulty_runs::{FaultyRun, RunCause};
pub use figures::{PoseFigures, RowErrors, Sizes, Stages, is_surely_better, is_surely_worse};
pub use implausible::{Likely, Mistake, Step, likely, misfit};
pub(super) use implausible::{likely_of_all, unless_implausible, unless_other_unit};
pub(crate) use terms::groups;
pub use wire::wire_misfit;

/// Highest order of the joints' waves that is tried as a rule: there is no finer tooth near the output of a strain wave gear.
pub const WAVES_PER_TURN_MAX: u8 = 64;

/// Parts of a file, of which one is held out.
const PARTS: usize = 5;

impl Measured {
    /// Rows whose own data contradict each other; all others are measurements, and enough for a fit where they are `alone`.
    pub(super) fn checked(&self, alone: bool, robot: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        let (rejected, rows, needed) = match self {
            Self::Poses(rows) | Self::Path(rows, _) => {
                tracker::check_rows(rows)?;
                (Vec::new(), rows.len(), tracker::ROWS_MIN)
            }
            Self::Lengths(rows) => {
                wire::check_rows(rows)?;
                let contradicting = wire::contradicting(rows, robot);
                wire::of_this_robot(&contradicting, rows.len())?;
                (contradicting, rows.len(), wire::ROWS_MIN)
            }
            // The instrument checks them against its table.
            Self::Contacts(..) => return Ok(Vec::new()),
        };
        let fitting = (rows - rejected.len()) * (PARTS - 1) / PARTS;
        if alone && fitting < needed {
            return Err(RowError::TooFewRows { rows: fitting, needed });
        }
        Ok(rejected)
    }
}

/// No more stations or targets than have parameters, and where there are several, each has enough rows to stay placed whichever
/// part of the file is left out; what they are called, and how many rows each needs.
fn each_has_rows(
    rows: impl Iterator<Item = SetUp> + Clone,
    needed: [(&'static str, usize); 2],
) -> Result<(), RowError> {
    let numbers: [fn(SetUp) -> usize; 2] = [|set_up| set_up.station, |set_up| set_up.target];
    for (number, (what, needed)) in numbers.into_iter().zip(needed) {
        let mut counts = BTreeMap::<usize, usize>::new();
        rows.clone().for_each(|set_up| *counts.entry(number(set_up)).or_default() += 1);
        let (count, most) = (counts.len(), ParameterId::SET_UPS_MAX);
        if count > most {
            return Err(RowError::TooManySetUps { what, count, most });
        }
        if let Some((number, rows)) = counts.iter().find(|(_, rows)| count > 1 && **rows < needed) {
            return Err(RowError::TooFewOfSetUp { what, number: number + 1, rows: *rows, needed });
        }
    }
    Ok(())
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
        self.step = self.step(model);
    }

    /// With the best offsets of the joints, and with the best links.
    pub(super) fn judge_links(&mut self, offsets: Option<&Model>, links: &Model) {
        self.errors.stages[1] = offsets.map_or_else(Vec::new, |model| self.at(model));
        self.errors.stages[2] = self.at(links);
    }

    /// With everything that the rows ask for.
    pub(super) fn judge_joints(&mut self, model: &Model) {
        self.errors.stages[3] = match self.steady() {
            Some(wire) => wire.errors(&model.geometry(&[])),
            None => self.at(model),
        };
        match &self.whole {
            Instrument::Wire(all) => self.runs = faulty_runs::runs(model, all, &self.rejected),
            // A ball in another socket than its row says is no measurement that anything could predict.
            Instrument::Contact(contact) => {
                let mut contact = contact.clone();
                contact.screen(model);
                self.rejected = contact.rejected().to_vec();
                self.errors.fitted = without(&self.errors.fitted, &self.rejected);
                self.errors.held_out = without(&self.errors.held_out, &self.rejected);
            }
            Instrument::Tracker(_) | Instrument::BallBar(_) => {}
        }
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
        let gross: Vec<RejectedRow> = gross.collect();
        self.errors.fitted = without(&self.errors.fitted, &gross);
        self.errors.held_out = without(&self.errors.held_out, &gross);
        self.rejected.extend(gross);
        self.rejected.sort_by_key(|one| one.row);
    }

    fn at(&self, model: &Model) -> Vec<PoseError> {
        self.whole.errors(&model.geometry(&[]))
    }

    fn step(&self, model: &Model) -> Option<Step> {
        let Instrument::Tracker(tracker) = &self.whole else { return None };
        implausible::step(tracker, model)
    }

    /// The wire without its drift, where it has one.
    fn steady(&self) -> Option<Wire> {
        let Instrument::Wire(all) = &self.whole else { return None };
        self.drift.is_some().then(|| all.plus(&self.drift_m))
    }

    /// Finds the rows of a wire that do not belong with the rest, and a drift of its zero, where the run, which sees the fitting
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
        let (Instrument::Wire(all), Instrument::Wire(seen)) = (&self.whole, &run.instrument) else {
            return Ok(());
        };
        let all = all.weighed_as(seen);
        let fitting = without(&self.errors.fitted, &self.rejected);
        let row_of = |one: &RejectedRow| RejectedRow { row: fitting[one.row], ..*one };
        let kept = without(&fitting, &seen.rejected().iter().map(row_of).collect::<Vec<_>>());
        let residuals_m = all.residuals_m(&run.model.geometry(&[]));
        let faulty = faulty(&residuals_m, &all.relative_noise(), &fitting, &kept);
        let kept = without(&fitting, &faulty);
        if kept.len() < fitting.len() / 2 {
            let error = RowError::TooManyRejected { kept: kept.len(), rows: fitting.len() };
            return Err(CalibrateError::Rows { data_set, error });
        }
        let known: Vec<usize> = self.rejected.iter().map(|one| one.row).collect();
        self.rejected.extend(faulty.iter().filter(|one| !known.contains(&one.row)));
        self.rejected.sort_by_key(|one| one.row);
        let fitting = self.beside_drift(&fitting);
        if let Some((drift, drift_m)) = drift::find(&mut run.model.clone(), &all, &fitting, sigma_m)? {
            run.instrument = Instrument::Wire(all.plus(&drift_m).chosen(&fitting));
            (self.drift, self.drift_m) = (Some(drift), drift_m);
        }
        self.whole = Instrument::Wire(all);
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
        if let (Instrument::Wire(wire), Some(drift)) = (&self.whole, &self.drift) {
            self.given = self.beside_drift(&all);
            let drift_m = drift::fit(&mut model.clone(), wire, &self.given, drift)?;
            return Ok(Instrument::Wire(wire.plus(&drift_m).chosen(&self.given)));
        }
        // A wire judges its gross rows anew wherever a solve has come.
        let of_tracker = matches!(self.whole, Instrument::Tracker(_));
        let wrong = self.rejected_where(|why| match why {
            Rejection::FlangeContradicts { .. } => true,
            Rejection::GrossResidual { .. } => of_tracker,
            Rejection::FaultyRun { .. } => false,
        });
        self.given = without(&all, &wrong);
        Ok(self.whole.part(&self.given))
    }

    /// Robot minus measurement in every row at the last solution, with the reason of a row that it left out; `run` is its data set.
    pub fn deviations(&self, run: &Run) -> Vec<(Deviation, Option<Rejection>)> {
        let geometry = run.model.geometry(&[]);
        let deviations = match self.steady() {
            Some(wire) => wire.deviations(&geometry),
            None => self.whole.deviations(&geometry),
        };
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
        let (Instrument::Wire(wire), Some(drift)) = (&self.whole, &self.drift) else { return Ok(1.0) };
        drift::widens(model, wire, &self.given, drift, sigma_m)
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
