//! The rows of a run where its model is, as far as they take part in the solve.

use nalgebra::{DMatrix, DVector};

use crate::cost::{CostError, LoopProblem, Residual};
use crate::model::{JointState, Model, Observation, RobotMotion};
use crate::solver::{Subset, stacked};

/// Samples of a run that are looked at, at most: what only more would show is too small to matter.
const SAMPLES_MAX: usize = 3000;

/// Rows of a run, each multiplied by the root of its sample's weight.
#[derive(Debug)]
pub(super) struct Rows {
    /// Numbers of the samples in the order of time, with what the robot reports there.
    pub samples: Vec<(usize, JointState)>,
    /// Those of a sample together; as many for each sample.
    pub residuals: DVector<f64>,
    /// A column for each free parameter.
    pub jacobian: DMatrix<f64>,
}

impl Rows {
    /// None where no sample takes part or a residual is not finite.
    ///
    /// # Errors
    /// [`CostError`] where the observations are not what the cost needs.
    pub fn new<R: Residual>(
        model: &Model,
        motion: &impl RobotMotion,
        observations: &[Observation],
        residual: R,
        sigma: f64,
        weights: &[f64],
    ) -> Result<Option<Self>, CostError> {
        let clock = model.geometry(&[]).clock;
        let problem = LoopProblem::new(model, motion, observations, residual, sigma)?;
        let every = observations.len().div_ceil(SAMPLES_MAX).max(1);
        let reported = |sample: usize| motion.at(clock.robot_time_s(observations.get(sample)?.t_s));
        // Samples without a value have no weight.
        let present: Vec<(usize, JointState, f64)> = (0..observations.len())
            .step_by(every)
            .filter_map(|sample| Some((sample, reported(sample)?, *weights.get(sample)?)))
            .filter(|(.., weight)| *weight > 0.0)
            .collect();
        let samples = present.iter().map(|(sample, ..)| *sample).collect();
        let subset = Subset { of: &problem, samples };
        let Some((mut residuals, mut jacobian)) = stacked(&subset, &model.start()) else { return Ok(None) };
        if present.is_empty() || residuals.len() != R::ROWS * present.len() {
            return Ok(None);
        }
        for (row, (residual, mut by)) in residuals.iter_mut().zip(jacobian.row_iter_mut()).enumerate() {
            let root = present[row / R::ROWS].2.sqrt();
            *residual *= root;
            by *= root;
        }
        let samples = present.into_iter().map(|(sample, state, _)| (sample, state)).collect();
        Ok(Some(Self { samples, residuals, jacobian }))
    }

    /// Rows of each sample.
    pub fn per_sample(&self) -> usize {
        (self.residuals.len() / self.samples.len().max(1)).max(1)
    }
}
