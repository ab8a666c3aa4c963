//! Recovery, log, downloads and `ballbard record` on disks that hang or refuse, in real time.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod leftovers;
mod log;
mod memory;
mod service;
