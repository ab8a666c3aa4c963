//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
pub mod blocks;
mod by_cost;
pub mod candidates;
mod config;
pub mod cross_validation;
pub mod held_out;
pub mod measured_length;
pub mod measured_pose;
pub mod other_costs;
pub mod refusal;
mod repetition;
mod ripple;
mod robust;
mod rows;
pub mod several;
pub mod structure;
mod sudden;
pub mod truth;

pub use config::{CostName, IdentifyConfig, JointTermsConfig, NoiseConfig, SelectionName};
pub use robust::{LossName, solve_from_subsets, solve_robust};
