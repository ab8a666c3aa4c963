//! What people and programs get: files, tables on a terminal, and a page.

pub mod clocks;
pub mod corrections;
pub mod deployments;
mod earlier;
pub mod examination;
pub mod file;
pub mod force;
pub mod knowledge;
pub mod page;
pub mod path;
mod read;
mod robot_check;
mod robot_files;
pub mod rows;
pub mod side_by_side;
pub mod summary;
pub mod table;
pub mod urdf;
pub mod validation;
pub mod verdict;

pub use page::picture;
pub use read::CalibrationReadError;
pub use robot_check::robot_check;
pub use robot_files::RobotFileError;
