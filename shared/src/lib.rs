//! Code that the acquisition daemon and the identifier share. It covers the conversion of counts to angles, the format of
//! recordings, time, configuration files, the drawing of the bar, and output.
//!
//! This crate depends on neither the bus nor the estimator.

pub mod config;
pub mod drawing;
pub mod encoder;
pub mod output;
pub mod recording;
pub mod time;
pub mod version;
