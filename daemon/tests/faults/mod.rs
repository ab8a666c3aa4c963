//! The acquisition while the simulated segment has faults. All tests run on virtual time.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod bus_time;
mod links;
mod matrix;
mod random;
mod rig;
