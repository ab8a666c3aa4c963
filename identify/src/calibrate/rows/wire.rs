//! Calibration from poses with a measured length each: a draw-wire or a telescoping bar between robot and cell.
//!
//! Unknown of the wire are the anchor in the cell, the attachment on the flange and a constant length offset. What rows next to
//! each other are off by together is a drift of its zero ([`Drift`](super::Drift)), which is taken where left-out rows ask for
//! it.

use nalgebra::Vector3;
use shared::config::RobotConfig;

use super::implausible::{reasons, unless};
use super::{RowCalibration, RowError, RowErrors, RowOptions, drift, faulty_runs};
use crate::calibrate::ball_bar::CalibrateError;
use crate::calibrate::change::changes;
use crate::calibrate::deployment::{Deployment, deployed, fitted};
use crate::calibrate::pipeline::{Plan, Solved, estimate, refit, waves_per_turn};
use crate::calibrate::split::{self, Split};
use crate::calibrate::terms::Kind;
use crate::cost::{MeasuredLength, Residual};
use crate::instrument::{
    Instrument, LengthRow, Measures, RejectedRow, Rejection, Run, Standing, Wire, faulty, standing, without,
};
use crate::kinematics::{Chain, flange_chain};
use crate::model::{DriveTrain, Model, ParameterId};
use crate::solver::LossName;

/// Fewest rows of a fit: the seven unknowns of the wire and as many again.
const ROWS_MIN: usize = 14;

fn check_rows(rows: &[LengthRow]) -> Result<(), RowError> {
    for (index, row) in rows.iter().enumerate() {
        let bad = |what| Err(RowError::BadRow { row: index + 1, what });
        if !row.joints_rad.iter().chain(row.flange_m.iter().flatten()).all(|v| v.is_finite()) {
            return bad("a number that is not finite");
        }
        if !(row.length_m.is_finite() && row.length_m > 0.0) {
            return bad("a length that is not above zero");
        }
    }
    Ok(())
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
/// Rows whose controller position contradicts their joint angles are
/// rejected everywhere. Single gross residuals are rejected from the fit only; faulty runs everywhere, but judged by
/// their fitting rows alone; with a drift they take part again. Lengths of held-out rows decide nothing.
///
/// # Errors
/// [`RowError`] for rows, options or geometry that allow no calibration.
pub fn calibrate(
    rows: &[LengthRow],
    robot: &RobotConfig,
    options: &RowOptions,
) -> Result<RowCalibration, RowError> {
    check_rows(rows)?;
    options.check()?;
    let chain = &flange_chain(robot);
    let joints = || rows.iter().map(|row| row.joints_rad);
    let (groups, states) = (options.hold_out.groups(chain, joints()), standing(joints()));
    let split = split::split(&groups, options.held_out, options.seed);
    let mut rejected = contradicting(rows, chain);
    let fitting = without(&split.fitting, &rejected);
    let usable = without(&(0..rows.len()).collect::<Vec<_>>(), &rejected);
    if fitting.len() < ROWS_MIN {
        return Err(RowError::TooFewRows { rows: fitting.len(), needed: ROWS_MIN });
    }
    let all = Wire::new(Standing::new(rows, &states, &groups, options.seed));
    let chosen = all.chosen(&fitting);
    let mut model = Model::measured_length(chain).with_drives(DriveTrain::of(robot, chain));
    let waves = waves_per_turn(fitting.len(), chain.links.len()).min(options.waves_per_turn_max);
    let kinds = options.kinds(&model, waves)?;
    if !chosen.place(&mut model, &options.fix)? {
        return Err(RowError::NoAnchor);
    }
    solved(chosen.clone(), &mut model, options.loss, Vec::new())?;
    let nominal = all.errors(&model.geometry(&[]));
    options.free_links(&mut model, chain)?;
    let (of_links, wire) = solved(chosen.clone(), &mut model, options.loss, Vec::new())?;
    let links = all.errors(&model.geometry(&[]));
    let run = Run { instrument: Instrument::Wire(chosen.clone()), model: model.clone() };
    let offsets =
        fitted(&[run], Deployment::Offsets, options.loss)?.and_then(|found| found.runs.into_iter().next());
    let offsets = offsets.map_or_else(Vec::new, |run| all.errors(&run.model.geometry(&[])));
    let row_of = |one: &RejectedRow| RejectedRow { row: fitting[one.row], ..*one };
    let kept = without(&fitting, &wire.rejected().iter().map(row_of).collect::<Vec<_>>());
    let faulty = faulty(&all.residuals_m(&model.geometry(&[])), &fitting, &kept);
    let kept = without(&fitting, &faulty);
    if kept.len() < ROWS_MIN.max(fitting.len() / 2) {
        return Err(RowError::TooManyRejected { kept: kept.len(), rows: fitting.len() });
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
    model = model.with_joint_waves(ParameterId::joint_waves(waves));
    let (drift, drift_m, chosen, loss) = match drift {
        // From here on the drift is known.
        Some((drift, drift_m)) => {
            let chosen = all.plus(&drift_m).chosen(&fitting);
            (Some(drift), drift_m, chosen, LossName::Huber)
        }
        None => (None, vec![0.0; rows.len()], chosen, options.loss),
    };
    let (Solved { candidates, .. }, _) = solved(chosen, &mut model, loss, kinds)?;
    // Without the drift there.
    let steady = all.plus(&drift_m).errors(&model.geometry(&[]));
    let runs = faulty_runs::runs(&model, &all, &rejected);
    // What was held out has judged: now it takes part.
    let everything = match &drift {
        Some(drift) => {
            let usable = without(&usable, &singles);
            let drift_m = drift::fit(&mut model.clone(), &all, &usable, drift)?;
            all.plus(&drift_m).chosen(&usable)
        }
        None => all.chosen(&usable),
    };
    let mut all_rows = [Run { instrument: Instrument::Wire(everything), model }];
    let (_, mut solution, sigmas) = refit(&mut all_rows, loss)?;
    if let (Some(drift), [Run { model, .. }], [sigma_m]) = (&drift, &all_rows, &sigmas[..]) {
        let times = drift::widens(model, &all, &without(&usable, &singles), drift, *sigma_m)?;
        solution.covariance = solution.covariance.widened(times);
    }
    let deployed = deployed(&all_rows, loss)?;
    let changed = changes(&all_rows, &sigmas)?;
    let [Run { model, .. }] = all_rows;
    let Split { fitting: fitted, held_out } = split;
    let found = RowCalibration {
        cost: MeasuredLength::NAME,
        errors: RowErrors { stages: [nominal, offsets, links, steady], fitted, held_out },
        runs,
        rejected,
        drift,
        terms: candidates,
        sigma_m: sigmas.first().copied().unwrap_or_default(),
        solution,
        model,
        changed,
        deployed,
    };
    let reasons = reasons(&found, None, chain, options);
    unless(found, &reasons, || None)
}
