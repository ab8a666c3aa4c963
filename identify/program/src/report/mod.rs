//! Output of results: the files of a calibration ([`result`]), text and tables for the terminal, and HTML pages ([`page`]).

mod calibrated_robot;
mod consistency;
pub mod examination;
pub mod page;
pub mod path;
pub mod result;
mod robot_check;
pub mod rows;
pub mod side_by_side;
pub mod summary;
pub mod table;
pub mod verdict;

pub use calibrated_robot::{CalibratedRobot, CalibratedRobotError};
pub use consistency::{Consistency, ConsistencyError, ParameterEstimates};
pub use page::picture;

pub use result::read::CalibrationReadError;
pub use robot_check::robot_check;
