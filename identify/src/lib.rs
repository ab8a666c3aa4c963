//! Calibration of a robot from a ball-bar recording and the robot's own log. This crate exports two crates under one name:
//! `identify-core` computes, and `identify-program` has the commands and reports.

pub use identify_core::{
    calibrate, cost, evaluate, instrument, kinematics, logs, model, plan, prepare, robot, simulate, solver,
    statistics, study,
};
pub use identify_program::{commands, examine, inspect, report};
