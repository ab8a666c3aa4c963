//! A long solve uses threads, reports its progress, and can be cancelled.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::support::{Cell, noisy_poses};
use identify::cost::{LoopProblem, Residual, Transform};
use identify::model::{Model, Observation, PerObservation, Selection};
use identify::solver::{Loss, LossName, Options, Progress, SolveError, Watch, solve};

struct Poses {
    model: Model,
    observations: Vec<Observation>,
    joints: PerObservation,
}

impl Poses {
    /// A problem with enough samples for several blocks.
    fn new() -> Self {
        let cell = Cell::irb2400();
        let (observations, joints) = noisy_poses(&cell, 3000, 2, 1e-3);
        let mut model = cell.model();
        model.select(Selection::Thesis, Transform::identifies);
        Self { model, observations, joints }
    }

    fn problem(&self) -> LoopProblem<'_, Transform, PerObservation> {
        LoopProblem::new(&self.model, &self.joints, &self.observations, Transform, 1.0).unwrap()
    }
}

#[test]
fn any_number_of_threads_gives_the_same_solution_bit_for_bit() {
    let poses = Poses::new();
    let problem = poses.problem();
    let with = |threads| {
        let threads = NonZeroUsize::new(threads);
        let options =
            Options { threads, loss: Loss { name: LossName::Cauchy, scale: 5e-3 }, ..Options::default() };
        solve(&problem, &poses.model.start(), &options).unwrap()
    };
    let alone = with(1);
    assert!(alone.summary.termination.converged());
    for threads in [2, 3, 7] {
        assert_eq!(with(threads), alone, "{threads} threads");
    }
}

#[derive(Debug)]
struct Count {
    calls: AtomicUsize,
    last: AtomicUsize,
    calls_max: usize,
}

impl Watch for Count {
    fn goes_on(&self, progress: &Progress) -> bool {
        assert!(progress.samples_done <= progress.samples);
        assert_eq!(progress.samples, 3000);
        self.last.fetch_max(progress.iteration, Ordering::Relaxed);
        self.calls.fetch_add(1, Ordering::Relaxed) + 1 < self.calls_max
    }
}

fn watched(calls_max: usize) -> (Result<identify::solver::Solution, SolveError>, Count) {
    let poses = Poses::new();
    let count = Count { calls: AtomicUsize::new(0), last: AtomicUsize::new(0), calls_max };
    let options = Options { watch: Some(&count), ..Options::default() };
    let result = solve(&poses.problem(), &poses.model.start(), &options);
    (result, count)
}

#[test]
fn who_looks_on_sees_every_part_of_every_pass() {
    let (solution, count) = watched(usize::MAX);
    let summary = solution.unwrap().summary;
    // The 3000 samples are divided into 24 blocks of 128. Identifiability needs one more pass.
    assert_eq!(count.calls.into_inner(), 24 * (summary.evaluations + 1));
    assert!(count.last.into_inner() + 1 >= summary.iterations);
}

#[test]
fn a_solve_ends_when_it_is_told_to_and_says_so() {
    for calls in [1, 4, 8] {
        let (result, count) = watched(calls);
        assert!(matches!(result, Err(SolveError::Cancelled { .. })), "{result:?}");
        // After the cancellation, only blocks that are already in progress are completed, which are at most two.
        assert!(count.calls.into_inner() <= calls + 2);
    }
}

#[test]
fn a_solve_that_is_cancelled_at_its_solution_states_the_iterations_made() {
    let (solution, count) = watched(usize::MAX);
    let (iterations, calls) = (solution.unwrap().summary.iterations, count.calls.into_inner());
    // The last call belongs to the last block of the pass that determines identifiability.
    let (result, _) = watched(calls);
    assert_eq!(result.unwrap_err(), SolveError::Cancelled { iterations });
}
