//! Calibration from poses with a measured length each: a draw-wire or a telescoping bar between robot and cell.
//!
//! Unknown are the anchor in the cell, the attachment on the flange, a constant length offset, the robot's links, with priors
//! from tolerances, and the errors of its joints, each kind only if fitting rows left out are predicted better with it. What
//! rows next to each other are off by together is a drift of the instrument's zero ([`Drift`]), which is taken where left-out
//! rows ask for it. Held-out rows take no part in any of this; the figures on them are what counts.

mod drift;
mod error;
mod runs;

use nalgebra::Vector3;

use super::ball_bar::CalibrateError;
use super::links::{TOLERANCE, free_links, link_ids};
use super::measured_pose::{RowErrors, Stages, kinds};
use super::pipeline::{Plan, Solved, estimate, waves_per_turn};
use super::split::{self, HoldOut, Split};
use super::terms::{Candidate, Kind};
use crate::instrument::{
    Instrument, LengthRow, Measures, RejectedRow, Rejection, Run, Standing, Wire, faulty, standing, without,
};
use crate::kinematics::Chain;
use crate::model::{Model, ModelError, ParameterId};
use crate::solver::{LossName, Solution};

pub use drift::Drift;
pub use error::LengthError;
pub use runs::{FaultyRun, RunCause};

/// How the calibration is done.
#[derive(Debug, Clone, PartialEq)]
pub struct LengthOptions {
    /// What is held out together, from the figures and from each fold of the choice of terms.
    pub hold_out: HoldOut,
    /// Part of the rows that the fit never sees.
    pub held_out: f64,
    /// Seed of the choice of rows.
    pub seed: u64,
    /// How much rows count that do not fit.
    pub loss: LossName,
    /// Prior of the links' lengths around nominal, one standard deviation \[m\].
    pub link_sigma_m: f64,
    /// Prior of the links' angles around nominal, one standard deviation \[rad\].
    pub link_sigma_rad: f64,
    /// Parameters that stay where they start: links at nominal, the wire attached at the flange's origin, no offset.
    pub fix: Vec<ParameterId>,
}

impl Default for LengthOptions {
    fn default() -> Self {
        Self {
            hold_out: HoldOut::Rows,
            held_out: 0.2,
            seed: 1042,
            loss: LossName::Cauchy,
            link_sigma_m: 1e-2,
            link_sigma_rad: 1e-2,
            fix: Vec::new(),
        }
    }
}

/// Fewest rows of a fit: the seven unknowns of the wire and as many again.
const ROWS_MIN: usize = 14;

fn check(rows: &[LengthRow], options: &LengthOptions) -> Result<(), LengthError> {
    for (index, row) in rows.iter().enumerate() {
        let bad = |what| Err(LengthError::BadRow { row: index + 1, what });
        if !row.joints_rad.iter().chain(row.flange_m.iter().flatten()).all(|v| v.is_finite()) {
            return bad("a number that is not finite");
        }
        if !(row.length_m.is_finite() && row.length_m > 0.0) {
            return bad("a length that is not above zero");
        }
    }
    for (option, value) in
        [("link_sigma_m", options.link_sigma_m), ("link_sigma_rad", options.link_sigma_rad)]
    {
        if !(value.is_finite() && value > 0.0) {
            return Err(LengthError::BadOption { option, value, remedy: "give a number above zero" });
        }
    }
    if !(0.0..0.9).contains(&options.held_out) {
        let (option, value) = ("held_out", options.held_out);
        return Err(LengthError::BadOption { option, value, remedy: "give a part from 0 to below 0.9" });
    }
    Ok(())
}

/// Outcome of a calibration by measured lengths.
#[derive(Debug, Clone)]
pub struct LengthReport {
    /// Rows that the fit saw, without rejected ones.
    pub fitted: Stages,
    /// Held-out rows, without those whose own data contradict each other and those in faulty runs.
    pub held_out: Stages,
    /// All held-out rows.
    pub held_out_with_rejected: Stages,
    /// Each row, rejected or not.
    pub errors: RowErrors,
    /// Drift of the instrument's zero, where left-out rows asked for it; it is part of the last stage of all figures.
    pub drift: Option<Drift>,
    /// Kinds of joint errors, taken or not.
    pub terms: Vec<Candidate>,
    /// Rows that did not take part, and why.
    pub rejected: Vec<RejectedRow>,
    /// Faulty runs, with what would explain them.
    pub runs: Vec<FaultyRun>,
    /// Standard deviation of a length, from the spread of the residuals \[m\].
    pub length_sigma_m: f64,
    /// The last solve.
    pub solution: Solution,
    /// The calibrated model.
    pub model: Model,
}

impl LengthReport {
    /// Standard deviation of a parameter, SI; none where it was fixed.
    pub fn sigma(&self, id: ParameterId) -> Option<f64> {
        self.solution.covariance.sigma(self.model.column_of(id)?)
    }
}

/// Rows whose controller position is not where their joint angles put the flange.
fn contradicting(rows: &[LengthRow], robot: &Chain) -> Vec<RejectedRow> {
    /// Above what controllers round, and nominal links they know better \[m\].
    const TOLERANCE_M: f64 = 5e-3;
    let distance_m = |row: &LengthRow| {
        let claimed_m = row.flange_m.map(Vector3::from)?;
        Some((robot.forward(&row.joints_rad).translation.vector - claimed_m).norm())
    };
    let rejected = |(index, row): (usize, &LengthRow)| {
        let distance_m = distance_m(row).filter(|distance_m| *distance_m > TOLERANCE_M)?;
        Some(RejectedRow { row: index, why: Rejection::FlangeContradicts { distance_m } })
    };
    rows.iter().enumerate().filter_map(rejected).collect()
}

