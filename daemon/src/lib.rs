//! Acquisition daemon for a sensed double ball-bar on EtherCAT.
//!
//! The way of the data: [`segment`] (wire) -> [`bus`] -> [`cycle`] -> ring -> [`record`] -> file; [`run`] ties
//! them together, [`control`] keeps them going as a service, [`commands`] is what a person types.

// A reader of standard output that has gone must end nothing: commands print with `say`.
#![warn(clippy::print_stdout)]

pub mod bus;
pub mod claim;
pub mod clock;
pub mod commands;
pub mod control;
pub mod cycle;
pub mod devices;
pub mod homing;
pub mod log;
pub mod page;
pub mod problem;
pub mod record;
pub mod run;
pub mod scheduler;
pub mod segment;
pub mod smoke;
pub mod tuning;
mod whole_file;
