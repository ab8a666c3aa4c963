//! Calibration of a robot from measurements: creates the models of the data sets, estimates their parameters, and validates
//! the result. `driver` runs these stages, and `pipeline` contains the estimation.

mod calibration;
pub mod change;
mod config;
pub mod contradicted;
mod data_sets;
mod driver;
mod error;
mod lay_out;
pub mod pipeline;
pub mod refusal;
pub mod rows;
pub mod selection;
mod uncertainty;
pub mod validation;

pub use calibration::Calibration;
pub use config::{IdentifyConfig, JointTermsConfig, SelectionName};
pub use data_sets::{BarRun, DataSets, RunInput};
pub use driver::{calibrate, calibrate_run, calibrate_runs};
pub use error::CalibrateError;
