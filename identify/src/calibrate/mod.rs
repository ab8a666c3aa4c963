//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
pub mod blocks;
pub mod candidates;
mod config;
pub mod cross_validation;
pub mod measured_length;
pub mod measured_pose;
mod robust;
pub mod several;
pub mod structure;
pub mod truth;

pub use config::{CostName, IdentifyConfig, JointTermsConfig, NoiseConfig, SelectionName};
pub use robust::{LossName, solve_from_subsets, solve_robust};
