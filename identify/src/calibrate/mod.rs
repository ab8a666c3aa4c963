//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
mod config;
pub mod measured_length;
pub mod truth;

pub use config::{CostName, IdentifyConfig, SelectionName};
