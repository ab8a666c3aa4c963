//! The calibration: computes a [`Calibration`] from data sets and the nominal robot. The commands of `identify` and
//! the studies call it.
//!
//! 1. Creates the model of each data set (`lay_out`).
//! 2. Finds outliers and drifts in files of rows, with a first fit of the link parameters alone (`screen_rows`).
//! 3. Fits the robot and chooses its error terms (`estimate`).
//! 4. Evaluates the held-out rows, refuses implausible rows, and fits all valid rows (`fit_all_rows`).
//! 5. Tests the solution for contradicted priors and for changes during the measurement.
//!
//! All data sets share the robot. The weight of each data set is determined from its own residuals.

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

/// Estimates the robot from all data sets.
///
/// Each link parameter has a prior at its nominal value, with the configured tolerance. The tolerance is widened
/// until left-out groups of samples are predicted best. All ball-bar runs have common link parameters of the bar.
/// Each run has its own clock, position of the bar and encoder offsets. If a length of the bar differs between runs,
/// each run has its own value of this length.
///
/// A fifth of each file of rows is held out and predicted by a fit to all other data. A last fit then includes the
/// held-out rows. If the solve without these rows fails, the calibration is repeated without held-out rows. `watch`
/// observes each solve and may cancel it.
///
/// # Errors
/// [`CalibrateError`] if the data are refused or a solve fails. If a calibration is returned, it has converged, and each of
/// its free parameters is identified and has a standard deviation.
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
    // If a mistake in a file of rows explains the error, report the mistake.
    if let Some(likely) = rows::likely_of_all(&data.rows, &flange_chain(robot)) {
        // The remedy of the error is omitted, because the mistake has a remedy of its own.
        return Err(CalibrateError::Implausible { found: error.problem(), likely: Some(likely) });
    }
    // Without the held-out rows, the data may be too few. Try again with all rows.
    if !error.may_need_all_rows() {
        return Err(error);
    }
    let calibration = calibrate_in_stages(data, robot, config, false, watch)?;
    tracing::warn!("errors on held-out rows are not determined: {error}");
    Ok(calibration)
}

/// Prepares and solves one ball-bar run. `encoders` lists the encoders of the recording, in the order of the recording.
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

/// Runs the stages of a calibration. If `held_out` is true, a fifth of each file of rows is held out, predicted,
/// and only included in the last fit.
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
        // Ball-bar runs are first, followed by the runs of the files of rows.
        let runs_of_rows = &runs[data.bars.len()..];
        rows.iter_mut().zip(runs_of_rows).for_each(|(set, run)| set.judge_joints(&run.model));
        rows::unless_implausible(&data.rows, &rows, &runs, &flange_chain(robot))?;
        // The errors of the held-out rows have been recorded, so these rows can now be included.
        solved = fit_all_rows(&mut runs, &mut rows, &plan, solved)?;
    }
    solved.solution.require_sigmas()?;
    let contradicted = Contradicted::new(&runs, &solved);
    solved.solution.covariance = contradicted.added_to(&solved, &runs[0].model);
    let changed = change::checked(&runs, &solved.sigmas, &config.prepare)?;
    Ok(Calibration { runs, rows, solved, contradicted, changed, loss: plan.loss })
}

/// Detects outlier rows and drifts in files of rows. Uses the residuals at the best link parameters, without error terms.
/// The last elements of `runs` belong to the files of rows.
fn screen_rows(runs: &mut [Run], rows: &mut [RowSet], plan: &Plan<'_>) -> Result<(), CalibrateError> {
    // Two fits to the rows that are not held out: all link parameters, then only the joint offsets.
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

/// Fits all valid rows, including the held-out ones. The fit starts at `solved`, the solution
/// for the rows that were not held out.
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
    rows::widen_for_drifts(runs, rows, &mut all)?;
    Ok(all)
}
