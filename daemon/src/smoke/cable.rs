//! The check of the cable between this PC and the coupler. The cable is pulled and plugged in again, by a person or by the
//! simulated bus. The flags of the records show whether the cable is out, and whether the bus then returns to operation.

use shared::recording::schema::{CycleRecord, flags};

use super::check::Outcome;
use crate::problem::Fact;
use crate::run::{BUS_FLAGS, Session};
use crate::segment::faults::{Fault, FaultHandle};

/// How long the cable must be out \[s\]. After one second the bus counts as failed and must be brought into operation again.
const OUT_S: u64 = 3;
/// How long the bus must work after the cable was plugged in again \[s\].
const BACK_S: u64 = 2;
/// Time limit for a person to pull the cable, or to plug it in \[s\].
const PATIENCE_S: u64 = 60;

/// Follows the cable through the check: pulled, plugged in, bus in operation again.
pub(super) struct Pull<'a> {
    faults: Option<&'a FaultHandle>,
    cycles_per_s: u64,
    state: Cable,
    /// Number of cycles since the state last changed.
    waited: u64,
    /// Number of consecutive cycles, up to the latest cycle, whose flags agree with the next state.
    in_a_row: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cable {
    /// The cable is in and must be pulled.
    In,
    /// The cable is out and must be plugged in.
    Out,
    /// The cable is in again and the bus works.
    Back,
}

impl<'a> Pull<'a> {
    pub fn new(session: &'a Session, cycles_per_s: u64) -> Self {
        Self { faults: session.faults.as_ref(), cycles_per_s, state: Cable::In, waited: 0, in_a_row: 0 }
    }

    /// Instructs the person to move the cable. On the simulated bus, switches the fault instead.
    pub fn ask(&self, print: &mut dyn FnMut(&str)) {
        match (self.state, self.faults) {
            (Cable::In, Some(faults)) => faults.begin(Fault::LinkDown),
            (Cable::Out, Some(faults)) => faults.end(Fault::LinkDown),
            (Cable::In, None) => print("pull the cable between this PC and the coupler, and leave it out"),
            (Cable::Out, None) => print("plug the cable in again"),
            (Cable::Back, _) => {}
        }
    }

    /// Evaluates the record of a cycle. Returns false once the check is over.
    pub fn take(&mut self, record: &CycleRecord, print: &mut dyn FnMut(&str)) -> bool {
        let (shows_next, wanted_s) = match self.state {
            Cable::In => (record.flags & (flags::NO_REPLY | flags::BUS_DOWN) != 0, OUT_S),
            Cable::Out => (record.flags & BUS_FLAGS == 0, BACK_S),
            Cable::Back => return false,
        };
        self.waited += 1;
        self.in_a_row = if shows_next { self.in_a_row + 1 } else { 0 };
        if self.in_a_row >= wanted_s * self.cycles_per_s {
            self.state = if self.state == Cable::In { Cable::Out } else { Cable::Back };
            (self.waited, self.in_a_row) = (0, 0);
            self.ask(print);
        }
        self.state != Cable::Back && self.waited < PATIENCE_S * self.cycles_per_s
    }

    pub fn outcome(&self, session: &Session) -> Outcome {
        match self.state {
            Cable::Back => Outcome::passed("the bus is in operation again"),
            Cable::In => Outcome::Failed {
                expected: format!("the cable is pulled within {PATIENCE_S} s, and is out for {OUT_S} s"),
                found: "replies".into(),
                remedy: "pull the cable from the upper (IN) socket of the coupler when asked".into(),
                code: None,
            },
            Cable::Out => {
                let expected = format!("the bus in operation within {PATIENCE_S} s");
                let fact = session.outage().unwrap_or_else(|| Fact::BusNoAnswer { bus: session.bus.clone() });
                Outcome::failed(expected, &fact.into(), None)
            }
        }
    }
}
