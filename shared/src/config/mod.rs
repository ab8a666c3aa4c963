//! Configuration from TOML files. An error names the file, the line, the key, what is wrong and what to do.

mod ball_bar;
mod daemon;
mod homing;
mod malformed;
mod robot;

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

pub use ball_bar::{BallBarConfig, EncoderConfig, bar_joint_name};
pub use daemon::{DaemonConfig, RealtimeConfig};
pub use homing::{HomedEncoder, HomingConfig};
pub use robot::{
    AXES_MAX, AXES_MIN, AngleUnit, Convention, DrivesConfig, JointKind, LinkConfig, LogConversion, Maker,
    RobotConfig, TransformConfig,
};

/// Why a configuration file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read configuration {}: {source}; check the path and its permissions", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The text is not TOML, or a key has the wrong name or type.
    #[error("{}: {message}", place(path, *line))]
    Malformed {
        /// The file.
        path: PathBuf,
        /// From 1; none where the fault is that something is absent.
        line: Option<usize>,
        /// Which key, what is wrong with it, and what was expected.
        message: String,
    },
    /// A value is outside what makes sense.
    #[error("{}: key `{key}`: {problem}; {remedy}", place(path, *line))]
    Invalid {
        /// The file.
        path: PathBuf,
        /// From 1; none where the key is absent.
        line: Option<usize>,
        /// Dotted path of the key.
        key: String,
        /// What is wrong with the value.
        problem: String,
        /// What to write instead.
        remedy: String,
    },
}

fn place(path: &Path, line: Option<usize>) -> String {
    let line = line.map(|line| format!(", line {line}")).unwrap_or_default();
    format!("{}{line}", path.display())
}

/// A value that breaks a rule, named by its key; [`load`] adds the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// Dotted path of the key.
    pub key: String,
    /// What is wrong with the value.
    pub problem: String,
    /// What to write instead.
    pub remedy: String,
}

impl Violation {
    /// A violation of `key`: what is wrong and what to do.
    pub fn new(key: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { key: key.into(), problem: problem.into(), remedy: remedy.into() }
    }
}

/// Rules that types alone cannot state, checked once after reading.
pub trait Validate {
    /// The first rule that is broken.
    fn validate(&self) -> Result<(), Violation>;
}

/// Reads, types and validates one configuration file.
pub fn load<T: DeserializeOwned + Validate>(path: &Path) -> Result<T, ConfigError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| ConfigError::Unreadable { path: path.to_owned(), source })?;
    parse(&text, path)
}

/// [`load`] on text already in memory; `path` is only named in errors.
pub fn parse<T: DeserializeOwned + Validate>(text: &str, path: &Path) -> Result<T, ConfigError> {
    let malformed = |key: Option<String>, error: &toml::de::Error| ConfigError::Malformed {
        path: path.to_owned(),
        line: malformed::line(text, error),
        message: malformed::message(key.as_deref(), error.message()),
    };
    let deserializer = toml::Deserializer::parse(text).map_err(|error| malformed(None, &error))?;
    let value: T = serde_path_to_error::deserialize(deserializer)
        .map_err(|error| malformed(Some(error.path().to_string()), error.inner()))?;
    value.validate().map_err(|Violation { key, problem, remedy }| ConfigError::Invalid {
        path: path.to_owned(),
        line: malformed::line_of(text, &key),
        key,
        problem,
        remedy,
    })?;
    Ok(value)
}
