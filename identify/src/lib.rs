//! Calibration of a robot from a ball-bar recording and the robot's own log.

pub mod kinematics;
pub mod logs;
pub mod simulate;
