//! Validation of a calibration: held-out samples, unseen parts of an instrument, agreement of data sets, and partial
//! deployments.

pub mod agreement;
pub mod deployment;
pub mod held_out;
pub mod unseen;
