//! What a solve is asked, and what it answers.

use std::fmt;
use std::num::NonZeroUsize;

use super::information::covariance::{Covariance, Noise};
use super::information::identifiability::{Identifiability, Unidentifiable};
use super::{Loss, Watch};

/// When to stop and what to assume.
#[derive(Debug, Clone, Copy)]
pub struct Options<'a> {
    /// Loss of each sample.
    pub loss: Loss,
    /// Accepted steps at most.
    pub iterations_max: usize,
    /// Stop where the scaled step is this part of the scaled parameters.
    pub step_tolerance: f64,
    /// Stop where the decrease that a step promises is this part of the cost.
    pub cost_tolerance: f64,
    /// Stop where the cosine between residual and every column is below this.
    pub gradient_tolerance: f64,
    /// First damping, relative to the scaled normal matrix. Small: the start is good to millimetres, and a larger one
    /// would hold back exactly the weak directions.
    pub damping_start: f64,
    /// Singular values of the column-scaled Jacobian below this part of the largest count as zero.
    pub rank_tolerance: f64,
    /// What residuals are worth.
    pub noise: Noise,
    /// Threads at most; none: as many as the problem's size makes pay. The result is the same with any number.
    pub threads: Option<NonZeroUsize>,
    /// Who looks on and may end it.
    pub watch: Option<&'a dyn Watch>,
}

impl Default for Options<'_> {
    fn default() -> Self {
        Self {
            loss: Loss::Squared,
            iterations_max: 100,
            step_tolerance: 1e-12,
            cost_tolerance: 1e-14,
            gradient_tolerance: 1e-14,
            damping_start: 1e-6,
            rank_tolerance: 1e-6,
            noise: Noise::Estimated,
            threads: None,
            watch: None,
        }
    }
}

/// Why the solve ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Termination {
    /// Steps became as small as asked.
    SmallStep,
    /// The cost no longer falls.
    SmallDecrease,
    /// Residual and columns are orthogonal.
    SmallGradient,
    /// Every residual is zero to rounding.
    ZeroResidual,
    /// The limit of iterations was reached first.
    IterationLimit,
    /// No damping gives a lower cost: derivatives are wrong or the problem is rounding.
    NoDecrease,
}

impl Termination {
    /// The solve ended at a minimum.
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

/// How the solve went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Summary {
    /// Why it ended.
    pub termination: Termination,
    /// Accepted steps.
    pub iterations: usize,
    /// Passes over all samples.
    pub evaluations: usize,
    /// Half the sum of losses and squared prior residuals at the start.
    pub cost_start: f64,
    /// The same at the end.
    pub cost_end: f64,
    /// Root mean square of all residual entries at the start, unweighted, without priors.
    pub residual_rms_start: f64,
    /// The same at the end.
    pub residual_rms: f64,
    /// Samples that took part.
    pub samples_used: usize,
    /// Samples without a value at the start.
    pub samples_left_out: usize,
}

/// A solve ended elsewhere than at a minimum.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error(
    "the solve did not converge ({}, {} iterations, residual RMS {:.3e}); the robot, the instrument or the log may be \
     the wrong one, or its motion too small; check them, or measure more varied poses",
    summary.termination, summary.iterations, summary.residual_rms
)]
pub struct NotConverged {
    /// How it went.
    pub summary: Summary,
}

impl Summary {
    /// Nothing, if the solve ended at a minimum.
    ///
    /// # Errors
    /// [`NotConverged`].
    pub fn require_converged(&self) -> Result<(), NotConverged> {
        if self.termination.converged() { Ok(()) } else { Err(NotConverged { summary: *self }) }
    }
}

/// A solve's outcome.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// Free parameters.
    pub x: Vec<f64>,
    /// How it went.
    pub summary: Summary,
    /// What the samples could identify.
    pub identifiability: Identifiability,
    /// How well.
    pub covariance: Covariance,
    /// The loss that had the last word.
    pub loss: Loss,
    /// Weight that the loss gave each sample, zero where left out.
    pub sample_weights: Vec<f64>,
}

impl Solution {
    /// The solution if every free parameter is identified.
    ///
    /// # Errors
    /// Names the columns that are not.
    pub fn identified(self) -> Result<Self, Unidentifiable> {
        self.identifiability.require_full()?;
        Ok(self)
    }
}
