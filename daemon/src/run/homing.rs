//! A homing on a bus in operation, between two runs. The cycle thread executes the steps. An observer in another thread
//! receives each step through one queue and the outcome (the marks that were found, or an error) through another. The method
//! is described in [`crate::homing`].

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use shared::config::EncoderConfig;
use shared::encoder::Direction;
use shared::recording::schema::CycleRecord;

use super::live::LatestSamples;
use crate::claim;
use crate::cycle::Acquisition;
use crate::homing::{HomingError, HomingResult, HomingStep, Sequence};
use crate::record::Stop;
use crate::scheduler::{Died, received};
use crate::segment::simulated::Hand;

/// Cause of the end of a homing if the cycle thread has ended.
const CYCLE_ENDED: &str = "the cycle thread has ended; the log shows why";

/// Capacity of the queue of steps. If the observer does not read the queue, further steps are dropped.
const STEPS_MAX: usize = 64;

/// A homing, as a job for the cycle thread.
pub(super) struct HomingJob {
    pub stop: Stop,
    steps: SyncSender<HomingStep>,
    outcomes: SyncSender<HomingResult>,
}

/// Handle of a homing in progress, for its observer.
pub struct ActiveHoming {
    /// Requests the end of the homing.
    pub stop: Stop,
    steps: Receiver<HomingStep>,
    outcomes: Receiver<HomingResult>,
    /// The outcome, until it has been returned.
    outcome: Option<HomingResult>,
    is_over: bool,
}

/// Creates a homing: the job for the cycle thread, and the handle for the observer.
pub(super) fn begin() -> (HomingJob, ActiveHoming) {
    let stop = Stop::default();
    let (steps_in, steps) = sync_channel(STEPS_MAX);
    let (outcomes_in, outcomes) = sync_channel(1);
    let active = ActiveHoming { stop: stop.clone(), steps, outcomes, outcome: None, is_over: false };
    (HomingJob { stop, steps: steps_in, outcomes: outcomes_in }, active)
}

/// Executes a homing in the cycle. Its steps may allocate memory, because no run is recorded.
pub(super) struct HomingTask {
    job: HomingJob,
    sequence: Sequence,
    directions: Vec<Direction>,
    hand: Option<Hand>,
}

impl HomingTask {
    pub fn begin(
        job: HomingJob,
        acquisition: &mut Acquisition,
        encoders: &[EncoderConfig],
        hand: Option<&Hand>,
    ) -> Self {
        // On the simulated bus the program turns the joints. Stop the simulated motion first.
        if let Some(hand) = hand {
            hand.hold();
        }
        let directions = encoders.iter().map(|encoder| encoder.direction).collect();
        Self { job, sequence: Sequence::begin(acquisition, encoders), directions, hand: hand.cloned() }
    }

    /// Executes one cycle. Returns false once the homing is over.
    pub fn step(&mut self, acquisition: &mut Acquisition, live: &LatestSamples) -> bool {
        let Self { job: HomingJob { stop, steps, outcomes }, sequence, directions, hand } = self;
        let mut report = |step: HomingStep| {
            if let (HomingStep::Turn { encoder, .. }, Some(hand)) = (step, &hand) {
                match directions.get(encoder) {
                    Some(Direction::Negative) => hand.turn_back(encoder),
                    _ => hand.turn(encoder),
                }
            }
            let _ = steps.try_send(step);
        };
        let stop_cause = stop.is_stopped().then(|| stop.cause());
        let mut sink = |record: &CycleRecord| live.publish(record);
        let Some(outcome) = sequence.step(acquisition, &mut sink, &mut report, stop_cause) else {
            return true;
        };
        if let Some(hand) = hand {
            hand.let_go();
        }
        let _ = outcomes.try_send(outcome);
        false
    }
}

impl ActiveHoming {
    /// The next step; `None` if there is no step yet.
    pub fn take_step(&mut self) -> Option<HomingStep> {
        // Read the outcome before the steps. Steps that were queued before the end are then still returned.
        if !self.is_over
            && let Some(outcome) = received(&self.outcomes)
        {
            self.is_over = true;
            claim::set_activity("between runs");
            let cause = || if self.stop.is_stopped() { self.stop.cause() } else { CYCLE_ENDED.into() };
            self.outcome = Some(outcome.unwrap_or_else(|Died| Err(HomingError::Stopped(cause()))));
        }
        self.steps.try_recv().ok()
    }

    /// The outcome, once the homing is over and every step was read. It is returned only once.
    pub fn outcome(&mut self) -> Option<HomingResult> {
        self.outcome.take()
    }
}
