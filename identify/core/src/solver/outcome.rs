//! Options and results of a solve.

use std::fmt;
use std::num::NonZeroUsize;

use super::information::covariance::{Covariance, ResidualNoise};
use super::information::identifiability::{Identifiability, Unidentifiable};
use super::{Loss, Watch};

/// Termination criteria, loss and assumptions of a solve.
#[derive(Debug, Clone, Copy)]
pub struct Options<'a> {
    /// Robust loss that is applied to each sample.
    pub loss: Loss,
    /// Highest number of accepted steps.
    pub iterations_max: usize,
    /// The solve ends if the norm of the scaled step is at most this fraction of the norm of the scaled parameters.
    pub step_tolerance: f64,
    /// The solve ends if the predicted decrease of the cost is at most this fraction of the cost.
    pub cost_tolerance: f64,
    /// The solve ends if the cosine of the angle between the residual and each column is at most this.
    pub gradient_tolerance: f64,
    /// Initial damping, relative to the scaled normal matrix. It is small: the start is accurate to millimetres, and a
    /// larger damping would suppress steps along weakly determined directions.
    pub damping_start: f64,
    /// Singular values of the column-scaled Jacobian count as zero if they are below this fraction of the largest one.
    pub rank_tolerance: f64,
    /// Assumed noise of the residuals.
    pub noise: ResidualNoise,
    /// Highest number of threads. `None` selects an efficient number for the size of the problem. The result does not depend
    /// on the number of threads.
    pub threads: Option<NonZeroUsize>,
    /// Observer that may cancel the solve.
    pub watch: Option<&'a dyn Watch>,
}

impl Default for Options<'_> {
    fn default() -> Self {
        Self {
            loss: Loss::SQUARED,
            iterations_max: 100,
            step_tolerance: 1e-12,
            cost_tolerance: 1e-14,
            gradient_tolerance: 1e-14,
            damping_start: 1e-6,
            rank_tolerance: 1e-6,
            noise: ResidualNoise::Estimated,
            threads: None,
            watch: None,
        }
    }
}

/// Why the solve ended, either at a minimum or without one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Termination {
    /// The step is at most `step_tolerance`, relative to the parameters.
    SmallStep,
    /// The predicted decrease of the cost is negligible.
    SmallDecrease,
    /// The residual is orthogonal to every column of the Jacobian.
    SmallGradient,
    /// The cost is exactly zero.
    ZeroResidual,
    /// The iteration limit was reached before a minimum.
    IterationLimit,
    /// No damping leads to a lower cost. Either the derivatives are wrong, or rounding errors dominate the problem.
    NoDecrease,
}

impl Termination {
    /// Whether the solve ended at a minimum.
    pub fn converged(self) -> bool {
        !matches!(self, Self::IterationLimit | Self::NoDecrease)
    }
}

impl fmt::Display for Termination {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::SmallStep => "converged: the step is negligible",
            Self::SmallDecrease => "converged: the cost no longer falls",
            Self::SmallGradient => "converged: the gradient is zero",
            Self::ZeroResidual => "converged: all residuals are zero",
            Self::IterationLimit => "not converged: iteration limit",
            Self::NoDecrease => "not converged: no step lowers the cost",
        })
    }
}

/// Iterations, cost and residuals of a solve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Summary {
    /// Why the solve ended.
    pub termination: Termination,
    /// Number of accepted steps.
    pub iterations: usize,
    /// Number of passes over all samples.
    pub evaluations: usize,
    /// Half the sum of losses and squared prior residuals at the end.
    pub cost_end: f64,
    /// Root mean square of all residual entries at the start, unweighted, without priors.
    pub residual_rms_start: f64,
    /// Root mean square of all residual entries at the end, unweighted, without priors.
    pub residual_rms: f64,
    /// Number of samples in use.
    pub samples_used: usize,
    /// Number of samples that are not in use, because they have no value at the start.
    pub samples_left_out: usize,
}

/// The solve did not end at a minimum.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error(
    "the solve did not converge ({}, {} iterations, residual RMS {:.3e}); the robot, the instrument or the log may be \
     the wrong one, or its motion too small; check them, or measure more varied poses",
    summary.termination, summary.iterations, summary.residual_rms
)]
pub struct NotConverged {
    /// Summary of the solve that failed.
    pub summary: Summary,
}

/// The residuals are too few to estimate their variance, because no degree of freedom remains.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "too few samples: {columns} parameters are free without a prior, and no more residuals than that count (robust weights), so \
     noise and uncertainties cannot be estimated; measure more poses, or fix parameters (`--fix`)"
)]
pub struct NoFreedom {
    /// Number of free parameters without prior.
    pub columns: usize,
}

impl Summary {
    /// Checks that the solve ended at a minimum.
    ///
    /// # Errors
    /// [`NotConverged`] if it did not.
    pub fn require_converged(&self) -> Result<(), NotConverged> {
        if self.termination.converged() { Ok(()) } else { Err(NotConverged { summary: *self }) }
    }
}

/// Result of a solve.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// Values of the free parameters at the minimum.
    pub x: Vec<f64>,
    /// Iterations, cost and residuals.
    pub summary: Summary,
    /// Which parameters the samples determine.
    pub identifiability: Identifiability,
    /// Uncertainty of the parameters.
    pub covariance: Covariance,
    /// Loss that was minimised, with the scale of the last iterations.
    pub loss: Loss,
    /// Weight of each sample under the loss; zero for samples that are not in use.
    pub sample_weights: Vec<f64>,
}

impl Solution {
    /// Returns the solution if every free parameter is identified.
    ///
    /// # Errors
    /// [`Unidentifiable`] with the names of the columns that are not identified.
    pub fn identified(self) -> Result<Self, Unidentifiable> {
        self.identifiability.require_full()?;
        Ok(self)
    }

    /// Checks that the parameters have standard deviations.
    ///
    /// # Errors
    /// [`NoFreedom`] if they do not.
    pub fn require_sigmas(&self) -> Result<(), NoFreedom> {
        if self.covariance.has_sigmas() {
            return Ok(());
        }
        let columns = self.identifiability.prior_sigmas.iter().filter(|sigma| sigma.is_none()).count();
        Err(NoFreedom { columns })
    }
}
