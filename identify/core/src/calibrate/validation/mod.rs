//! What judges a calibration: samples that were held out, controllers that take a part of it.

pub mod agreement;
pub mod deployment;
pub mod held_out;
