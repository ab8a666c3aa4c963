//! Calibration of a robot from a ball-bar recording and the robot's own log.

pub mod calibrate;
pub mod cost;
pub mod kinematics;
pub mod logs;
pub mod model;
pub mod prepare;
pub mod simulate;
pub mod solver;
