//! The user interface of a calibration. [`commands`] is the command line, and [`report`] writes the results. [`inspect`]
//! lists the content of files, and [`examine`] lists the parameters that a cost can identify.

// A closed standard output must not end a command. Commands therefore print with `say` and `show`.
#![warn(clippy::print_stdout)]

pub mod commands;
pub mod examine;
pub mod inspect;
pub mod report;

use identify_core::{
    calibrate, cost, evaluate, instrument, kinematics, logs, model, plan, prepare, robot, simulate, solver,
    statistics, study, threads,
};