/// The rows of a wire solved with what is free in the model, which is left at the solution.
fn solved(
    wire: Wire,
    model: &mut Model,
    loss: LossName,
    kinds: Vec<Kind>,
) -> Result<(Solved, Wire), CalibrateError> {
    let mut runs = [Run { instrument: Instrument::Wire(wire), model: model.clone() }];
    let solved = estimate(&mut runs, &Plan::new(loss, kinds))?;
    let [Run { instrument, model: found }] = runs;
    let Instrument::Wire(wire) = instrument else { return Err(CalibrateError::NoRun) };
    *model = found;
    Ok((solved, wire))
}

/// Calibrates a robot from poses with a measured length each; rows in the order in which they were measured.
///
/// `robot` is the nominal chain to the flange. Rows whose controller position contradicts their joint angles are
/// rejected everywhere. Single gross residuals are rejected from the fit only; faulty runs everywhere, but judged by
/// their fitting rows alone; with a drift they take part again. Lengths of held-out rows decide nothing.
///
/// # Errors
/// [`LengthError`] for rows, options or geometry that allow no calibration.
pub fn calibrate(
    rows: &[LengthRow],
    robot: &Chain,
    options: &LengthOptions,
) -> Result<LengthReport, LengthError> {
    check(rows, options)?;
    let joints = || rows.iter().map(|row| row.joints_rad);
    let (groups, states) = (options.hold_out.groups(robot, joints()), standing(joints()));
    let split = split::split(&groups, options.held_out, options.seed);
    let mut rejected = contradicting(rows, robot);
    let fitting = without(&split.fitting, &rejected);
    if fitting.len() < ROWS_MIN {
        return Err(LengthError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
    }
    let all = Wire::new(Standing::new(rows, &states, &groups, options.seed));
    let chosen = all.chosen(&fitting);
    let mut model = Model::measured_length(robot);
    let waves = waves_per_turn(fitting.len(), robot.links.len());
    let with_waves = model.clone().with_joint_waves(ParameterId::joint_waves(waves));
    if let Some(&id) = options.fix.iter().find(|id| with_waves.parameter(**id).is_none()) {
        return Err(ModelError::NotInModel { id }.into());
    }
    if !chosen.place(&mut model, &options.fix)? {
        return Err(LengthError::NoAnchor);
    }
    solved(chosen.clone(), &mut model, options.loss, Vec::new())?;
    let nominal = all.errors(&model.geometry(&[]));
    let sigmas = [options.link_sigma_m, options.link_sigma_rad];
    free_links(&mut model, &link_ids(robot), &options.fix, sigmas, TOLERANCE)?;
    let (of_links, wire) = solved(chosen.clone(), &mut model, options.loss, Vec::new())?;
    let links = all.errors(&model.geometry(&[]));
    let row_of = |one: &RejectedRow| RejectedRow { row: fitting[one.row], ..*one };
    let kept = without(&fitting, &wire.rejected().iter().map(row_of).collect::<Vec<_>>());
    let faulty = faulty(&all.residuals_m(&model.geometry(&[])), &fitting, &kept);
    let kept = without(&fitting, &faulty);
    if kept.len() < ROWS_MIN.max(fitting.len() / 2) {
        return Err(LengthError::TooManyRejected { kept: kept.len(), rows: fitting.len() });
    }
    let known: Vec<usize> = rejected.iter().map(|one| one.row).collect();
    rejected.extend(faulty.iter().filter(|one| !known.contains(&one.row)));
    rejected.sort_by_key(|one| one.row);

    let sigma_m = of_links.sigmas.first().copied().unwrap_or_default();
    // Faulty runs take part: what moved their zero is part of a drift.
    let single = |one: &&RejectedRow| matches!(one.why, Rejection::GrossResidual { .. });
    let singles: Vec<RejectedRow> = faulty.iter().filter(single).copied().collect();
    let fitting = without(&fitting, &singles);
    let drift = drift::find(&mut model, &all, &fitting, &groups, sigma_m, options.seed)?;
    let offered = |id: &ParameterId| with_waves.parameter(*id).is_some() && !options.fix.contains(id);
    model = model.with_joint_waves(ParameterId::joint_waves(waves));
    let (drift, drift_m, chosen, loss) = match drift {
        // From here on the drift is known.
        Some((drift, drift_m)) => {
            let chosen = all.plus(&drift_m).chosen(&fitting);
            (Some(drift), drift_m, chosen, LossName::Huber)
        }
        None => (None, vec![0.0; rows.len()], chosen, options.loss),
    };
    let (Solved { solution, candidates, sigmas, .. }, _) =
        solved(chosen, &mut model, loss, kinds(waves, offered))?;
    // Without the drift there.
    let steady = all.plus(&drift_m).errors(&model.geometry(&[]));
    let Split { fitting: fitted, held_out } = split;
    let errors = RowErrors { stages: [nominal, links, steady], fitted, held_out };
    Ok(LengthReport {
        fitted: errors.of(&without(&errors.fitted, &rejected)),
        held_out: errors.of(&without(&errors.held_out, &rejected)),
        held_out_with_rejected: errors.of(&errors.held_out),
        errors,
        drift,
        terms: candidates,
        runs: runs::runs(&model, &all, &rejected),
        rejected,
        length_sigma_m: sigmas.first().copied().unwrap_or_default(),
        solution,
        model,
    })
}
