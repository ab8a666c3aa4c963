//! Recovery, service and log on disks that are slow, hang, fill, refuse or vanish, in real time.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod leftovers;
mod log;
mod memory;
mod service;
mod silent;
