//! Validation of a calibration:
//!
//! - `held_out`: models that predict held-out segments of ball-bar runs,
//! - `unseen`: prediction of the rows at each part of an instrument, such as a socket,
//! - `agreement`: test whether data sets agree about the robot,
//! - `deployment`: fits for controllers that apply only some of the parameters.

pub mod agreement;
pub mod deployment;
pub mod held_out;
pub mod unseen;
