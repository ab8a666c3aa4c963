//! Recovery, log, downloads and `ballbard record` in real time, on disks that hang or refuse calls.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod leftovers;
mod log;
mod memory;
mod service;
