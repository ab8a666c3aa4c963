//! Recorder, recovery, service and log on disks that are slow, hang, fill, refuse or vanish: nothing that was said to be safe is lost, nothing
//! wrong is said, and the run goes on or ends as stated.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod calls;
mod leftovers;
mod log;
mod memory;
pub mod rig;
mod service;
mod slow;
mod wall;
