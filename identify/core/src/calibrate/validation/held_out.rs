//! What a calibration says of segments of time that it has not seen: the validation that no fit can flatter.

use std::ops::Range;

use crate::calibrate::pipeline::{Solved, problem};
use crate::calibrate::{CalibrateError, Calibration};
use crate::cost::SharedColumns;
use crate::instrument::{Run, segments};
use crate::model::{Model, Observation, ParameterId};
use crate::solver::{Normals, Options, Watch};

/// Samples of all runs that are looked at, at most.
const SAMPLES_MAX: usize = 3000;
/// Segments of a run, and of all runs together, at most.
const SEGMENTS: usize = 8;
const SEGMENTS_OF_ALL: usize = 16;

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

/// The calibration's parameters without each segment of time of a run with the ball-bar: by one step on the normal equations of the others, from the
/// calibration on. The minimum without a segment is so near that it is reached (residuals are linear over what errors of
/// one segment move). Which terms the model has was decided by the whole runs.
///
/// # Errors
/// [`CalibrateError`] where `watch` ended it or the samples do not suit the cost.
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
    let segment = |(left_out, x)| segment(&runs, columns, problem.starts(), left_out, x);
    Ok(segments.iter().zip(without_each).filter_map(segment).collect())
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
    let start = starts.get(number)?;
    let samples = left_out.start - start..left_out.end - start;
    let observations = &instrument.prepared()?.observations;
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
