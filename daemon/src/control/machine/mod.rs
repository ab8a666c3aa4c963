//! The states of the acquisition, as a pure function of events.
//!
//! There are seven states: the five of the thesis (waiting, opening, sampling, writing, closing), one for homing, and a
//! fault. The fault lasts until its cause is removed, automatically or by a person. Each run that was opened ends with
//! exactly one [`Action::Finished`] or [`Action::NotBegun`]; both report the cause.
//!
//! | from | event | to |
//! |---|---|---|
//! | fault | bus in operation, disk ready | waiting |
//! | waiting | start | opening |
//! | waiting | home | homing |
//! | homing | marks saved, stop, failure | waiting, or fault if bus or disk have a fault |
//! | opening | file created | sampling, or closing if the end of the run was requested |
//! | opening | file cannot be created | waiting, or fault if bus or disk have a fault |
//! | sampling | new cycles are safe on disk | writing |
//! | writing | nothing new on disk for three sync periods | sampling |
//! | sampling, writing | stop, duration, disk too full, no sample for `full_fault_s`, signal, bus lost for good | closing |
//! | closing | file finished | waiting, or fault if the bus is not in operation |
//! | closing | file could not be finished | fault |
//! | waiting | bus delivers no samples | fault |
//!
//! If the bus delivers no samples for a while, a run continues while the cycle thread restores the bus. The records of these
//! cycles are flagged. If the end of a run is requested in the state opening, the run ends once its file has been created.

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
    /// The bus cannot be brought into operation, or the cycle thread has ended.
    BusDown(Problem),
    /// The bus delivers no samples. The cycle thread is restoring the bus.
    BusTroubled(Problem),
    /// A run is requested. If no person chose the name, any active run already satisfies the request.
    Start {
        /// Name and details of the run.
        run: Box<RunDetails>,
        /// Whether a person chose the name.
        named: bool,
    },
    /// Homing of the encoders is requested.
    Home,
    /// The homing is over, whether marks were found or not.
    HomingOver,
    /// The file of the run has been created.
    Opened,
    /// The file of the run cannot be created.
    OpenFailed(Problem),
    /// New cycles of the run are safe on disk.
    Synced,
    /// For three sync periods, no new cycle has become safe on disk.
    Stalled,
    /// The end of the run is requested, with the cause.
    Stop(String),
    /// The run ends without a request, because its duration is over, the disk is too full, or no sample
    /// arrived for `full_fault_s`.
    Ended(String),
    /// The file of the run is finished.
    Closed,
    /// The file of the run could not be finished regularly.
    CloseFailed(Problem),
    /// The files of earlier runs have been recovered. Such a run was interrupted before the service started, or it failed.
    Recovered,
    /// The end of the service is requested, with the cause.
    Shutdown(String),
}

/// Output of the state machine, which the controller executes.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Bring the bus into operation.
    Connect,
    /// Create the file of this run and start to sample.
    Open(Box<RunDetails>),
    /// Determine the encoders' reference marks.
    BeginHoming,
    /// End the homing, with the cause.
    EndHoming(String),
    /// End the cycles of the run, with the cause.
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
        /// Why the run has no file.
        problem: Problem,
    },
    /// Recover the file of a failed run.
    Recover,
    /// Reply to the client.
    Answer(Answer),
    /// End the service, because its end was requested and no run or homing is active any more.
    Exit,
}

/// Reply to a command.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The run, or the homing, begins.
    Beginning,
    /// A homing is active, or was active until this command stopped it.
    Homing,
    /// The requested run, which has this name, is active already.
    Running(String),
    /// A run with this name is active and prevents the requested run or homing.
    Busy(String),
    /// The run or homing cannot begin because of this problem.
    Refused(Problem),
    /// The run is being ended.
    Stopping(String),
    /// There is no run or homing to end.
    Idle,
}
