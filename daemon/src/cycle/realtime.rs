//! Sets scheduling, core and memory of the thread that runs the cycle.

use std::fmt;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};

use nix::sched::{CpuSet, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::unistd::Pid;
use shared::config::RealtimeConfig;

use crate::tuning::Machine;

/// Result of the request for core, priority and locked memory. The value must be kept as long as the cycle runs. Without
/// these permissions acquisition also works, but its lateness then depends on the load of the machine.
#[derive(Debug)]
pub struct RealtimeReport {
    request: RealtimeConfig,
    core: io::Result<()>,
    fifo: io::Result<()>,
    memory: io::Result<()>,
    /// While this file is open, the processor does not enter deep idle states. `None` on machines that
    /// do not have this file.
    _awake: Option<File>,
}

impl RealtimeReport {
    /// Requests scheduling and core for the calling thread. Memory is locked for the whole process.
    pub fn apply(request: RealtimeConfig) -> Self {
        Self {
            core: request.core.map_or(Ok(()), pin_to_core),
            fifo: set_fifo(request.fifo_priority),
            memory: lock_memory(),
            _awake: stay_awake(),
            request,
        }
    }

    /// Whether every request was granted.
    pub fn is_complete(&self) -> bool {
        self.core.is_ok() && self.fifo.is_ok() && self.memory.is_ok()
    }
}

impl fmt::Display for RealtimeReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.core, self.request.core) {
            (Ok(()), Some(core)) => write!(f, "on core {core}")?,
            (Ok(()), None) => write!(f, "on any core")?,
            (Err(error), core) => {
                write!(
                    f,
                    "NOT pinned to core {} ({error}; choose an existing core in daemon.toml)",
                    core.unwrap_or(0)
                )?;
            }
        }
        match &self.fifo {
            Ok(()) => write!(f, ", SCHED_FIFO {}", self.request.fifo_priority)?,
            Err(error) => {
                write!(
                    f,
                    ", NOT real-time ({error}; run as root, or grant CAP_SYS_NICE or an rtprio limit)"
                )?;
            }
        }
        match &self.memory {
            Ok(()) => write!(f, ", memory locked"),
            Err(error) => {
                write!(
                    f,
                    ", memory NOT locked ({error}; run as root, or grant CAP_IPC_LOCK or an unlimited memlock)"
                )
            }
        }
    }
}

fn lock_memory() -> io::Result<()> {
    Machine::of_process().may_lock_memory().map_err(io::Error::other)?;
    Ok(mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE)?)
}

/// Requests that the processor always wakes up without delay (Linux, Documentation/power/pm_qos_interface.rst). The request
/// is valid as long as the file is open.
fn stay_awake() -> Option<File> {
    let mut file = OpenOptions::new().write(true).open("/dev/cpu_dma_latency").ok()?;
    file.write_all(&0i32.to_ne_bytes()).ok()?;
    Some(file)
}

fn pin_to_core(core: usize) -> io::Result<()> {
    let mut set = CpuSet::new();
    set.set(core)?;
    Ok(sched_setaffinity(Pid::from_raw(0), &set)?)
}

#[allow(unsafe_code, reason = "nix offers no sched_setscheduler")]
fn set_fifo(priority: i32) -> io::Result<()> {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: the structure outlives the call; 0 is the calling thread.
    let result = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const parameters) };
    if result == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}
