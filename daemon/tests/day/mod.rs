//! A day of a service on virtual time: the bus fails, or the disk hangs, refuses or dies.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod bus;
mod calls;
mod codes;
mod disk;
mod hangs;
mod requests;
mod rig;
mod runs;
