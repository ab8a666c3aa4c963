//! The service over loopback. Requests are idempotent, only one run is recorded at a time, invalid input is refused,
//! and every file is finished.
#![allow(clippy::unwrap_used, reason = "tests")]

mod check;
mod clients;
mod codes;
mod elsewhere;
mod ends;
mod foxglove;
mod homing;
mod mounts;
mod outputs;
mod page;
mod remote;
mod requests;
mod rig;
mod runs;
mod systemd;
mod truth;
