//! What a calibration says of segments of time that it has not seen: the validation that no fit can flatter.

use std::ops::Range;

use super::ball_bar::{BallBarCalibration, CalibrateError};
use super::config::IdentifyConfig;
use super::pipeline::problem;
use super::split::segments;
use crate::cost::SharedColumns;
use crate::instrument::Run;
use crate::model::{Model, Observation, ParameterId};
use crate::solver::{GoodShare, Options, Problem, SolveError, Subset, Watch, solve};

/// Samples of all runs that are looked at, at most.
const SAMPLES_MAX: usize = 3000;
/// Segments of a run, and of all runs together, at most.
const SEGMENTS: usize = 8;
const SEGMENTS_OF_ALL: usize = 16;
/// The fits begin next to their minima and are only looked at: closer than this makes no difference.
const STEP_TOLERANCE: f64 = 1e-7;

/// A segment of one run, and the run's parameters by a fit to everything else.
#[derive(Debug, Clone)]
pub struct Segment {
    /// Number of the run, from 0.
    pub run: usize,
    /// Its samples.
    pub seen_by_none: Vec<Observation>,
    /// The other samples of its run.
    pub others: Vec<Observation>,
    /// None where the rest does not determine all parameters.
    pub model: Option<Model>,
}

/// Fits the calibration's parameters once more without each segment of time, from the calibration on. Which terms the
/// model has was decided by the whole runs.
///
/// # Errors
/// [`CalibrateError`] where `watch` ended it or the samples do not suit the cost.
pub fn without_each_segment(
    calibration: &BallBarCalibration,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Vec<Segment>, CalibrateError> {
    let runs = calibration.thinned(SAMPLES_MAX);
    let BallBarCalibration { columns, solution, cost, sigmas, .. } = calibration;
    let problem = problem(&runs, columns, sigmas)?;
    let count = (SEGMENTS_OF_ALL / runs.len().max(1)).clamp(2, SEGMENTS);
    let loss = config.loss_for(*cost);
    let good = if config.ransac { GoodShare::TWO_FIFTHS } else { GoodShare::HALF };
    let mut all = Vec::new();
    for left_out in segments(problem.starts(), count) {
        let samples = (0..problem.samples()).filter(|sample| !left_out.contains(sample));
        let others = Subset { of: &problem, samples: samples.collect() };
        let options = Options {
            loss: loss.settled(&others, &solution.x, good),
            step_tolerance: STEP_TOLERANCE,
            cost_tolerance: STEP_TOLERANCE,
            watch,
            ..Options::default()
        };
        let x = match solve(&others, &solution.x, &options) {
            Err(error @ SolveError::Cancelled { .. }) => return Err(error.into()),
            Err(_) => None,
            Ok(found) => found.identified().ok().map(|found| found.x),
        };
        all.extend(segment(&runs, columns, problem.starts(), &left_out, x));
    }
    Ok(all)
}

fn segment(
    runs: &[Run],
    columns: &SharedColumns,
    starts: &[usize],
    left_out: &Range<usize>,
    x: Option<Vec<f64>>,
) -> Option<Segment> {
    let number = starts.partition_point(|start| *start <= left_out.start).checked_sub(1)?;
    let Run { instrument, model } = runs.get(number)?;
    let bar = instrument.bar()?;
    let start = starts.get(number)?;
    let samples = left_out.start - start..left_out.end - start;
    let observations = &bar.prepared.observations;
    let others = [observations.get(..samples.start)?, observations.get(samples.end..)?].concat();
    let model = x.map(|x| {
        let mut without = model.clone();
        without.adopt(&columns.values(number, &x));
        keep_own_offsets(&mut without, model, &others);
        without
    });
    Some(Segment { run: number, seen_by_none: observations.get(samples)?.to_vec(), others, model })
}

/// Zeros of encoders that lost their origin and that no other sample determines stay as the whole fit has them: no fit could
/// predict them.
fn keep_own_offsets(model: &mut Model, whole: &Model, others: &[Observation]) {
    for parameter in whole.columns() {
        if let ParameterId::EncoderOffset { origin, .. } = parameter.id
            && others.iter().all(|one| one.origin != origin)
        {
            // Both models have the same parameters.
            let _ = model.set_value(parameter.id, parameter.value);
        }
    }
}
