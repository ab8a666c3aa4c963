//! Accuracy of the calibrated robot: over its workspace, in the cube of ISO 9283, and the region where it is valid.

pub(in crate::evaluate) mod budget;
pub(in crate::evaluate) mod cube;
pub(in crate::evaluate) mod validity;
pub(in crate::evaluate) mod workspace;
