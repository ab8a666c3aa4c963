//! Looking on while a solve goes on, and ending it.

use std::fmt;

/// How far a solve has come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Accepted steps so far.
    pub iteration: usize,
    /// Steps at most.
    pub iterations_max: usize,
    /// Cost where the solve stands; none before the first pass over the samples is through.
    pub cost: Option<f64>,
    /// Samples of this pass that are done.
    pub samples_done: usize,
    /// Samples of a pass.
    pub samples: usize,
}

/// Someone who looks on: a progress bar, a button that says stop.
pub trait Watch: fmt::Debug + Sync {
    /// A part of the work begins; `stage` names it in a few words.
    fn begins(&self, stage: &str) {
        let _ = stage;
    }

    /// Called whenever a part of the samples (a millisecond to some tens of them) is done, by the thread that did it.
    /// False ends the solve with [`super::SolveError::Cancelled`].
    fn goes_on(&self, progress: &Progress) -> bool;
}
