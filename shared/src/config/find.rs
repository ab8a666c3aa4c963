//! Finds a configuration, given by the path of a file or by a name. A name is searched first in the usual directories
//! ([`PLACES`]), then among the configurations that are built into the programs.

use std::borrow::Cow;
use std::path::{Component, Path, PathBuf};

use super::ConfigError;

/// Directories that are searched for a name, in this order. The first is relative to the working directory, the second
/// applies to the whole machine.
pub const PLACES: [&str; 2] = ["config", "/etc/ballbard"];
/// Subdirectory of each of [`PLACES`] that contains the robots.
const ROBOTS: &str = "robots";
const ENDING: &str = "toml";

/// The kinds of configuration that can be found by name. For each kind, at least one configuration
/// is built into the programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `robots/*.toml`.
    Robot,
    /// `ball_bar.toml`.
    BallBar,
    /// `daemon.toml`.
    Daemon,
    /// `smoke.toml`.
    Smoke,
    /// `measured_pose.toml`.
    TrackerMapping,
    /// `measured_length.toml`.
    WireMapping,
    /// `contact.toml`.
    ContactMapping,
    /// `touch.toml`.
    TouchMapping,
}

/// For each kind, in the order of [`Kind`]: its name in messages, the option that accepts it, and the keys that identify it.
/// A text is a configuration of a kind if it contains all keys of that kind. No other kind has all of these keys.
const KINDS: [(Kind, &str, &str, &[&str]); 8] = [
    (Kind::Robot, "robot", "--robot", &["links", "log"]),
    (Kind::BallBar, "ball-bar", "--bar", &["links", "encoders"]),
    (Kind::Daemon, "daemon", "`ballbard run --config`, which takes its directory", &["rate_hz"]),
    (Kind::Smoke, "smoke test", "`ballbard smoke --checks`", &["cycles", "terminal_revisions"]),
    (Kind::TrackerMapping, "tracker's table", "`identify calibrate tracker --mapping`", &["position"]),
    (Kind::WireMapping, "wire's table", "`identify calibrate wire --mapping`", &["length"]),
    (
        Kind::ContactMapping,
        "table of seated balls",
        "`identify calibrate contact --mapping`",
        &["socket", "joints"],
    ),
    (
        Kind::TouchMapping,
        "table of touched faces",
        "`identify calibrate touch --mapping`",
        &["face", "joints"],
    ),
];

/// Kind, name and text of each built-in configuration.
const BUILT_IN: [(Kind, &str, &str); 11] = [
    (Kind::Robot, "irb120_3", include_str!("../../../config/robots/irb120_3.toml")),
    (Kind::Robot, "irb2400_16", include_str!("../../../config/robots/irb2400_16.toml")),
    (Kind::Robot, "nj220_2_7", include_str!("../../../config/robots/nj220_2_7.toml")),
    (Kind::Robot, "ur10", include_str!("../../../config/robots/ur10.toml")),
    (Kind::BallBar, "ball_bar", include_str!("../../../config/ball_bar.toml")),
    (Kind::Daemon, "daemon", include_str!("../../../config/daemon.toml")),
    (Kind::Smoke, "smoke", include_str!("../../../config/smoke.toml")),
    (Kind::TrackerMapping, "measured_pose", include_str!("../../../config/measured_pose.toml")),
    (Kind::WireMapping, "measured_length", include_str!("../../../config/measured_length.toml")),
    (Kind::ContactMapping, "contact", include_str!("../../../config/contact.toml")),
    (Kind::TouchMapping, "touch", include_str!("../../../config/touch.toml")),
];

/// Where a configuration was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// A file with this path.
    File(PathBuf),
    /// A configuration that is built into the program: its name and its text.
    BuiltIn(&'static str, &'static str),
}

impl Source {
    /// Searches a configuration in this order:
    /// - the file at the given path
    /// - the configuration with the given name ([`Source::named`])
    ///
    /// If neither exists, the given path is returned, and reading it fails later. A file name with the ending `.toml` never
    /// selects a built-in configuration, because the lengths of the wrong bar would scale all results.
    pub fn find(given: &Path) -> Self {
        let is_file_name = given.extension().is_some_and(|ending| ending == ENDING);
        let is_meant = |found: &Self| !is_file_name || matches!(found, Self::File(_));
        let by_name = || Self::named(name(given)?).filter(is_meant);
        let found = if given.is_file() { None } else { by_name() };
        found.unwrap_or_else(|| Self::File(given.to_owned()))
    }

    /// The first configuration with this name. The name has no ending. [`PLACES`] are
    /// searched before the built-in configurations.
    pub fn named(name: &str) -> Option<Self> {
        let file = format!("{name}.{ENDING}");
        let below = |place| [Path::new(place).join(&file), Path::new(place).join(ROBOTS).join(&file)];
        let in_directory = PLACES.into_iter().flat_map(below).find(|file| file.is_file()).map(Self::File);
        let built_in = || {
            let (_, name, text) = BUILT_IN.into_iter().find(|(_, other, _)| *other == name)?;
            Some(Self::BuiltIn(name, text))
        };
        in_directory.or_else(built_in)
    }

