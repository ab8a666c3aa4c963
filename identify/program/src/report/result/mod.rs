//! The files of a calibration: all estimated parameters with their uncertainty and validation, and files for other programs.

pub mod clocks;
pub mod corrections;
pub mod deployments;
pub(crate) mod earlier;
pub mod file;
pub mod force;
pub mod knowledge;
pub(in crate::report) mod read;
pub mod residuals;
pub mod robot_files;
pub mod validation;
