//! A robot's configuration before anything is measured: taken from a URDF, checked and drawn.

mod check;
mod ends;
mod import;
mod urdf;

pub use check::{RobotCheck, check};
pub use import::{ImportError, Imported, import};
