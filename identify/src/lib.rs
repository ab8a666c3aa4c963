//! Calibration of a robot from a ball-bar recording and the robot's own log, under one name: the numbers of `identify-core` and
//! what people see of them, `identify-program`.

pub use identify_core::{
    calibrate, cost, evaluate, instrument, kinematics, logs, model, plan, prepare, robot, simulate, solver,
    statistics, study,
};
pub use identify_program::{commands, examine, inspect, report};
