//! What the acquisition daemon and the identifier agree on: how counts become angles, what a
//! recording looks like, how time is written, how configuration is read, and how the programs print.
//!
//! This crate knows neither the bus nor the estimator.

pub mod config;
pub mod encoder;
pub mod output;
pub mod recording;
pub mod time;
pub mod version;