    /// Resolves a path that is written in a file of `directory`. The path is relative to `directory`. If no file exists
    /// there, but [`Source::find`] finds a configuration with this name elsewhere, that configuration is used.
    pub fn beside(directory: &Path, given: &Path) -> PathBuf {
        let beside = directory.join(given);
        let is_elsewhere = !beside.exists() && Self::find(given) != Self::File(given.to_owned());
        if is_elsewhere { given.to_owned() } else { beside }
    }

    /// All robots that can be found by name: first those in [`PLACES`], in that order, then the built-in ones. If several
    /// robots have the same name, only the first is returned.
    pub fn robots() -> Vec<(String, Self)> {
        let mut robots: Vec<(String, Self)> = Vec::new();
        for place in PLACES {
            let files = std::fs::read_dir(Path::new(place).join(ROBOTS)).into_iter().flatten().flatten();
            let mut files: Vec<PathBuf> = files.map(|entry| entry.path()).collect();
            files.retain(|file| file.extension().is_some_and(|ending| ending == ENDING));
            files.sort();
            let name = |file: &Path| Some(file.file_stem()?.to_str()?.to_owned());
            robots.extend(files.into_iter().filter_map(|file| Some((name(&file)?, Self::File(file)))));
        }
        let built_in = BUILT_IN.iter().filter(|(kind, ..)| *kind == Kind::Robot);
        robots.extend(built_in.map(|&(_, name, text)| (name.to_owned(), Self::BuiltIn(name, text))));
        let mut seen = std::collections::HashSet::new();
        robots.retain(|(name, _)| seen.insert(name.clone()));
        robots
    }

    /// Path of the file or name of the built-in configuration, for messages.
    pub fn path(&self) -> &Path {
        match self {
            Self::File(path) => path,
            Self::BuiltIn(name, _) => Path::new(name),
        }
    }

    /// The text of the configuration.
    ///
    /// # Errors
    /// [`ConfigError::Unreadable`] if the file cannot be read, and [`ConfigError::Malformed`] if it is not UTF-8.
    pub fn text(&self) -> Result<Cow<'static, str>, ConfigError> {
        let path = match self {
            Self::BuiltIn(_, text) => return Ok(Cow::Borrowed(text)),
            Self::File(path) => path,
        };
        let bytes = std::fs::read(path)
            .map_err(|source| ConfigError::Unreadable { path: path.to_owned(), source })?;
        String::from_utf8(bytes)
            .map(Cow::Owned)
            .map_err(|error| not_utf8(path, error.as_bytes(), error.utf8_error().valid_up_to()))
    }
}

fn not_utf8(path: &Path, bytes: &[u8], valid_to: usize) -> ConfigError {
    let before = bytes.get(..valid_to).unwrap_or_default();
    let message = if bytes.contains(&0) {
        "this is a binary file, not TOML; give a configuration file".to_owned()
    } else {
        let byte = bytes.get(valid_to).copied().unwrap_or_default();
        format!(
            "byte 0x{byte:02X} is not UTF-8, in which TOML is written; save it as UTF-8, or\n\
             iconv -f latin1 -t utf-8 {} > NEW",
            path.display()
        )
    };
    let line = Some(before.iter().filter(|byte| **byte == b'\n').count() + 1);
    ConfigError::Malformed { path: path.to_owned(), line: line.filter(|_| !bytes.contains(&0)), message }
}

/// The name of a configuration, without the ending `.toml`. `None` if `given` has several components, because then it can
/// only be a path.
fn name(given: &Path) -> Option<&str> {
    let is_name = matches!(given.components().collect::<Vec<_>>()[..], [Component::Normal(_)]);
    let name = given.to_str().filter(|_| is_name)?;
    Some(name.strip_suffix(".toml").unwrap_or(name))
}

impl Kind {
    /// Names of the built-in configurations of this kind.
    pub fn names(self) -> Vec<&'static str> {
        BUILT_IN.iter().filter(|(kind, ..)| *kind == self).map(|&(_, name, _)| name).collect()
    }

    /// The text of a built-in configuration. The directories [`PLACES`] are not searched. The text is empty
    /// if the name is unknown.
    pub fn built_in(self, name: &str) -> &'static str {
        BUILT_IN.iter().find(|(kind, other, _)| *kind == self && *other == name).map_or("", |(.., text)| text)
    }

    /// Determines the kind of a configuration from the keys in its text.
    pub(super) fn recognise(text: &str) -> Option<Self> {
        let table: toml::Table = text.parse().ok()?;
        let has_all = |keys: &[&str]| keys.iter().all(|key| table.contains_key(*key));
        KINDS.into_iter().find(|(.., keys)| has_all(keys)).map(|(kind, ..)| kind)
    }

    /// Name of the kind in messages.
    pub(super) fn noun(self) -> &'static str {
        let (_, noun, ..) = KINDS[self as usize];
        noun
    }

    /// The option that accepts a configuration of this kind, for messages.
    pub(super) fn option(self) -> &'static str {
        let (_, _, option, _) = KINDS[self as usize];
        option
    }
}
