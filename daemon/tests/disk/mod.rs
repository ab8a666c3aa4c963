//! Recovery, log, downloads and the command that records, on disks that hang or refuse, in real time.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod leftovers;
mod log;
mod memory;
mod service;
