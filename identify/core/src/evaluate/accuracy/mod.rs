//! How accurate the calibrated robot is: over its workspace, at the standard's cube, at a pose, and beside other calibrations.

pub(in crate::evaluate) mod budget;
pub(in crate::evaluate) mod cube;
pub(in crate::evaluate) mod validity;
pub(in crate::evaluate) mod workspace;
