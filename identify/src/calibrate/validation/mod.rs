//! What judges a calibration: samples that were held out, controllers that take a part of it, a simulated truth.

pub mod agreement;
pub mod deployment;
pub mod held_out;
pub(in crate::calibrate) mod repetition;
pub(crate) mod split;
pub mod truth;
