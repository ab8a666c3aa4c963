//! Validation of a calibration: held-out samples, agreement of data sets, and partial deployments.

pub mod agreement;
pub mod deployment;
pub mod held_out;
