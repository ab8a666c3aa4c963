//! A day of a service in virtual time. In these tests the bus fails, or the disk hangs, refuses calls, or fails for good.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod bus;
mod calls;
mod codes;
mod disk;
mod hangs;
mod requests;
mod rig;
mod runs;
