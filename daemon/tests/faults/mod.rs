//! The acquisition on a simulated segment with faults. All tests run in virtual time.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod bus_time;
mod links;
mod matrix;
mod random;
mod rig;
