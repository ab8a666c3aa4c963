//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
pub mod change;
mod config;
pub mod mix;
pub mod pipeline;
pub mod refusal;
pub mod rows;
pub mod selection;
pub mod validation;

pub use config::{CostName, IdentifyConfig, JointTermsConfig, NoiseConfig, SelectionName};
pub(crate) use validation::repetition::independent_segments;
pub use validation::split::HoldOut;
