//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
mod config;
pub mod measured_length;
mod robust;
pub mod truth;

pub use config::{CostName, IdentifyConfig, NoiseConfig, SelectionName};
pub use robust::{LossName, solve_from_subsets, solve_robust};
