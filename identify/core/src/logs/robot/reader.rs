//! Reads a robot's joint log of any supported format, from a file or from memory, and returns a [`RobotLog`].
//!
//! The robot's own CSV has a header row with `t_s` and one column for each axis. The robot's configuration
//! determines the names of these columns, `{column}{1..}_{rad|deg|m}`. Other columns are ignored. Lines
//! `# key: value` before or between rows declare `robot`, `clock` and `values` (measured or commanded). Cells are
//! separated by comma, semicolon or tab, and numbers have a decimal point. A byte order mark and CRLF are allowed.
//! Tables with other columns need a [`RobotLogMapping`].

use std::path::Path;

use shared::config::RobotConfig;

use super::mapping::RobotLogMapping;
use super::{egm, ros, rsi, table};
use crate::logs::source::LogSource;
use crate::logs::{LogError, LogFormat, RobotLog};

/// Properties of a log that the file does not contain.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LogOptions {
    /// Format of the file; `None` if it is recognised by the content.
    pub format: Option<LogFormat>,
    /// Columns or joints of the file; `None` for those of the robot's own log.
    pub mapping: Option<RobotLogMapping>,
}

/// Reads the log at `path`. The format is recognised by the content.
///
/// # Errors
/// Every way in which the file cannot be used, see [`LogError`].
pub fn load(path: &Path, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    load_with(path, robot, &LogOptions::default())
}

/// Like [`load`], but for bytes in memory. `path` is only used in error messages, and its extension may determine the format.
///
/// # Errors
/// As [`load`].
pub fn read(bytes: &[u8], path: &Path, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    read_with(bytes, path, robot, &LogOptions::default())
}

/// Like [`load`], but with options that the file does not contain.
///
/// # Errors
/// As [`load`].
pub fn load_with(path: &Path, robot: &RobotConfig, options: &LogOptions) -> Result<RobotLog, LogError> {
    read_from(LogSource::open(path)?, robot, options)
}

/// Like [`read`], but with options that the file does not contain.
///
/// # Errors
/// As [`load`].
pub fn read_with(
    bytes: &[u8],
    path: &Path,
    robot: &RobotConfig,
    options: &LogOptions,
) -> Result<RobotLog, LogError> {
    read_from(LogSource::in_memory(bytes, path), robot, options)
}

fn read_from(source: LogSource<'_>, robot: &RobotConfig, options: &LogOptions) -> Result<RobotLog, LogError> {
    let path = source.path;
    let format = options.format.map_or_else(|| LogFormat::detect(source.beginning(), path), Ok)?;
    let mapping = options.mapping.as_ref();
    match (format, mapping) {
        (LogFormat::Csv, None) => table::read_own(source, robot),
        (LogFormat::UrRtde, None) => table::read_rtde(source, robot),
        (LogFormat::Csv | LogFormat::UrRtde, Some(mapping)) => table::read_mapped(source, robot, mapping),
        (LogFormat::Ros2Mcap | LogFormat::Ros2Db3, _) => {
            ros::read(&source.whole()?, path, robot, format, mapping)
        }
        (LogFormat::Egm, _) => egm::read(&source.whole()?, path, robot, mapping),
        (LogFormat::Rsi, _) => rsi::read(source, robot, mapping),
    }
}
