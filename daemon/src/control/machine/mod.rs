//! The states of the acquisition, as a pure function of events.
//!
//! The thesis' five states (waiting, opening, sampling, writing, closing), one for homing, and one for what it had no
//! answer to: a fault, which lasts until what caused it is put right, by itself or by somebody. A run that was opened
//! leaves exactly one [`Action::Finished`] or [`Action::NotBegun`] with its cause, whatever happens meanwhile.
//!
//! | from | on | to |
//! |---|---|---|
//! | fault | bus in operation, disk looked after | waiting |
//! | waiting | start | opening |
//! | waiting | home | homing |
//! | homing | marks kept, stop, failure | waiting |
//! | opening | file there; cannot be created | sampling; waiting |
//! | sampling | a second of it is on disk | writing |
//! | writing | nothing new on disk for three seconds | sampling |
//! | opening, sampling, writing | stop, duration, disk floor, full fault, signal | closing |
//! | closing | file finished; could not be | waiting; fault |
//! | waiting, closing | bus not in operation | fault (a run that goes on keeps its state: its cycles say so) |

mod transitions;

#[cfg(test)]
mod tests;

pub use transitions::Machine;

use crate::problem::Problem;
use crate::run::RunDetails;

/// Where the acquisition is.
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// Nothing can be recorded, and why; it is being worked on.
    Fault {
        /// What is wrong and what to do.
        problem: Problem,
    },
    /// The bus is in operation, no run goes on.
    Waiting,
    /// The encoders' reference marks are being looked for.
    Homing,
    /// A run's file is being created; its cycles wait in memory.
    Opening {
        /// Its name.
        run: String,
        /// Somebody has asked already that it end, and why.
        stop: Option<String>,
    },
    /// Cycles are being sampled, but none of the last seconds has reached the disk.
    Sampling {
        /// Name of the run.
        run: String,
    },
    /// Cycles are being sampled and reach the disk.
    Writing {
        /// Name of the run.
        run: String,
    },
    /// The rest is being written and the file finished.
    Closing {
        /// Name of the run.
        run: String,
        /// Why it ends.
        cause: String,
    },
}

/// What happens.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The bus is in operation.
    BusUp,
    /// The bus cannot be brought into operation, or what worked on it has ended.
    BusDown(Problem),
    /// The bus gives no samples, and what works on it is bringing it back.
    BusTroubled(Problem),
    /// Somebody wants a run; without a name whichever is convenient.
    Start {
        /// What is to be recorded.
        run: Box<RunDetails>,
        /// The name was chosen by a person.
        named: bool,
    },
    /// Somebody wants the encoders homed.
    Home,
    /// Homing is over, whether marks were found or not.
    HomingOver,
    /// The run's file is there.
    Opened,
    /// The run's file cannot be created.
    OpenFailed(Problem),
    /// More of the run is on disk.
    Synced,
    /// Nothing has reached the disk for too long.
    Stalled,
    /// Somebody wants the run to end, and why.
    Stop(String),
    /// The run ends by itself: duration, disk floor, full fault.
    Ended(String),
    /// The run's file is finished.
    Closed,
    /// The run's file could not be finished in the ordinary way.
    CloseFailed(Problem),
    /// What earlier runs left has been looked after: those before the service, or one that failed.
    Recovered,
    /// The service is asked to end, and by what.
    Shutdown(String),
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Bring the bus into operation.
    Connect,
    /// Create the file of this run and begin to sample.
    Open(Box<RunDetails>),
    /// Look for the encoders' reference marks.
    BeginHoming,
    /// Stop looking for them, for this cause.
    EndHoming(String),
    /// Take no more cycles, for this cause.
    End(String),
    /// A run is over.
    Finished {
        /// Its name.
        run: String,
        /// Why.
        cause: String,
    },
    /// A run got no file.
    NotBegun {
        /// Its name.
        run: String,
        /// Why.
        problem: Problem,
    },
    /// Look after what a failed run left.
    Recover,
    /// Tell who asked.
    Answer(Answer),
    /// End the service.
    Exit,
}

/// What somebody who asked is told.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The run, or the homing, is being begun.
    Beginning,
    /// The encoders are being homed already, or were until this was asked.
    Homing,
    /// This run goes on already and is the one that was asked for.
    Running(String),
    /// Another run goes on.
    Busy(String),
    /// It cannot begin.
    Refused(Problem),
    /// The run is being ended.
    Stopping(String),
    /// Nothing goes on that could be ended.
    Idle,
}
