//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
mod config;
pub mod cross_validation;
pub mod measured_length;
pub mod measured_pose;
mod robust;
pub mod truth;

pub use config::{CostName, IdentifyConfig, NoiseConfig, SelectionName};
pub use robust::{LossName, solve_from_subsets, solve_robust};
