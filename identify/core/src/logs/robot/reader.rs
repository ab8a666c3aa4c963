//! Reads a robot's joint log of any supported format.
//!
//! The robot's own CSV has a header row with `t_s` and a column for each axis, `{column}{1..}_{rad|deg|m}`, as the robot's
//! configuration names them; other columns are ignored. Lines `# key: value` before or between rows declare `robot`,
//! `clock` and `values` (measured or commanded). Comma, semicolon or tab between cells, decimal point, byte order mark and
//! CRLF allowed. Other tables need a [`RobotLogMapping`].

use std::path::Path;

use shared::config::RobotConfig;

use super::mapping::RobotLogMapping;
use super::{egm, ros, rsi, table};
use crate::logs::source::LogSource;
use crate::logs::{LogError, LogFormat, RobotLog};

/// How to read a log that does not state it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LogOptions {
    /// Kind of the file; `None`: recognised by its content.
    pub format: Option<LogFormat>,
    /// Columns or joints of the file.
    pub mapping: Option<RobotLogMapping>,
}

/// Reads the log at `path`, recognised by its content.
///
/// # Errors
/// Every way in which the file cannot be used, see [`LogError`].
pub fn load(path: &Path, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    load_with(path, robot, &LogOptions::default())
}

/// [`load`] on bytes in memory; `path` is only named in errors, and its ending may determine the format.
///
/// # Errors
/// As [`load`].
pub fn read(bytes: &[u8], path: &Path, robot: &RobotConfig) -> Result<RobotLog, LogError> {
    read_with(bytes, path, robot, &LogOptions::default())
}

/// [`load`] with options that the file does not state.
///
/// # Errors
/// As [`load`].
pub fn load_with(path: &Path, robot: &RobotConfig, options: &LogOptions) -> Result<RobotLog, LogError> {
    read_from(LogSource::open(path)?, robot, options)
}

/// [`read`] with options that the file does not state.
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
