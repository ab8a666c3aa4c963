//! The calibration: from data sets and the nominal robot to a [`Calibration`]. All data sets share the robot; each is weighted by
//! its own residuals. Called by the commands of `identify` and by the studies.

use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::calibration::Calibration;
use super::change;
use super::config::IdentifyConfig;
use super::contradicted::Contradicted;
use super::data_sets::{DataSets, RunInput};
use super::error::CalibrateError;
use super::lay_out::{LaidOut, lay_out};
use super::pipeline::{Plan, Solved, estimate, refit};
use super::rows::{self, RowSet};
use super::validation::deployment::{Deployment, fitted};
use crate::instrument::Run;
use crate::kinematics::flange_chain;
use crate::logs::RobotLog;
use crate::solver::Watch;

/// Estimates the robot from all data sets. Each link parameter has a prior at its nominal value with the configured tolerance,
/// which is widened until left-out groups of samples are predicted best. Ball-bar runs share the bar's links; each has its own
/// clock, position of the bar, encoder offsets and, if it differs, length. A fifth of each file of rows is predicted by a fit
/// of all other data and then included. If the other data are too few, nothing is held out. `watch` observes each solve and may
/// cancel it.
///
/// # Errors
/// [`CalibrateError`]: a calibration that is returned has converged, and each of its free parameters is identified and has a
/// standard deviation.
pub fn calibrate(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    data.check(config)?;
    let error = match calibrate_in_stages(data, robot, config, true, watch) {
        Err(error) if error.may_be_a_mistake() && !data.rows.is_empty() => error,
        result => return result,
    };
    if let Some(likely) = rows::likely_of_all(&data.rows, &flange_chain(robot)) {
        // The remedy is that of the mistake.
        let found = error.to_string().split("; ").take(1).collect();
        return Err(CalibrateError::Implausible { found, likely: Some(likely) });
    }
    if !error.is_of_solve() {
        return Err(error);
    }
    let calibration = calibrate_in_stages(data, robot, config, false, watch)?;
    tracing::warn!("errors on held-out rows are not determined: {error}");
    Ok(calibration)
}

/// Prepares and solves one ball-bar run; `encoders` are those of the recording, in its order.
///
/// # Errors
/// As [`calibrate`].
pub fn calibrate_run(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    log: &RobotLog,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    config: &IdentifyConfig,
) -> Result<Calibration, CalibrateError> {
    calibrate_runs(&[RunInput { cycles, encoders, unwrapped: None, log, bar }], robot, config, None)
}

/// Prepares each ball-bar run and solves all of them together.
///
/// # Errors
/// As [`calibrate`].
pub fn calibrate_runs(
    inputs: &[RunInput<'_>],
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    let bars = RunInput::prepare_all(inputs, robot, &config.prepare)?;
    calibrate(&DataSets { bars, rows: Vec::new() }, robot, config, watch)
}

/// The stages of a calibration; with `held_out`, a part of each file of rows is predicted before it is included.
fn calibrate_in_stages(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    held_out: bool,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    let LaidOut { mut runs, mut rows, plan } = lay_out(data, robot, config, held_out, watch)?;
    if !rows.is_empty() {
        screen_rows(&mut runs, &mut rows, &plan)?;
    }
    let mut solved = estimate(&mut runs, &plan)?;
    if !rows.is_empty() {
        // The runs of the files of rows follow those of the ball-bars.
        let runs_of_rows = &runs[data.bars.len()..];
        rows.iter_mut().zip(runs_of_rows).for_each(|(set, run)| set.judge_joints(&run.model));
        rows::unless_implausible(&data.rows, &rows, &runs, &flange_chain(robot))?;
        // The errors of held-out rows are known now, so these rows can be included.
        solved = fit_all_rows(&mut runs, &mut rows, &plan, solved)?;
    }
    solved.solution.require_sigmas()?;
    let contradicted = Contradicted::new(&runs, &solved);
    solved.solution.covariance = contradicted.added_to(&solved, &runs[0].model);
    let changed = change::checked(&runs, &solved.sigmas, &config.prepare)?;
    Ok(Calibration { runs, rows, solved, contradicted, changed, loss: plan.loss })
}

/// Detects outlier rows and a drift in the residuals of the best links. The runs of the files of rows are the last ones.
fn screen_rows(runs: &mut [Run], rows: &mut [RowSet], plan: &Plan<'_>) -> Result<(), CalibrateError> {
    let links_only = Plan { fix: plan.fix.clone(), watch: plan.watch, ..Plan::new(plan.loss) };
    let links = estimate(runs, &links_only)?;
    let offsets_only = fitted(runs, &links, Deployment::Offsets, plan.loss, plan.watch)?;
    let offsets_runs = offsets_only.map_or_else(Vec::new, |(runs, _)| runs);
    let first_of_rows = runs.len() - rows.len();
    for (number, set) in (first_of_rows..).zip(rows) {
        let run = &mut runs[number];
        let offsets = offsets_runs.get(number).map(|run| &run.model);
        set.judge_links(offsets, &run.model);
        set.screen(number + 1, run, offsets, links.sigmas[number])?;
    }
    Ok(())
}

/// The fit to all valid rows, from the solution of a part of them.
fn fit_all_rows(
    runs: &mut [Run],
    rows: &mut [RowSet],
    plan: &Plan<'_>,
    solved: Solved,
) -> Result<Solved, CalibrateError> {
    let first_of_rows = runs.len() - rows.len();
    for (set, run) in rows.iter_mut().zip(&mut runs[first_of_rows..]) {
        set.leave_out_gross(&run.model);
        run.instrument = set.everything(&run.model)?;
    }
    let mut all = refit(runs, plan.loss, plan.watch, solved)?;
    // The covariance of the fit takes a drift of an instrument as known.
    for ((number, set), run) in (first_of_rows..).zip(rows).zip(&runs[first_of_rows..]) {
        let factor = set.widens(&run.model, all.sigmas[number])?;
        all.solution.covariance = all.solution.covariance.widened(number, factor);
    }
    Ok(all)
}
