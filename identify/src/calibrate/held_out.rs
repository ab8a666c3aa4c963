//! What a calibration says of stretches of time that it has not seen: the validation that no fit can flatter.

use std::ops::Range;

use super::ball_bar::{BallBarCalibration, CalibrateError};
use super::by_cost::WithResidual;
use super::config::IdentifyConfig;
use super::robust::{HALF, TWO_FIFTHS, settled};
use super::several::{Run, problem, residual_sigma};
use super::split::segments;
use crate::cost::{Residual, SharedColumns};
use crate::model::{Geometry, Model, Observation, ParameterId};
use crate::prepare::Prepared;
use crate::solver::{Options, Problem, SolveError, Subset, Watch, solve};

/// Samples of all runs that are looked at, at most.
const SAMPLES_MAX: usize = 3000;
/// Stretches of a run, and of all runs together, at most.
const STRETCHES: usize = 8;
const STRETCHES_OF_ALL: usize = 16;
/// The fits begin next to their minima and are only looked at: closer than this makes no difference.
const STEP_TOLERANCE: f64 = 1e-7;

/// A stretch of one run, and the run's parameters by a fit to everything else.
#[derive(Debug, Clone)]
pub struct Stretch {
    /// Number of the run, from 0.
    pub run: usize,
    /// Its samples.
    pub seen_by_none: Vec<Observation>,
    /// The other samples of its run.
    pub others: Vec<Observation>,
    /// None where the rest does not determine all parameters.
    pub model: Option<Model>,
}

/// Fits the calibration's parameters once more without each stretch of time, from the calibration on. Which terms the
/// model has was decided by the whole runs.
///
/// # Errors
/// [`CalibrateError`] where `watch` ended it or the samples do not suit the cost.
pub fn without_each_stretch(
    calibration: &BallBarCalibration,
    config: &IdentifyConfig,
    watch: Option<&dyn Watch>,
) -> Result<Vec<Stretch>, CalibrateError> {
    let runs = calibration.thinned(SAMPLES_MAX);
    let sigma = residual_sigma(calibration.cost, &calibration.solution);
    let work = Refit { runs: &runs, calibration, config, sigma, watch };
    calibration.cost.run(&calibration.measured(), config.noise, work)
}

struct Refit<'a> {
    runs: &'a [Run],
    calibration: &'a BallBarCalibration,
    config: &'a IdentifyConfig,
    sigma: f64,
    watch: Option<&'a dyn Watch>,
}

impl<'a> WithResidual for Refit<'a> {
    type Output = Result<Vec<Stretch>, CalibrateError>;

    fn with<R: Residual>(self, residual: impl Fn(&Prepared, &Geometry) -> R) -> Self::Output {
        let BallBarCalibration { columns, solution, cost, .. } = self.calibration;
        let problem = problem(self.runs, columns, residual, self.sigma)?;
        let count = (STRETCHES_OF_ALL / self.runs.len().max(1)).clamp(2, STRETCHES);
        let loss = self.config.loss_for(*cost);
        let good = if self.config.ransac { TWO_FIFTHS } else { HALF };
        let mut all = Vec::new();
        for left_out in segments(problem.starts(), count) {
            let samples = (0..problem.samples()).filter(|sample| !left_out.contains(sample));
            let others = Subset { of: &problem, samples: samples.collect() };
            let options = Options {
                loss: settled(&others, &solution.x, loss, good),
                step_tolerance: STEP_TOLERANCE,
                cost_tolerance: STEP_TOLERANCE,
                watch: self.watch,
                ..Options::default()
            };
            let x = match solve(&others, &solution.x, &options) {
                Err(error @ SolveError::Cancelled { .. }) => return Err(error.into()),
                Err(_) => None,
                Ok(found) => found.identified().ok().map(|found| found.x),
            };
            all.extend(self.stretch(columns, problem.starts(), &left_out, x));
        }
        Ok(all)
    }
}

impl Refit<'_> {
    fn stretch(
        &self,
        columns: &SharedColumns,
        starts: &[usize],
        left_out: &Range<usize>,
        x: Option<Vec<f64>>,
    ) -> Option<Stretch> {
        let number = starts.partition_point(|start| *start <= left_out.start).checked_sub(1)?;
        let run = self.runs.get(number)?;
        let start = starts.get(number)?;
        let samples = left_out.start - start..left_out.end - start;
        let observations = &run.prepared.observations;
        let others = [observations.get(..samples.start)?, observations.get(samples.end..)?].concat();
        let model = x.map(|x| {
            let mut model = run.model.clone();
            model.adopt(&columns.values(number, &x));
            keep_own_zeros(&mut model, &run.model, &others);
            model
        });
        Some(Stretch { run: number, seen_by_none: observations.get(samples)?.to_vec(), others, model })
    }
}

/// Zeros of encoders that lost their origin and that no other sample tells stay as the whole fit has them: no fit could
/// predict them.
fn keep_own_zeros(model: &mut Model, whole: &Model, others: &[Observation]) {
    for parameter in whole.columns() {
        if let ParameterId::Zero { origin, .. } = parameter.id
            && others.iter().all(|one| one.origin != origin)
        {
            // Both models have the same parameters.
            let _ = model.set_value(parameter.id, parameter.value);
        }
    }
}
