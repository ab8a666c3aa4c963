//! What the acquisition daemon and the identifier agree on: how counts become angles, what a
//! recording looks like, how time is written, and how configuration is read.
//!
//! This crate knows neither the bus nor the estimator.

pub mod config;
pub mod encoder;
pub mod recording;
pub mod time;
