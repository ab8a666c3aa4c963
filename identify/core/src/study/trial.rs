//! Runs one experiment of a study: simulates it from the study's definition and the conditions, calibrates with every
//! estimator of the figure, and compares the estimates with the simulated truth. The errors are one line of `results`.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;
use shared::time::UtcNs;

use super::{
    Conditions, Definition, Estimator, Figure, FigureKind, FigureSeries, ResultRow, StudyInstrument,
    TrialRows,
};
use crate::calibrate::{BarRun, DataSets, IdentifyConfig, calibrate};
use crate::instrument::Wire;
use crate::logs::Stream;
use crate::model::{Model, Observation, Selection};
use crate::prepare::{AlignedLog, Prepared};
use crate::simulate::{
    ATTACHMENT_M, Design, Experiment, LEAD_ROWS, Pairs, SimulateError, Truth, pairs, wire_rows,
};
use crate::simulate::{Comparison, position_errors_m};
use crate::statistics::mean;

/// One experiment of a study: a combination of figure, series, size and seed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trial<'a> {
    /// Index in the list of all experiments.
    pub number: usize,
    /// Figure that contains the experiment.
    pub figure: &'a Figure,
    /// Series that contains the experiment.
    pub series: &'a FigureSeries,
    /// Size of the varied conditions.
    pub x: f64,
    /// Seed of path and noise, from 1.
    pub seed: u32,
}

/// All experiments of a study, in order.
pub fn trials(definition: &Definition) -> impl Iterator<Item = Trial<'_>> {
    let study = &definition.study;
    let all_series =
        study.figures.iter().flat_map(|figure| figure.series.iter().map(move |series| (figure, series)));
    let sizes = all_series.flat_map(|(figure, series)| series.x.iter().map(move |&x| (figure, series, x)));
    let unnumbered = sizes.flat_map(|(figure, series, x)| {
        (1..=study.seeds).map(move |seed| Trial { number: 0, figure, series, x, seed })
    });
    unnumbered.enumerate().map(|(number, trial)| Trial { number, ..trial })
}

/// Simulates one experiment, and solves it with all estimators of its series. If an estimator fails, its
/// row contains the reason.
pub fn run(definition: &Definition, trial: &Trial<'_>) -> TrialRows {
    let names = definition.study.estimators_of(trial.figure, trial.series);
    let rows = solve_all(definition, trial, names);
    let rows = rows.unwrap_or_else(|reason| vec![ResultRow::failed(reason); names.len()]);
    TrialRows { trial: trial.number, rows }
}

/// One row for each of the named estimators. An error if the experiment cannot be simulated.
fn solve_all(definition: &Definition, trial: &Trial<'_>, names: &[String]) -> Result<Vec<ResultRow>, String> {
    let study = &definition.study;
    let conditions =
        Conditions::from_study(study, trial.series, trial.x).map_err(|error| error.to_string())?;
    let estimators = || names.iter().map(|name| study.estimator(name));
    let is_of_bar = |estimator: &Estimator| estimator.instrument == StudyInstrument::BallBar;
    // All estimators of the ball-bar solve the same simulated readings.
    let is_simulated = estimators().flatten().any(is_of_bar);
    let simulated = is_simulated.then(|| simulate(definition, trial.seed, &conditions)).transpose();
    let simulated = simulated.map_err(|error| error.to_string())?;
    let with_errors = trial.figure.kind != FigureKind::Curves;
    let solve = |estimator: Option<&Estimator>| {
        let row = match (estimator, &simulated) {
            (Some(Estimator { instrument: StudyInstrument::Wire, .. }), _) => {
                solve_wire(definition, trial.seed, &conditions)
            }
            (Some(estimator), Some(simulated)) => {
                solve_bar(definition, simulated, &estimator.config, with_errors)
            }
            _ => Err("there is no such estimator".into()),
        };
        row.unwrap_or_else(ResultRow::failed)
    };
    Ok(estimators().map(solve).collect())
}

/// Readings of robot and bar for each station of the bar, and the true values, which are the same for all stations.
struct SimulatedStations {
    stations: Vec<Prepared>,
    truth: Truth,
}

fn experiment<'a>(definition: &'a Definition, seed: u32, conditions: &Conditions) -> Experiment<'a> {
    let Definition { study, robot, bar, .. } = definition;
    Experiment {
        design: Design { duration_s: study.duration_s, ..Design::for_robot(robot) },
        errors: conditions.errors,
        added_errors: conditions.added_errors.clone(),
        effects: conditions.effects,
        load: conditions.load,
        seed: u64::from(seed),
        ..Experiment::new(robot, bar)
    }
}

