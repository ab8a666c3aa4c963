//! What people see of a calibration: [`commands`] is what a person types, [`report`] what comes of it; [`inspect`] says what a
//! file contains, [`examine`] what a cost can identify.

// A reader of standard output that has gone must end nothing: commands print with `say` and `show`.
#![warn(clippy::print_stdout)]

pub mod commands;
pub mod examine;
pub mod inspect;
pub mod report;

use identify_core::{
    calibrate, cost, evaluate, instrument, kinematics, logs, model, plan, prepare, robot, simulate, solver,
    statistics, study, threads,
};
