//! Prepares a robot's configuration before any measurement: imports it from a URDF file, and checks it.

mod check;
mod ends;
mod import;
mod urdf;

pub use check::{RobotCheck, check};
pub use import::{ImportError, Imported, import};
