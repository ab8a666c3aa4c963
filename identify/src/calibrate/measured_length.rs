//! Calibration from poses with a measured length each: a draw-wire or a telescoping bar between robot and cell.
//!
//! Unknown are the anchor in the cell, the attachment on the flange, a constant length offset, and the robot's links.
//! The links get priors from tolerances instead of being dropped by hand: one length per pose leaves many directions
//! weak. Lengths have heavy tails (the wire sags, catches, is read late), so the loss is robust and narrowed step by
//! step. What rows next to each other are off by together is a drift of the instrument's zero ([`Drift`]), which is taken
//! into the solve where left-out rows ask for it. Rows are held out by a fixed seed and never seen by the fit; the figures on them are what counts.

mod drift;
mod error;
mod figures;
mod report;
mod runs;
mod screen;

use super::ball_bar::CalibrateError;
use super::links::{free_links, standard_ids};
use super::split::{self, HoldOut};
use crate::cost::{DataSets, SharedColumns};
use crate::instrument::{LengthRow, Measures, Standing, Wire};
use crate::kinematics::Chain;
use crate::model::{JointState, Model, ModelError, ParameterId};
use crate::solver::{LossName, Options, Solution, solve_robust};

pub use drift::Drift;
pub use error::LengthError;
pub use figures::{ErrorFigures, Figures};
pub use report::{LengthReport, ParameterEstimate, RejectedRow, Rejection};
pub use runs::{FaultyRun, RunCause};

