//! Any mix of instruments on one robot, in one solve: they share the robot, and each data set counts as much as what its own
//! residuals show it to be worth.

use shared::config::RobotConfig;

use super::ball_bar::{RunInput, calibrate_runs, prepared_runs, set_roles, tolerances};
use super::calibration::Calibration;
use super::change;
use super::error::CalibrateError;
use super::pipeline::{Plan, Solved, estimate, refit, waves_per_turn};
use super::rows::{self, RowSet};
use super::validation::deployment::{Deployment, fitted};
use super::{IdentifyConfig, SelectionName};
use crate::instrument::{Rows, Run, ScaleFrom};
use crate::kinematics::flange_chain;
use crate::model::{DriveTrain, Model, Parameter, ParameterId, Unit};
use crate::solver::{LossName, Watch};

/// What was measured on one robot.
#[derive(Debug, Clone, Default)]
pub struct DataSets<'a> {
    /// Runs with the ball-bar.
    pub bars: Vec<RunInput<'a>>,
    /// Files of other instruments.
    pub rows: Vec<Rows>,
}

/// Without any run of the ball-bar none of its options is given.
///
/// # Errors
/// [`CalibrateError::NoEffect`] names one that is.
fn check(data: &DataSets<'_>, config: &IdentifyConfig) -> Result<(), CalibrateError> {
    if !data.bars.is_empty() {
        return Ok(());
    }
    let usual = IdentifyConfig::default();
    let terms = (&config.joint_terms, &usual.joint_terms);
    let follows_log = data.rows.iter().any(|rows| rows.instrument.first_s().is_some());
    let of_bars = [
        ("cost", config.cost != usual.cost),
        ("encoder_harmonics_urad", config.encoder_harmonics_urad != usual.encoder_harmonics_urad),
        ("bar_length_um", config.bar_length_um != usual.bar_length_um),
        ("joint_terms.amplitude_urad", terms.0.amplitude_urad != terms.1.amplitude_urad),
        ("joint_terms.ratio_ppm", terms.0.ratio_ppm != terms.1.ratio_ppm),
        ("joint_terms.delay_ms", terms.0.delay_ms != terms.1.delay_ms),
        ("joint_terms.compliance_urad_per_m", terms.0.compliance_urad_per_m != terms.1.compliance_urad_per_m),
        ("noise", config.noise != usual.noise),
        ("prepare", config.prepare != usual.prepare && !follows_log),
    ];
    match of_bars.into_iter().find(|(_, is_given)| *is_given) {
        Some((option, _)) => Err(CalibrateError::NoEffect { option }),
        None => Ok(()),
    }
}

/// Data sets with their models at the nominal robot, and how they are solved.
struct LaidOut<'w> {
    /// Of files of rows those that the fit sees.
    runs: Vec<Run>,
    rows: Vec<RowSet>,
    plan: Plan<'w>,
}

/// The longest of the lengths of links that are estimated.
fn longest_length(model: &Model) -> Option<ParameterId> {
    let is_length = |one: &&Parameter| {
        matches!(one.id, ParameterId::Robot { .. }) && one.id.unit() == Unit::Metre && one.role.is_estimated()
    };
    let lengths = model.parameters().iter().filter(is_length);
    let longest = lengths.max_by(|a, b| a.nominal.abs().total_cmp(&b.nominal.abs()))?;
    Some(longest.id)
}

/// What is free in the models, and where instruments stand for the nominal robot; of files of rows a part is held out where they
/// are `judged`.
fn laid_out<'w>(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    judged: bool,
    watch: Option<&'w dyn Watch>,
) -> Result<LaidOut<'w>, CalibrateError> {
    let flange = flange_chain(robot);
    let mut plan = Plan {
        loss: config.loss.unwrap_or(LossName::Huber),
        groups: Vec::new(),
        tolerances: Vec::new(),
        alike: config.alike().collect(),
        fix: config.fixed(),
        watch,
    };
    let mut runs = prepared_runs(&data.bars, robot, config)?;
    set_roles(&mut runs, config, &[])?;
    let mut rows = Vec::new();
    for file in &data.rows {
        let data_set = runs.len() + 1;
        let bad = |error| CalibrateError::Rows { data_set, error };
        let alone = data.bars.is_empty() && data.rows.len() == 1;
        let contradicting = rows::checked(&file.instrument, alone, &flange).map_err(bad)?;
        let mut set = RowSet::new(file.grouped(&flange), contradicting, judged);
        let model = file.instrument.at_nominal(&flange);
        let model = model.with_drives(DriveTrain::of(robot, &flange)).with(config.named());
        let mut run = Run { instrument: set.fitting(), model };
        if !run.instrument.place(&mut run.model, &plan.fix)? {
            return Err(CalibrateError::NoPlace { data_set });
        }
        if run.model.columns().len() > 0 {
            let plan = Plan { watch, ..Plan::new(LossName::Huber, Vec::new()) };
            let placed = estimate(std::slice::from_mut(&mut run), &plan);
            // Lengths in another unit may allow no solution at all.
            rows::unless_other_unit(set.whole(), &run.model, &flange)?;
            placed?;
        }
        set.judge_nominal(&run.model);
        rows.push(set);
        runs.push(run);
    }
    for Run { model, .. } in &mut runs[data.bars.len()..] {
        config.set_link_roles(model)?;
    }
    // Without any scale a smaller robot between nearer faces fits as well: its longest link then keeps its length.
    if runs.iter().all(|run| run.instrument.scale() == ScaleFrom::Robot) {
        let longest = runs.first().and_then(|run| longest_length(&run.model));
        for Run { model, .. } in &mut runs {
            longest.iter().try_for_each(|id| config.consider(model, *id))?;
        }
    }
    config.require_known(runs.iter().map(|run| &run.model))?;
    plan.tolerances = tolerances(&runs, config);
    plan.groups = if data.bars.is_empty() {
        let measured =
            |run: &Run| Ok(run.instrument.samples() * run.instrument.data_set(&run.model, 1.0)?.rows());
        let measured = runs.iter().map(measured).sum::<Result<_, CalibrateError>>()?;
        let asked = data.rows.iter().filter_map(|file| file.joint_waves).min();
        let last = asked.unwrap_or_else(|| waves_per_turn(measured, flange.links.len()));
        for run in &mut runs {
            run.model = run.model.clone().with(ParameterId::joint_waves(last));
        }
        let known = |id: &ParameterId| runs.iter().any(|run| run.model.parameter(*id).is_some());
        let mut groups = rows::groups(last, |id| known(id) && !config.named().any(|named| named == *id));
        groups.retain(|group| config.joint_terms.candidates.contains(&group.group));
        groups
    } else {
        let Run { instrument, model } = &runs[0];
        config.groups(model, |id| instrument.identifies(id))
    };
    Ok(LaidOut { runs, rows, plan })
}

