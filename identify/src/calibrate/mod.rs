//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
pub mod change;
mod config;
pub mod deployment;
pub mod held_out;
mod line_spectrum;
mod links;
pub mod mix;
pub mod other_costs;
pub mod pipeline;
pub mod refusal;
mod repetition;
pub mod rows;
pub(crate) mod split;
pub mod structure;
pub mod terms;
pub mod truth;

pub use config::{CostName, IdentifyConfig, JointTermsConfig, NoiseConfig, SelectionName};
pub(crate) use repetition::independent_segments;
pub use split::HoldOut;
