//! Accuracy of the calibrated robot over its workspace and in the cube of ISO 9283, and the region where
//! the calibration is valid.

pub(in crate::evaluate) mod budget;
pub(in crate::evaluate) mod cube;
pub(in crate::evaluate) mod validity;
pub(in crate::evaluate) mod workspace;
