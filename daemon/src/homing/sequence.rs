//! Homing as a sequence of steps, one step per cycle. For each joint:
//! 1. All terminals are disarmed, so that they drop an earlier latch.
//! 2. All terminals whose mark was not found yet are armed.
//! 3. A person turns the joint, and `Search` receives the records until it has found the mark.
//!
//! If a mark is passed in the wrong direction, only the terminal of its encoder is disarmed and armed again.

use std::ops::Range;

use shared::config::EncoderConfig;
use shared::recording::schema::{CycleRecord, flags};

use super::search::{Detection, Search};
use super::{FoundMark, HomingError, HomingStep};
use crate::cycle::Acquisition;
use crate::devices::el5021::Output;

/// Period in which progress is reported \[s\].
const PROGRESS_S: f64 = 0.5;
/// Number of cycles for which a terminal is disarmed, so that it drops an earlier latch.
const DISARM_CYCLES: u32 = 20;

/// The encoder and mark of each joint, in the order in which the joints were turned.
pub type HomingResult = Result<Vec<FoundMark>, HomingError>;

/// Finds the encoder and the mark of every joint.
pub struct Sequence {
    encoders: Vec<EncoderConfig>,
    found: Vec<FoundMark>,
    /// Search for the mark of the current joint. `None` until the terminals are armed for it.
    search: Option<Search>,
    progress_due_s: f64,
    state: SequenceState,
}

enum SequenceState {
    /// The terminals in this range are disarmed, so that they drop an earlier latch. The number of remaining cycles follows.
    Disarmed(Range<usize>, u32),
    /// The terminals are armed if their mark was not found yet, and the current joint is being turned.
    Armed,
    /// Disarming was requested for all terminals. One more cycle sends the request, then the homing ends with this outcome.
    Ending(HomingResult),
}

impl Sequence {
    /// Begins with the joint of the first encoder. `encoders` are in bus order.
    pub fn begin(acquisition: &mut Acquisition, encoders: &[EncoderConfig]) -> Self {
        let mut sequence = Self {
            encoders: encoders.to_vec(),
            found: Vec::with_capacity(encoders.len()),
            search: None,
            progress_due_s: 0.0,
            state: SequenceState::Armed,
        };
        sequence.begin_joint(acquisition);
        sequence
    }

    /// Runs one cycle. The record is passed to `sink`, and steps of the homing are passed to `watch`. If `stopped` contains
    /// a cause, the homing ends with this cause. Returns the outcome when the homing is over.
    pub fn step(
        &mut self,
        acquisition: &mut Acquisition,
        sink: &mut dyn FnMut(&CycleRecord),
        watch: &mut dyn FnMut(HomingStep),
        stopped: Option<String>,
    ) -> Option<HomingResult> {
        if let Some(cause) = stopped.filter(|_| !matches!(self.state, SequenceState::Ending(_))) {
            self.end(acquisition, Err(HomingError::Stopped(cause)));
        }
        match &mut self.state {
            SequenceState::Disarmed(terminals, cycles) => {
                let mut is_down = false;
                acquisition.next_cycle(&mut |record| {
                    is_down |= record.flags & flags::BUS_DOWN != 0;
                    sink(record);
                });
                *cycles -= 1;
                if is_down {
                    let joint = self.encoders[self.found.len()].joint;
                    self.end(acquisition, Err(HomingError::NoSignal(joint)));
                } else if *cycles == 0 {
                    let terminals = terminals.clone();
                    self.arm(acquisition, terminals, watch);
                }
                None
            }
            SequenceState::Armed => {
                self.search(acquisition, sink, watch);
                None
            }
            SequenceState::Ending(outcome) => {
                acquisition.next_cycle(sink);
                Some(outcome.clone())
            }
        }
    }

    fn begin_joint(&mut self, acquisition: &mut Acquisition) {
        self.search = None;
        if self.found.len() == self.encoders.len() {
            return self.end(acquisition, Ok(self.found.clone()));
        }
        self.disarm(acquisition, 0..self.encoders.len());
    }

    fn disarm(&mut self, acquisition: &mut Acquisition, terminals: Range<usize>) {
        set_latch(acquisition, terminals.clone(), false);
        self.state = SequenceState::Disarmed(terminals, DISARM_CYCLES);
    }

    fn arm(
        &mut self,
        acquisition: &mut Acquisition,
        terminals: Range<usize>,
        watch: &mut dyn FnMut(HomingStep),
    ) {
        // The saved mark is later compared with the count that the terminal has latched. A terminal whose mark was found must
        // therefore not latch another count.
        let is_found = |encoder: &usize| self.found.iter().any(|found| found.encoder == *encoder);
        set_latch(acquisition, terminals.filter(|encoder| !is_found(encoder)), true);
        self.state = SequenceState::Armed;
        // If a mark was passed in the wrong direction, terminals were armed again. The search of this joint then continues.
        let encoder = self.found.len();
        if let Some(EncoderConfig { joint, .. }) =
            self.encoders.get(encoder).filter(|_| self.search.is_none())
        {
            watch(HomingStep::Turn { joint: *joint, encoder });
            // The search receives all encoders, because any of them may be the one that moves.
            self.search = Some(Search::new(self.encoders.clone(), *joint, self.found.clone()));
            self.progress_due_s = PROGRESS_S;
        }
    }

    fn search(
        &mut self,
        acquisition: &mut Acquisition,
        sink: &mut dyn FnMut(&CycleRecord),
        watch: &mut dyn FnMut(HomingStep),
    ) {
        let Some(search) = &mut self.search else { return };
        let mut seen = Ok(Detection::Nothing);
        acquisition.next_cycle(&mut |record| {
            sink(record);
            if matches!(seen, Ok(Detection::Nothing)) {
                seen = search.observe(record);
            }
        });
        if search.elapsed_s() >= self.progress_due_s {
            let (joint, turned_rad) = search.progress();
            watch(HomingStep::Turning { joint, turned_rad });
            self.progress_due_s = search.elapsed_s() + PROGRESS_S;
        }
        match seen {
            Ok(Detection::Nothing) => {}
            Ok(Detection::MarkPassedBackwards { encoder }) => self.disarm(acquisition, encoder..encoder + 1),
            Ok(Detection::Found(found)) => {
                watch(HomingStep::Found(found));
                self.found.push(found);
                self.begin_joint(acquisition);
            }
            Err(error) => self.end(acquisition, Err(error)),
        }
    }

    fn end(&mut self, acquisition: &mut Acquisition, outcome: HomingResult) {
        set_latch(acquisition, 0..self.encoders.len(), false);
        self.state = SequenceState::Ending(outcome);
    }
}

fn set_latch(acquisition: &mut Acquisition, terminals: impl Iterator<Item = usize>, enable_latch: bool) {
    terminals.for_each(|encoder| acquisition.set_output(encoder, Output { enable_latch }));
}
