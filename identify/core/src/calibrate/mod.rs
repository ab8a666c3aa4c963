//! The way from measurements to a calibration, in one call each.

pub mod ball_bar;
mod calibration;
pub mod change;
mod config;
mod error;
pub mod mix;
pub mod pipeline;
pub mod refusal;
pub mod rows;
pub mod selection;
pub mod validation;

pub use calibration::Calibration;
pub use config::{IdentifyConfig, JointTermsConfig, SelectionName};
pub use error::CalibrateError;