/// How the calibration is done.
#[derive(Debug, Clone, PartialEq)]
pub struct LengthOptions {
    /// What is held out together, from the figures and from each fold of the choice of a drift.
    pub hold_out: HoldOut,
    /// Part of the rows that the fit never sees.
    pub held_out: f64,
    /// Seed of the choice of rows.
    pub seed: u64,
    /// How much rows count that do not fit.
    pub loss: LossName,
    /// Standard deviation of a length \[m\]; none takes it from the spread of the residuals before the robot is fitted.
    pub length_sigma_m: Option<f64>,
    /// Prior of the links' lengths around nominal, one standard deviation \[m\].
    pub link_sigma_m: f64,
    /// Prior of the links' angles around nominal, one standard deviation \[rad\].
    pub link_sigma_rad: f64,
    /// A row is rejected where controller and joint angles place the flange further apart than this \[m\].
    pub flange_tolerance_m: f64,
    /// A fitting row is rejected where its residual exceeds this many robust standard deviations.
    pub residual_limit: f64,
    /// A run of rows is rejected where the median residual of neighbouring fitting rows exceeds this many robust
    /// standard deviations: a slipped zero, a joint logged with another sign. None keeps them.
    pub run_limit: Option<f64>,
    /// A drift of the instrument's zero along the file may be taken.
    pub drift: bool,
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
            length_sigma_m: None,
            link_sigma_m: 1e-2,
            link_sigma_rad: 1e-2,
            flange_tolerance_m: 5e-3,
            residual_limit: 8.0,
            run_limit: Some(3.0),
            drift: true,
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
    let positive = [
        ("link_sigma_m", options.link_sigma_m),
        ("link_sigma_rad", options.link_sigma_rad),
        ("length_sigma_m", options.length_sigma_m.unwrap_or(1.0)),
        ("flange_tolerance_m", options.flange_tolerance_m),
        ("residual_limit", options.residual_limit),
        ("run_limit", options.run_limit.unwrap_or(1.0)),
    ];
    for (option, value) in positive {
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

/// Chosen rows.
fn wire(rows: &[LengthRow], chosen: &[usize]) -> Wire {
    let chosen: Vec<LengthRow> = chosen.iter().filter_map(|&row| rows.get(row).copied()).collect();
    let states: Vec<JointState> = chosen.iter().map(|row| JointState::at_rest(row.joints_rad)).collect();
    Wire::new(Standing::new(&chosen, &states, &vec![0; chosen.len()], 0))
}

/// Solves for what is free in the model and takes the solution over.
fn fit(
    model: &mut Model,
    rows: &[LengthRow],
    chosen: &[usize],
    loss: LossName,
    sigma_m: f64,
) -> Result<Solution, LengthError> {
    let (wire, columns) = (wire(rows, chosen), SharedColumns::new([&*model], |_| false));
    let problem = DataSets::new(vec![wire.data_set(model, sigma_m).map_err(CalibrateError::from)?], &columns);
    let solution =
        solve_robust(&problem, &model.start(), loss, &Options::default()).map_err(CalibrateError::from)?;
    let solution = solution.identified().map_err(CalibrateError::from)?;
    drop(problem);
    model.adopt(&solution.x);
    Ok(solution)
}

/// Residual of every row \[m\].
fn residuals_m(model: &Model, rows: &[LengthRow]) -> Vec<f64> {
    wire(rows, &(0..rows.len()).collect::<Vec<_>>()).residuals_m(&model.geometry(&[]))
}

/// Anchor, attachment and offset with the robot as it is.
fn fit_wire(
    model: &mut Model,
    rows: &[LengthRow],
    chosen: &[usize],
    options: &LengthOptions,
) -> Result<(), LengthError> {
    if !wire(rows, chosen).place(model, &options.fix)? {
        return Err(LengthError::NoAnchor);
    }
    fit(model, rows, chosen, options.loss, 1.0).map(drop)
}

/// Fits wire and links, each round without the rows that the round before found faulty, until none changes.
///
/// Every round judges all fitting rows anew: as the fit improves, smaller faults show, and rows rejected too early
/// come back.
fn fit_links(
    model: &mut Model,
    rows: &[LengthRow],
    fitting: &[usize],
    options: &LengthOptions,
) -> Result<LinkFit, LengthError> {
    const ROUNDS_MAX: usize = 20;
    /// The scale changes less than this from round to round.
    const SCALE_SETTLED: f64 = 0.02;
    let mut found = screen::faulty(&residuals_m(model, rows), fitting, fitting, options);
    let links = standard_ids(model);
    free_links(model, &links, &options.fix, [options.link_sigma_m, options.link_sigma_rad])?;
    for _ in 0..ROUNDS_MAX {
        let kept = screen::without(fitting, &found);
        if kept.len() < ROWS_MIN.max(fitting.len() / 2) {
            return Err(LengthError::TooManyRejected { kept: kept.len(), rows: fitting.len() });
        }
        let sigma_m = scale_m(model, rows, &kept, options);
        let solution = fit(model, rows, &kept, options.loss, sigma_m)?;
        let again = screen::faulty(&residuals_m(model, rows), fitting, &kept, options);
        let rescaled = scale_m(model, rows, &kept, options) / sigma_m - 1.0;
        let settled = screen::same_rows(&again, &found) && rescaled.abs() < SCALE_SETTLED;
        let rejected = std::mem::replace(&mut found, again);
        if settled {
            return Ok(LinkFit { solution, sigma_m, rejected });
        }
    }
    // Rows at the limit may change places for ever; the last choice is as good as any.
    let kept = screen::without(fitting, &found);
    let sigma_m = scale_m(model, rows, &kept, options);
    let solution = fit(model, rows, &kept, options.loss, sigma_m)?;
    Ok(LinkFit { solution, sigma_m, rejected: found })
}

/// Outcome of [`fit_links`].
struct LinkFit {
    solution: Solution,
    sigma_m: f64,
    rejected: Vec<RejectedRow>,
}

/// A fit with a drift.
struct Drifted {
    drift: Drift,
    drift_m: Vec<f64>,
    solution: Solution,
}

impl Drifted {
    /// Takes a drift into the fit if left-out rows ask for it. Faulty runs take part: what moved their zero is part of it.
    fn find(
        model: &mut Model,
        rows: &[LengthRow],
        fitting: &[usize],
        faulty: &[RejectedRow],
        sigma_m: f64,
        groups: &[usize],
        options: &LengthOptions,
    ) -> Result<Option<Self>, LengthError> {
        if !options.drift {
            return Ok(None);
        }
        let single = |r: &&RejectedRow| matches!(r.why, Rejection::GrossResidual { .. });
        let singles: Vec<RejectedRow> = faulty.iter().filter(single).copied().collect();
        let fitting = screen::without(fitting, &singles);
        let folds = split::folds(groups, &fitting, drift::FOLDS, options.seed.wrapping_add(1));
        let Some(drift) = drift::choose(model, rows, &fitting, &folds, sigma_m)? else { return Ok(None) };
        let drift_m = drift::fit(model, rows, &fitting, &drift)?;
        // Once more with the drift as known: it stays where it is, and the solver tells of rank and covariance.
        let mut steady = rows.to_vec();
        steady.iter_mut().zip(&drift_m).for_each(|(row, drift_m)| row.length_m += drift_m);
        let solution = fit(model, &steady, &fitting, LossName::Huber, drift.white_m)?;
        Ok(Some(Self { drift, drift_m, solution }))
    }

    /// Residual of every row without the drift there \[m\].
    fn residuals_m(&self, model: &Model, rows: &[LengthRow]) -> Vec<f64> {
        residuals_m(model, rows).iter().zip(&self.drift_m).map(|(r, drift)| r - drift).collect()
    }
}

/// Standard deviation of a length \[m\]: given, or from the rows as they fit now.
fn scale_m(model: &Model, rows: &[LengthRow], kept: &[usize], options: &LengthOptions) -> f64 {
    let estimated = || screen::robust_sigma(&figures::pick(&residuals_m(model, rows), kept));
    options.length_sigma_m.unwrap_or_else(estimated)
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
    let groups = options.hold_out.groups(robot, rows.iter().map(|row| row.joints_rad));
    let split = split::split(&groups, options.held_out, options.seed);
    let mut rejected = screen::contradicting(rows, robot, options.flange_tolerance_m);
    let fitting = screen::without(&split.fitting, &rejected);
    if fitting.len() < ROWS_MIN {
        return Err(LengthError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
    }
    let mut model = Model::measured_length(robot);
    if let Some(&id) = options.fix.iter().find(|id| model.parameter(**id).is_none()) {
        return Err(ModelError::NotInModel { id }.into());
    }
    fit_wire(&mut model, rows, &fitting, options)?;
    let before = residuals_m(&model, rows);
    let LinkFit { solution, sigma_m, rejected: faulty } = fit_links(&mut model, rows, &fitting, options)?;
    let robot_alone = residuals_m(&model, rows);
    let drifted = Drifted::find(&mut model, rows, &fitting, &faulty, sigma_m, &groups, options)?;
    let after = drifted.as_ref().map_or_else(|| robot_alone.clone(), |found| found.residuals_m(&model, rows));
    let known: Vec<usize> = rejected.iter().map(|r| r.row).collect();
    rejected.extend(faulty.into_iter().filter(|r| !known.contains(&r.row)));
    rejected.sort_by_key(|r| r.row);
    let runs = runs::runs(&model, rows, &rejected);
    let (solution, sigma_m, drift) = match drifted {
        Some(Drifted { drift, solution, .. }) => (solution, drift.white_m, Some(drift)),
        None => (solution, sigma_m, None),
    };
    solution.summary.require_converged().map_err(CalibrateError::from)?;
    Ok(report::assemble(report::Outcome {
        model,
        solution,
        before,
        robot_alone,
        after,
        split,
        rejected,
        runs,
        sigma_m,
        drift,
    }))
}