/// Estimates the robot from all data sets together, each number of its links expected at nominal within the configured
/// tolerance, which is widened until left-out groups of samples are predicted best; runs with the ball-bar alone as
/// [`super::ball_bar::calibrate_runs`] does. A fifth of each file of rows is predicted by a fit of everything else, and then takes
/// part; nothing is held out where the rest is too little. `watch` sees each solve and may end it.
///
/// # Errors
/// [`CalibrateError`].
pub fn calibrate(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    if config.selection != SelectionName::Cell {
        return Err(CalibrateError::Selection(config.selection.name()));
    }
    if data.rows.is_empty() {
        return calibrate_runs(&data.bars, robot, config, watch);
    }
    check(data, config)?;
    let failed = match staged(data, robot, config, true, watch) {
        Err(error) if error.is_of_solve() => error,
        done => return done,
    };
    if let Some(likely) = rows::likely_of_all(&data.rows, &flange_chain(robot)) {
        return Err(CalibrateError::Implausible { found: failed.to_string(), likely: Some(likely) });
    }
    let found = staged(data, robot, config, false, watch)?;
    tracing::warn!("no rows are predicted by a solve without them: {failed}");
    Ok(found)
}

/// The same, with rows held out where they are to be `judged`.
fn staged(
    data: &DataSets<'_>,
    robot: &RobotConfig,
    config: &IdentifyConfig,
    judged: bool,
    watch: Option<&dyn Watch>,
) -> Result<Calibration, CalibrateError> {
    let flange = flange_chain(robot);
    let LaidOut { mut runs, mut rows, plan } = laid_out(data, robot, config, judged, watch)?;
    let bars = data.bars.len();
    // What rows that do not belong with the rest, and a drift, are judged by.
    let of_links = Plan { groups: Vec::new(), tolerances: Vec::new(), alike: Vec::new(), ..plan.clone() };
    let Solved { sigmas, .. } = estimate(&mut runs, &of_links)?;
    let offsets = fitted(&runs, Deployment::Offsets, plan.loss, watch)?;
    let offsets = offsets.map_or_else(Vec::new, |found| found.runs);
    for (number, set) in rows.iter_mut().enumerate() {
        let run = &mut runs[bars + number];
        set.judge_links(offsets.get(bars + number).map(|run| &run.model), &run.model);
        set.screen(bars + number + 1, run, sigmas[bars + number])?;
    }
    let Solved { candidates, prior_scale, without_terms, .. } = estimate(&mut runs, &plan)?;
    rows.iter_mut().zip(&runs[bars..]).for_each(|(set, run)| set.judge_joints(&run.model));
    rows::unless_implausible(&data.rows, &rows, &runs, &flange)?;
    // What was held out has judged: now it takes part.
    for (set, run) in rows.iter_mut().zip(&mut runs[bars..]) {
        set.leave_out_gross(&run.model);
        run.instrument = set.everything(&run.model)?;
    }
    let (columns, mut solution, sigmas) = refit(&mut runs, plan.loss, watch)?;
    for ((number, set), run) in (bars..).zip(&rows).zip(&runs[bars..]) {
        let times = set.widens(&run.model, sigmas[number])?;
        solution.covariance = solution.covariance.widened(number, times);
    }
    let changed = change::checked(&runs, &sigmas, &config.prepare)?;
    let solved = Solved { columns, solution, without_terms, candidates, prior_scale, sigmas };
    Ok(Calibration { runs, rows, solved, changed, loss: plan.loss })
}
