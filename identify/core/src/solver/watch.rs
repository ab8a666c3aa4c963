//! Observation and cancellation of a running solve.

use std::fmt;

/// Progress of a solve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Number of accepted steps so far.
    pub iteration: usize,
    /// Highest number of accepted steps.
    pub iterations_max: usize,
    /// Cost at the current point; `None` until the first pass over the samples has ended.
    pub cost: Option<f64>,
    /// Number of samples completed in this pass.
    pub samples_done: usize,
    /// Number of samples of the pass.
    pub samples: usize,
}

/// An observer, such as a progress bar with a stop button.
pub trait Watch: fmt::Debug + Sync {
    /// Called when a stage of the work begins; `stage` is a short description.
    fn begins(&self, stage: &str) {
        let _ = stage;
    }

    /// Called after each part of the samples, by the thread that computed the part. A part takes one to some tens of
    /// milliseconds. Returns false to end the solve with [`super::SolveError::Cancelled`].
    fn goes_on(&self, progress: &Progress) -> bool;
}
