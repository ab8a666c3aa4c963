//! Predicts held-out segments of time of ball-bar runs. This validates the calibration with data that the fit did
//! not use. The result contains each segment with the model from a fit to all other data. `evaluate::held_out`
//! computes the errors of these predictions.

use std::ops::Range;

use crate::calibrate::pipeline::{Solved, problem};
use crate::calibrate::{CalibrateError, Calibration};
use crate::cost::SharedColumns;
use crate::instrument::{Run, segments};
use crate::model::{Model, Observation, ParameterId};
use crate::solver::{Normals, Options, Watch};

/// Maximum number of samples in the fits, over all runs.
const SAMPLES_MAX: usize = 3000;
/// Maximum number of segments of one run.
const SEGMENTS: usize = 8;
/// Maximum number of segments of all runs together. Each run has at least two segments, even if this exceeds the maximum.
const SEGMENTS_OF_ALL: usize = 16;

/// A held-out segment of one run. The model has the parameters from the fit to all other data.
#[derive(Debug, Clone)]
pub struct Segment {
    /// Index of the run, from 0.
    pub run: usize,
    /// Samples in the segment.
    pub seen_by_none: Vec<Observation>,
    /// The other samples of the run.
    pub others: Vec<Observation>,
    /// Model from the fit to all other data. `None` if these data do not determine all parameters.
    pub model: Option<Model>,
}

/// Computes the model of the calibration without each segment of time of the ball-bar runs. Each fit is one step from the
/// calibration, on the normal equations of the other segments. One step is sufficient, because one segment has so little
/// influence that residuals are linear.
///
/// Only the parameters are estimated again. The error terms were chosen with the whole runs.
///
/// # Errors
/// [`CalibrateError`] if `watch` cancelled the computation or the samples lack data that the cost needs.
pub fn without_each_segment(
    calibration: &Calibration,
    watch: Option<&dyn Watch>,
) -> Result<Vec<Segment>, CalibrateError> {
    if calibration.prepared().is_none() {
        return Ok(Vec::new());
    }
    let runs = calibration.thinned(SAMPLES_MAX);
    let Solved { columns, solution, sigmas, .. } = &calibration.solved;
    let problem = problem(&runs, columns, sigmas)?;
    let count = (SEGMENTS_OF_ALL / runs.len().max(1)).clamp(2, SEGMENTS);
    let segments = segments(problem.starts(), count);
    let folds: Vec<Vec<usize>> = segments.iter().map(|segment| segment.clone().collect()).collect();
    let options = Options { loss: solution.loss, watch, ..Options::default() };
    let without_each = Normals::new(&problem, &solution.x, &options, &folds)?.without_each();
    let with_model = |(left_out, x)| segment(&runs, columns, problem.starts(), left_out, x);
    Ok(segments.iter().zip(without_each).filter_map(with_model).collect())
}

/// Returns one segment with its model. The segment has the indices `left_out`, which count the samples of all runs. `starts`
/// contains the first index of each run. `x` is the solution without the segment.
fn segment(
    runs: &[Run],
    columns: &SharedColumns,
    starts: &[usize],
    left_out: &Range<usize>,
    x: Option<Vec<f64>>,
) -> Option<Segment> {
    let number = starts.partition_point(|start| *start <= left_out.start).checked_sub(1)?;
    let Run { instrument, model } = runs.get(number)?;
    let start = starts.get(number)?;
    let samples = left_out.start - start..left_out.end - start;
    let observations = &instrument.prepared()?.observations;
    let others = [observations.get(..samples.start)?, observations.get(samples.end..)?].concat();
    let model = x.map(|x| {
        let mut without = model.clone();
        without.adopt(&columns.values(number, &x));
        keep_undetermined_offsets(&mut without, model, &others);
        without
    });
    Some(Segment { run: number, seen_by_none: observations.get(samples)?.to_vec(), others, model })
}

/// Keeps the values of the full fit for encoder offsets that only the samples of the segment determine. Such offsets follow
/// the loss of a counter's origin, so no other data could predict them.
fn keep_undetermined_offsets(model: &mut Model, whole: &Model, others: &[Observation]) {
    for parameter in whole.columns() {
        if let ParameterId::EncoderOffset { origin, .. } = parameter.id
            && others.iter().all(|one| one.origin != origin)
        {
            // This cannot fail, because both models have the same parameters.
            let _ = model.set_value(parameter.id, parameter.value);
        }
    }
}
