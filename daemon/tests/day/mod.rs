//! A day of a service on virtual time, with a bus that fails or a disk that hangs, refuses or dies.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod bus;
mod calls;
mod hangs;
mod rig;
