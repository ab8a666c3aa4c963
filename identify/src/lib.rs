//! Calibration of a robot from a ball-bar recording and the robot's own log.

pub mod calibrate;
pub mod cost;
pub mod kinematics;
pub mod model;
pub mod solver;
