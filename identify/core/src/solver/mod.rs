//! Nonlinear least squares over samples: a solve that says why it ended, what it could identify and how well.
//!
//! It knows residuals, Jacobians, priors and names of columns, nothing of robots. Each sample's small dense block is
//! added into the normal matrix; no tall matrix is stored. At the solution the blocks are folded once more into a
//! triangle by orthogonal transformations, from which rank, dependent groups and covariance are read: the normal
//! matrix itself would square the condition number.

mod information;
mod kernel;
mod levenberg_marquardt;
mod loss;
mod outcome;
mod panel;
mod pass;
mod robust;
mod subset;
mod watch;

pub use information::change_point::{Change, Course, change_point};
pub use information::covariance::{Considered, Covariance, Noise, SigmasFrom, Source, Spread};
pub use information::identifiability::{DependentGroup, Identifiability, Unidentifiable, identifiability};
pub use information::influence::{Influence, influence};
pub use information::normals::{Normal, Normals};
pub use information::observability::Observability;
pub use information::scaled_cholesky::ScaledCholesky;
pub use levenberg_marquardt::{minimise, solve};
pub use loss::{Loss, LossName};
pub use outcome::{NotConverged, Options, Solution, Summary, Termination};
pub use panel::Block;
pub use pass::stacked;
pub use robust::{GoodShare, Schedule, minimise_robust};
pub use subset::Subset;
pub use watch::{Progress, Watch};

/// Knowledge of one column apart from the samples: `x[column] = value +- sigma`, one extra residual row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Column of the free parameters.
    pub column: usize,
    /// Expected value.
    pub value: f64,
    /// Standard deviation, in the parameter's unit.
    pub sigma: f64,
}

/// A least-squares problem `min 1/2 sum_k rho(|r_k(x)|^2) + 1/2 sum ((x_j - value_j) / sigma_j)^2`.
pub trait Problem: Sync {
    /// Number of free parameters.
    fn columns(&self) -> usize;

    /// Name of a column, for messages and reports.
    fn column_name(&self, column: usize) -> String;

    /// Number of samples.
    fn samples(&self) -> usize;

    /// Residual rows of a sample, at most. Scales of losses are those of a sample with as many.
    fn rows(&self) -> usize;

    /// Residual rows of one sample.
    fn rows_of(&self, _sample: usize) -> usize {
        self.rows()
    }

    /// The sample is knowledge from elsewhere: it belongs to no fold, and counts whichever fold is left out.
    fn is_known(&self, _sample: usize) -> bool {
        false
    }

    /// Priors on columns.
    fn priors(&self) -> &[Prior] {
        &[]
    }

    /// Residuals and Jacobians at `x`. What depends on `x` alone is computed here; each thread has a linearisation of its own.
    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a>;
}

/// Writes residual and Jacobian of the sample of this number; the block comes filled with zeros.
///
/// False where the sample has no value at this point (its time is outside the other log). A sample that has none at the start
/// is left out and counted; a step that loses one later is refused.
pub type Linearisation<'a> = Box<dyn FnMut(usize, &mut [f64], &mut Block<'_>) -> bool + 'a>;

/// Why there is no solution.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// Start and columns do not fit.
    #[error("the start has {found} values for {expected} free parameters; give one for each")]
    StartLength {
        /// Values given.
        found: usize,
        /// Free parameters.
        expected: usize,
    },
    /// Nothing to solve for.
    #[error("no parameter is free; free at least one")]
    NothingFree,
    /// No sample is usable at the start.
    #[error(
        "none of the {samples} samples has a value at the start; check that the two logs overlap in time"
    )]
    NoSamples {
        /// Samples offered.
        samples: usize,
    },
    /// A residual or derivative is not a number.
    #[error(
        "sample {sample} gives a residual or derivative that is not finite at the start; check its input"
    )]
    NotFinite {
        /// Sample, from 0.
        sample: usize,
    },
    /// The estimates depend on each other.
    #[error(
        "the columns that are estimated depend on each other; hold more of them, or measure more varied poses"
    )]
    Dependent,
    /// Who looked on ended it.
    #[error("the solve was cancelled after {iterations} iterations; there is no result")]
    Cancelled {
        /// Accepted steps.
        iterations: usize,
    },
}
