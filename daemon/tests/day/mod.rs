//! A day of a service on virtual time. Tests of this folder let the bus fail, or let the disk hang, refuse
//! calls or fail for good.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod bus;
mod calls;
mod codes;
mod disk;
mod hangs;
mod requests;
mod rig;
mod runs;
