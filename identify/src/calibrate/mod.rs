//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
mod by_cost;
mod config;
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
mod split;
pub mod structure;
mod sudden;
pub mod terms;
pub mod truth;

pub use config::{CostName, IdentifyConfig, JointTermsConfig, NoiseConfig, SelectionName};
pub use robust::{LossName, solve_from_subsets, solve_robust};
pub use split::HoldOut;
