//! What people and programs get to see of a calibration. Computes nothing.

pub mod file;
pub mod table;
