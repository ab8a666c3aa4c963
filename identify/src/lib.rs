//! Calibration of a robot from a ball-bar recording and the robot's own log.
//!
//! The way of the data: [`logs`] and the recording -> [`prepare`] -> [`model`] and [`cost`] -> [`solver`] ->
//! [`calibrate`] ties them together -> [`evaluate`] looks at the result -> [`report`]; [`plan`] finds paths worth driving,
//! [`simulate`] makes experiments with known truth, [`study`] makes them by the thousand, [`robot`] takes a robot from a URDF and checks it, [`commands`] is what a person types.

// A reader of standard output that has gone must end nothing: commands print with `say` and `show`.
#![warn(clippy::print_stdout)]

pub mod calibrate;
pub mod commands;
pub mod cost;
pub mod evaluate;
pub mod examine;
pub mod inspect;
pub mod instrument;
pub mod kinematics;
pub mod logs;
pub mod model;
pub mod plan;
pub mod prepare;
pub mod report;
pub mod robot;
pub mod simulate;
pub mod solver;
mod statistics;
pub mod study;
mod threads;
