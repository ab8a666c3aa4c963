//! Acquisition daemon for a sensed double ball-bar on EtherCAT.
//!
//! Data flow: [`segment`] (wire) -> [`bus`] -> [`cycle`] -> ring -> [`record`] -> file. [`run`] connects these modules,
//! [`control`] operates them as a service, and [`commands`] is the command line.

// A closed standard output must not end the process, so commands print with `say`.
#![warn(clippy::print_stdout)]

pub mod bus;
mod claim;
pub mod clock;
pub mod commands;
pub mod control;
pub mod cycle;
mod devices;
pub mod homing;
pub mod log;
mod page;
pub mod problem;
pub mod record;
pub mod run;
pub mod scheduler;
pub mod segment;
pub mod smoke;
pub mod tuning;
mod whole_file;
