//! Reads configuration from TOML files. An error names the file, the line, the key, what is wrong and what to do.
//!
//! A file is parsed into a type with serde, then its values are checked ([`Validate`]). [`load`] accepts a path. It also
//! accepts the name of a configuration if the type has a [`Kind`].

mod ball_bar;
mod daemon;
mod find;
mod homing;
mod malformed;
mod robot;

use std::fmt;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde_path_to_error::Track;

pub use ball_bar::{BAR_JOINTS, BallBarConfig, EncoderConfig, bar_joint_name};
pub use daemon::{DaemonConfig, RealtimeConfig};
pub use find::{Kind, PLACES, Source};
pub use homing::{HomedEncoder, HomingConfig};
pub use malformed::nearest;
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
        /// Path of the file concerned.
        path: PathBuf,
        /// Error of the system call.
        source: std::io::Error,
    },
    /// No file exists at the path, and no configuration has this name.
    #[error("there is no file {} and no {} of that name{nearest} Known by name: {known}", path.display(), kind.noun())]
    Unknown {
        /// The path or name that was given.
        path: PathBuf,
        /// Kind of configuration that is needed.
        kind: Kind,
        /// End of the message: a suggestion of the most similar known name, or a full stop.
        nearest: String,
        /// Names of all configurations of this kind.
        known: String,
    },
    /// The text is not TOML, a key has the wrong name or type, or the text is a configuration of another kind.
    #[error("{}: {message}", place(path, *line))]
    Malformed {
        /// Path of the file concerned.
        path: PathBuf,
        /// Line number, from 1. `None` if the error has no line, such as an absent key.
        line: Option<usize>,
        /// What is wrong and what was expected. If a key is wrong, the message contains its name.
        message: String,
    },
    /// The value of a key is invalid.
    #[error("{}: key `{key}`: {problem}; {remedy}", place(path, *line))]
    Invalid {
        /// Path of the file concerned.
        path: PathBuf,
        /// Line number, from 1. `None` if the key is absent.
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

/// The value of a key breaks a rule. [`load`] adds the path of the file and the line of the key.
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
    /// A violation from the key, what is wrong with its value, and what to do about it.
    pub fn new(key: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { key: key.into(), problem: problem.into(), remedy: remedy.into() }
    }

    /// Returns a violation of `key` if `holds` is false.
    pub fn unless(
        holds: bool,
        key: impl Into<String>,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Result<(), Self> {
        if holds { Ok(()) } else { Err(Self::new(key, problem, remedy)) }
    }

    /// Returns a violation of `key` if its value is outside the range from `low` to `high`. Both limits are allowed values.
    pub fn unless_within<N: PartialOrd + fmt::Display>(
        key: impl Into<String>,
        value: N,
        [low, high]: [N; 2],
        remedy: &str,
    ) -> Result<(), Self> {
        let is_within = (&low..=&high).contains(&&value);
        Self::unless(is_within, key, format!("{value} is outside {low} to {high}"), remedy)
    }
}

/// Rules of a configuration that its types cannot express. They are checked after parsing.
pub trait Validate {
    /// The kind of this configuration, if it may be given by name. `None` if only a path is accepted.
    const KIND: Option<Kind> = None;

    /// Checks all rules. Returns a violation of the first rule that is broken.
    fn validate(&self) -> Result<(), Violation>;
}

/// Reads and validates a configuration file. If `T` has a [`Kind`], `path` may also be a name, see [`Source::find`].
pub fn load<T: DeserializeOwned + Validate>(path: &Path) -> Result<T, ConfigError> {
    let Some(kind) = T::KIND else {
        return parse(&Source::File(path.to_owned()).text()?, path);
    };
    let source = Source::find(path);
    let text = source.text().map_err(|error| match error {
        ConfigError::Unreadable { source, .. } if source.kind() == ErrorKind::NotFound => unknown(path, kind),
        error => error,
    })?;
    match &source {
        Source::File(file) if file == path => {}
        Source::File(file) => tracing::info!("{}: {}", kind.noun(), file.display()),
        Source::BuiltIn(name, _) => tracing::info!("{}: `{name}` as built into the program", kind.noun()),
    }
    parse(&text, source.path())
}

fn unknown(path: &Path, kind: Kind) -> ConfigError {
    let robots = Source::robots();
    let known: Vec<&str> = match kind {
        Kind::Robot => robots.iter().map(|(name, _)| name.as_str()).collect(),
        other => other.names(),
    };
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    ConfigError::Unknown {
        path: path.to_owned(),
        kind,
        nearest: did_you_mean(&stem, known.iter().copied()),
        known: known.join(", "),
    }
}

/// The end of a message about a wrong name: a suggestion of the most similar known name, or a full stop.
fn did_you_mean<'a>(wrong: &str, known: impl Iterator<Item = &'a str>) -> String {
    nearest(wrong, known).map_or_else(|| ".".to_owned(), |name| format!("; did you mean `{name}`?"))
}

/// Parses and validates a text that is already in memory. `path` is used in messages only.
pub fn parse<T: DeserializeOwned + Validate>(text: &str, path: &Path) -> Result<T, ConfigError> {
    let mut keys = Track::new();
    let value: Result<T, _> = erased_serde::deserialize(&mut *reader(text, path, &mut keys)?);
    let value = value.map_err(|error| malformed(text, path, T::KIND, &keys.path().to_string(), &error))?;
    value.validate().map_err(|Violation { key, problem, remedy }| ConfigError::Invalid {
        path: path.to_owned(),
        line: malformed::line_of(text, &key),
        key,
        problem,
        remedy,
    })?;
    Ok(value)
}

/// A deserializer for a TOML text. It records the path of the current key in `keys`. Its type is the same for all
/// configurations, so the compiler builds it only once.
fn reader<'a>(
    text: &'a str,
    path: &Path,
    keys: &'a mut Track,
) -> Result<Box<dyn erased_serde::Deserializer<'a> + 'a>, ConfigError> {
    let table = toml::de::DeTable::parse(text).map_err(|error| {
        let line = malformed::line_of_syntax(text, &error);
        let message = malformed::syntax_message(text, line, &error);
        ConfigError::Malformed { path: path.to_owned(), line, message }
    })?;
    // The deserializer receives only the parsed table. If it received the text as well, its errors would quote the text.
    let toml = toml::Deserializer::from(table);
    let tracked = serde_path_to_error::Deserializer::new(toml, keys);
    Ok(Box::new(<dyn erased_serde::Deserializer>::erase(tracked)))
}

/// The error for a text that cannot be parsed at `key` as a configuration of the kind `kind`. If the text is a configuration
/// of another kind, the message names the other kind.
fn malformed(
    text: &str,
    path: &Path,
    kind: Option<Kind>,
    key: &str,
    error: &erased_serde::Error,
) -> ConfigError {
    // The first line contains the reason. The other lines only repeat the keys.
    let error = error.to_string();
    let original = error.lines().next().unwrap_or_default();
    let (line, message) = match Kind::recognise(text).filter(|other| kind != Some(*other)) {
        Some(other) => {
            let (noun, option) = (other.noun(), other.option());
            (None, format!("this is the configuration of a {noun}; give it with {option}"))
        }
        None => (malformed::line(text, key, original), malformed::message(key, original)),
    };
    ConfigError::Malformed { path: path.to_owned(), line, message }
}

/// Converts a value to the text of a TOML file. The function is not generic, so the serializer is compiled only once.
///
/// # Errors
/// If the value has a form that TOML cannot represent.
pub fn to_toml(value: &dyn erased_serde::Serialize) -> Result<String, toml::ser::Error> {
    toml::to_string(value)
}
