//! Homing on a bus in operation, between two runs.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use shared::config::EncoderConfig;
use shared::encoder::Direction;

use super::live::Live;
use crate::claim;
use crate::cycle::Acquisition;
use crate::homing::{self, Found, HomingError, HomingStep};
use crate::record::Stop;
use crate::segment::simulated::Hand;

/// Why a homing ends that nobody has ended.
const CYCLE_ENDED: &str = "the thread of the cycle has ended; its cause is in the log";

/// What of a homing is to be told.
enum Told {
    Step(HomingStep),
    Over(Result<Vec<Found>, HomingError>),
}

/// Homing, as the cycle's thread knows it.
pub(super) struct HomingJob {
    pub stop: Stop,
    told: Sender<Told>,
}

/// Homing that goes on.
pub struct ActiveHoming {
    /// Ends it.
    pub stop: Stop,
    told: Receiver<Told>,
    outcome: Option<Result<Vec<Found>, HomingError>>,
    is_over: bool,
}

/// A homing for the cycle's thread, and what others see of it.
pub(super) fn begin() -> (HomingJob, ActiveHoming) {
    let stop = Stop::default();
    let (sender, told) = channel();
    let active = ActiveHoming { stop: stop.clone(), told, outcome: None, is_over: false };
    (HomingJob { stop, told: sender }, active)
}

impl HomingJob {
    /// Homes all encoders. No run goes on meanwhile, so this may allocate.
    pub fn serve(
        self,
        acquisition: &mut Acquisition,
        encoders: &[EncoderConfig],
        hand: Option<&Hand>,
        live: &Arc<Live>,
    ) {
        let Self { stop, told } = self;
        // On the simulated bus nobody needs to turn anything.
        hand.iter().for_each(|hand| hand.hold());
        let mut watch = |step: HomingStep| {
            if let (HomingStep::Turn { encoder, .. }, Some(hand)) = (step, hand) {
                match encoders.get(encoder).map(|encoder| encoder.direction) {
                    Some(Direction::Negative) => hand.turn_back(encoder),
                    _ => hand.turn(encoder),
                }
            }
            let _ = told.send(Told::Step(step));
        };
        let stopped = || stop.is_stopped().then(|| stop.cause());
        let outcome =
            homing::home(acquisition, encoders, &mut |record| live.publish(record), &mut watch, &stopped);
        hand.iter().for_each(|hand| hand.let_go());
        let _ = told.send(Told::Over(outcome));
    }
}

impl ActiveHoming {
    /// The next step, if there is one by now.
    pub fn take_step(&mut self) -> Option<HomingStep> {
        match self.told.try_recv() {
            Ok(Told::Step(step)) => return Some(step),
            Ok(Told::Over(outcome)) => {
                claim::tell("between runs");
                self.outcome = Some(outcome);
                self.is_over = true;
            }
            Err(TryRecvError::Disconnected) if !self.is_over => {
                let cause = if self.stop.is_stopped() { self.stop.cause() } else { CYCLE_ENDED.into() };
                self.outcome = Some(Err(HomingError::Stopped(cause)));
                self.is_over = true;
            }
            Err(_) => {}
        }
        None
    }

    /// What was found, once it is over and every step was taken; given once.
    pub fn outcome(&mut self) -> Option<Result<Vec<Found>, HomingError>> {
        self.outcome.take()
    }
}
