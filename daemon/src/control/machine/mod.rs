//! The states of the acquisition, as a pure function of events.
//!
//! The thesis' five states (waiting, opening, sampling, writing, closing), one for homing, and a fault that lasts until its
//! cause is removed, automatically or by a person. Each run that was opened ends with exactly one [`Action::Finished`] or
//! [`Action::NotBegun`] that states the cause.
//!
//! | from | on | to |
//! |---|---|---|
//! | fault | bus in operation, disk ready | waiting |
//! | waiting | start | opening |
//! | waiting | home | homing |
//! | homing | marks saved, stop, failure | waiting |
//! | opening | file created; cannot be created | sampling; waiting |
//! | sampling | a second of it is on disk | writing |
//! | writing | nothing new on disk for three seconds | sampling |
//! | sampling, writing | stop, duration, disk too full, no sample for `full_fault_s`, signal, bus lost for good | closing |
//! | closing | file finished; could not be | waiting, or fault if the bus is not in operation; fault |
//! | waiting | bus gives no samples | fault |
//!
//! A run continues while the cycle restores the bus: its records state the fault. In opening the end of a run waits for its file.

mod transitions;

#[cfg(test)]
mod tests;

pub use transitions::StateMachine;

pub use crate::control::status::ServiceState as State;
use crate::problem::Problem;
use crate::run::RunDetails;

/// Input of the state machine.
#[derive(Debug, Clone, PartialEq)]
pub enum MachineEvent {
    /// The bus is in operation.
    BusUp,
    /// The bus cannot be brought into operation, or the thread of its cycle has ended.
    BusDown(Problem),
    /// The bus gives no samples; the cycle is restoring it.
    BusTroubled(Problem),
    /// A run is requested. If no person chose its name, a run that is active already satisfies the request.
    Start {
        /// Its name and details.
        run: Box<RunDetails>,
        /// The name was chosen by a person.
        named: bool,
    },
    /// Homing of the encoders is requested.
    Home,
    /// Homing is over, whether marks were found or not.
    HomingOver,
    /// The run's file is created.
    Opened,
    /// The run's file cannot be created.
    OpenFailed(Problem),
    /// More of the run is on disk.
    Synced,
    /// Nothing has reached the disk for too long.
    Stalled,
    /// The end of the run is requested, with the cause.
    Stop(String),
    /// The run ends for a reason of its own: its duration, a disk that is too full, no sample for `full_fault_s`.
    Ended(String),
    /// The run's file is finished.
    Closed,
    /// The run's file could not be finished regularly.
    CloseFailed(Problem),
    /// The files of earlier runs are recovered: those from before the start of the service, or of a run that failed.
    Recovered,
    /// The end of the service is requested, with the cause.
    Shutdown(String),
}

/// Output of the state machine, to be executed.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Bring the bus into operation.
    Connect,
    /// Create the file of this run and begin to sample.
    Open(Box<RunDetails>),
    /// Determine the encoders' reference marks.
    BeginHoming,
    /// End the homing, with the cause.
    EndHoming(String),
    /// End the run's cycles, with the cause.
    End(String),
    /// A run is over.
    Finished {
        /// Name of the run.
        run: String,
        /// Cause of its end.
        cause: String,
    },
    /// A run could not begin.
    NotBegun {
        /// Name of the run.
        run: String,
        /// Why it has no file.
        problem: Problem,
    },
    /// Recover the file of a failed run.
    Recover,
    /// Reply to the client.
    Answer(Answer),
    /// End the service, since no run and no homing is active any more.
    Exit,
}

/// Reply to a command.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The run, or the homing, begins.
    Beginning,
    /// A homing is active, or was until this command.
    Homing,
    /// This run is active already, and is the requested one.
    Running(String),
    /// Another run is active.
    Busy(String),
    /// It cannot begin, and why.
    Refused(Problem),
    /// The run is being ended.
    Stopping(String),
    /// There is nothing to end.
    Idle,
}
