//! Nonlinear least squares over samples. A [`LeastSquares`] problem provides residuals, Jacobians, priors and names of
//! columns; a column is a free parameter. [`solve`] returns the parameters at the minimum with the reason of termination,
//! identifiability and covariance. Nothing here depends on robots.
//!
//! Each sample contributes a small dense block of rows to the normal matrix, so the Jacobian of all samples is never
//! stored. After the last step, a further pass over the samples reduces the blocks to a triangular matrix by
//! orthogonal transformations. Rank, dependent groups and covariance are computed from this triangle, because the
//! normal matrix has the square of its condition number.

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
pub use information::covariance::{
    Considered, Covariance, ResidualNoise, SigmasFrom, Spread, UncertaintySource,
};
pub use information::identifiability::{
    DependentGroup, Identifiability, Unidentifiable, combined, identifiability,
};
pub use information::influence::{Influence, influence};
pub use information::normals::{Normal, Normals, Scores};
pub use information::observability::Observability;
pub use information::scaled_cholesky::ScaledCholesky;
pub use levenberg_marquardt::{minimise, solve};
pub use loss::{Loss, LossName};
pub use outcome::{NoFreedom, NotConverged, Options, Solution, Summary, Termination};
pub use panel::Block;
pub use pass::stacked;
pub use robust::{GoodShare, Schedule, minimise_robust};
pub use subset::Subset;
pub use watch::{Progress, Watch};

/// Prior knowledge about one column, independent of the samples: `x[column] = value +- sigma`. It adds one residual row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Column of the free parameters.
    pub column: usize,
    /// Expected value, in the parameter's unit.
    pub value: f64,
    /// Standard deviation, in the parameter's unit.
    pub sigma: f64,
}

/// A least-squares problem `min 1/2 sum_k rho(|r_k(x)|^2) + 1/2 sum ((x_j - value_j) / sigma_j)^2`.
pub trait LeastSquares: Sync {
    /// Number of free parameters.
    fn columns(&self) -> usize;

    /// Name of a column, for messages and reports.
    fn column_name(&self, column: usize) -> String {
        format!("x{column}")
    }

    /// Number of samples of the problem.
    fn samples(&self) -> usize;

    /// Largest number of residual rows of a measured sample. Samples that represent prior knowledge may have
    /// more rows. Scales of losses refer to this number.
    fn rows(&self) -> usize;

    /// Number of residual rows of one sample.
    fn rows_of(&self, _sample: usize) -> usize {
        self.rows()
    }

    /// Whether the sample represents prior knowledge. Such a sample belongs to no fold, so it is never held out.
    fn is_known(&self, _sample: usize) -> bool {
        false
    }

    /// Priors on some columns.
    fn priors(&self) -> &[Prior] {
        &[]
    }

    /// Prepares residuals and Jacobians at `x`. Quantities that depend only on `x` are computed here, once. Each thread
    /// calls this function and gets its own linearisation.
    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a>;
}

/// Writes the residual and the Jacobian of a sample. The arguments are the index of the sample, the residual and the
/// Jacobian. Residual and Jacobian are zero on entry.
///
/// Returns false if the sample has no value at this point, for example because its time is outside the other log.
/// Samples without a value at the start are left out and counted. If any other sample has no value after a step,
/// the step is refused.
pub type Linearisation<'a> = Box<dyn FnMut(usize, &mut [f64], &mut Block<'_>) -> bool + 'a>;

/// Why a solve has no result.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// The start does not have one value for each column.
    #[error("{found} initial values were given for {expected} free parameters; give one for each")]
    StartLength {
        /// Number of given values.
        found: usize,
        /// Number of free parameters.
        expected: usize,
    },
    /// No parameter is free.
    #[error("no parameter is free; free at least one")]
    NothingFree,
    /// No sample is usable at the start.
    #[error(
        "none of the {samples} samples has a residual at the initial values; check that the two logs overlap in time"
    )]
    NoSamples {
        /// Number of samples of the problem.
        samples: usize,
    },
    /// A residual or derivative is not finite.
    #[error(
        "the residual or a derivative of sample {sample} is not finite at the initial values; check the values of this sample"
    )]
    NotFinite {
        /// Number of the sample, from 0.
        sample: usize,
    },
    /// The estimated columns are linearly dependent.
    #[error("the estimated parameters depend on each other; fix more of them, or measure more varied poses")]
    Dependent,
    /// Cancelled by the observer.
    #[error("the solve was cancelled after {iterations} iterations; there is no result")]
    Cancelled {
        /// Number of accepted steps.
        iterations: usize,
    },
}
