//! From data to a calibrated robot.

pub mod measured_length;
