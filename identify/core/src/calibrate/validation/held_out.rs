//! Prediction of held-out segments of time of ball-bar runs: a validation on data that the fit did not use. Gives the models;
//! `evaluate::held_out` computes their errors.

use std::ops::Range;

use crate::calibrate::pipeline::{Solved, problem};
use crate::calibrate::{CalibrateError, Calibration};
use crate::cost::SharedColumns;
use crate::instrument::{Run, segments};
use crate::model::{Model, Observation, ParameterId};
use crate::solver::{Normals, Options, Watch};

/// Maximum number of samples of all runs.
const SAMPLES_MAX: usize = 3000;
/// Maximum number of segments of a run.
const SEGMENTS: usize = 8;
/// Maximum number of segments of all runs, except that each run has at least two.
const SEGMENTS_OF_ALL: usize = 16;

/// A held-out segment of one run, with the run's parameters from a fit to all other data.
#[derive(Debug, Clone)]
pub struct Segment {
    /// Index of the run, from 0.
    pub run: usize,
    /// Samples of the held-out segment.
    pub seen_by_none: Vec<Observation>,
    /// The other samples of its run.
    pub others: Vec<Observation>,
    /// Model from the fit to all other data; `None` if they do not determine all parameters.
    pub model: Option<Model>,
}

/// The calibration's parameters without each segment of time of a ball-bar run, by one step on the normal equations of the
/// other segments, starting at the calibration. One step reaches the minimum, because residuals are linear over the influence
/// of one segment. The terms of the model were chosen with the whole runs.
///
/// # Errors
/// [`CalibrateError`] if `watch` cancelled it or the samples do not fit the cost.
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

/// The segment with these indices among the samples of all runs; `starts` are the first indices of the runs, and `x` is the
/// solution without the segment.
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

/// Keeps the offsets of encoders that lost their origin, if no other sample determines them, at the values of the full fit:
/// no fit could predict them.
fn keep_undetermined_offsets(model: &mut Model, whole: &Model, others: &[Observation]) {
    for parameter in whole.columns() {
        if let ParameterId::EncoderOffset { origin, .. } = parameter.id
            && others.iter().all(|one| one.origin != origin)
        {
            // Cannot fail: both models have the same parameters.
            let _ = model.set_value(parameter.id, parameter.value);
        }
    }
}