fn simulate(
    definition: &Definition,
    seed: u32,
    conditions: &Conditions,
) -> Result<SimulatedStations, SimulateError> {
    let mut stations = Vec::new();
    let mut truth = None;
    for station in 0..conditions.stations {
        let mut experiment = experiment(definition, seed, conditions);
        if station > 0 {
            // The second station has the same robot and bar, but another path and independent noise.
            experiment.robot_seed = Some(experiment.seed);
            experiment.seed += (station as u64) << 32;
            experiment.design.base_m = definition.study.second_base_m.unwrap_or(experiment.design.base_m);
        }
        let (path, start_rad) = definition.reference.drive(&mut experiment)?;
        let count = conditions.points / conditions.stations;
        let pairs = pairs(&experiment, path.as_ref(), start_rad, count, conditions.time_difference_s)?;
        stations.push(prepared(&pairs, conditions.measured, experiment.design.base_m)?);
        truth.get_or_insert(pairs.truth);
    }
    Ok(SimulatedStations { stations, truth: truth.ok_or(SimulateError::Empty)? })
}

/// Converts pairs of angles to samples that need no preparation: robot and bar have one clock, encoder angles are
/// referenced, the links are near the nominal ones, and the bar is at `base_m`. `measured` is true for each bar
/// joint with an encoder.
///
/// # Errors
/// [`SimulateError::Empty`] if there are too few pairs to interpolate.
pub fn prepared(pairs: &Pairs, measured: [bool; 5], base_m: [f64; 3]) -> Result<Prepared, SimulateError> {
    // The robot's motion starts at time 0. The observations have times relative to the middle of the run.
    let first_s = pairs.t_s.first().copied().unwrap_or_default();
    let t_s = pairs.t_s.iter().map(|t_s| t_s - first_s).collect();
    let q_rad = Stream::new(0, t_s, pairs.robot_rad.clone()).with_gap_limit(f64::INFINITY);
    let motion = Arc::new(q_rad.spline().ok_or(SimulateError::Empty)?);
    let middle_s = mean(&pairs.t_s);
    let observation = |(t_s, bar_rad): (&f64, &[f64; 5])| Observation {
        measured,
        ..Observation::bar(t_s - middle_s, *bar_rad)
    };
    // `t_s` contains the times of the robot's rows. The first `LEAD_ROWS` rows belong to no pair.
    let observations = pairs.t_s.iter().skip(LEAD_ROWS).zip(&pairs.bar_rad).map(observation).collect();
    let motion = AlignedLog::new(motion, middle_s - first_s);
    Ok(Prepared::aligned(UtcNs(0), observations, motion, measured, base_m.into()))
}

/// Calibrates with the bar from simulated readings, and returns the errors. If `with_errors` is set, the row contains the
/// errors of single parameters as well.
fn solve_bar(
    definition: &Definition,
    simulated: &SimulatedStations,
    config: &IdentifyConfig,
    with_errors: bool,
) -> Result<ResultRow, String> {
    let bar = &definition.bar;
    let bars = simulated.stations.iter().map(|prepared| BarRun { prepared: prepared.clone(), bar }).collect();
    let data = DataSets { bars, rows: Vec::new() };
    let found = calibrate(&data, &definition.robot, config, None).map_err(|error| error.to_string())?;
    let compared = Comparison::new(&found, &simulated.truth)
        .only(|id| Selection::Thesis.contains(id, definition.robot.axes()));
    let errors =
        compared.parameters.iter().map(|parameter| (parameter.id.to_string(), parameter.error_displayed()));
    Ok(ResultRow {
        euclidean_mm_mrad: Some(compared.euclidean_mm_mrad()),
        largest_mm_mrad: Some(compared.max_mm_mrad()),
        errors: if with_errors { errors.collect() } else { BTreeMap::new() },
        ..position_errors(found.model(), &simulated.truth, definition, [Vector3::zeros(); 2])
    })
}

/// Simulates rows of a draw-wire, calibrates with them, and returns the position errors.
fn solve_wire(definition: &Definition, seed: u32, conditions: &Conditions) -> Result<ResultRow, String> {
    let experiment = experiment(definition, seed, conditions);
    let (rows, truth) = wire_rows(&experiment, conditions.wire_rows, conditions.wire_noise_m)
        .map_err(|error| error.to_string())?;
    let data = DataSets { rows: vec![Wire::new(&rows).into()], ..DataSets::default() };
    let found = calibrate(&data, &definition.robot, &IdentifyConfig::default(), None);
    let found = found.map_err(|error| error.to_string())?;
    let model = &found.runs.first().ok_or("there is no data set")?.model;
    let estimated_m = model.geometry(&[]).wire.attachments_m[0];
    Ok(position_errors(model, &truth, definition, [estimated_m, ATTACHMENT_M.into()]))
}

/// A row with the position errors of a point on the flange. `points_m` are the estimated position and the true position of
/// this point in the flange frame.
fn position_errors(
    found: &Model,
    truth: &Truth,
    definition: &Definition,
    points_m: [Vector3<f64>; 2],
) -> ResultRow {
    let (mean_m, p95_m) = position_errors_m(found, truth, &definition.robot, points_m);
    ResultRow { position_mm: Some(mean_m * 1e3), position_p95_mm: Some(p95_m * 1e3), ..ResultRow::default() }
}
