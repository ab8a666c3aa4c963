//! Where the configuration comes from: what was typed, this directory, the machine, or what the program brings along.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::de::DeserializeOwned;
use shared::config::{
    self, BallBarConfig, ConfigError, DaemonConfig, HomingConfig, PLACES, Source, Validate,
};

use crate::homing::MarksFile;

/// Where a packaged service keeps what it finds out.
const STATE: &str = "/var/lib/ballbard";
const DAEMON: &str = "daemon";
const BALL_BAR: &str = "ball_bar";

#[derive(Debug, Clone, Args)]
pub struct Configuration {
    /// Directory with daemon.toml and ball_bar.toml; default: `config` in this directory, then /etc/ballbard, then what
    /// the program brings along
    #[arg(long, value_name = "DIR")]
    config: Option<PathBuf>,
}

impl Configuration {
    /// `daemon.toml`.
    pub fn daemon(&self) -> Result<DaemonConfig, ConfigError> {
        self.load(DAEMON)
    }

    /// `ball_bar.toml`.
    pub fn ball_bar(&self) -> Result<BallBarConfig, ConfigError> {
        self.load(BALL_BAR)
    }

    /// Where reference marks are kept. They used to be beside `ball_bar.toml`, or with the recordings where nobody has
    /// written one.
    pub fn marks_file(&self, state: &State, daemon: &DaemonConfig) -> MarksFile {
        let beside = self.find(BALL_BAR).and_then(|file| file.parent().map(Path::to_owned));
        let older = beside.unwrap_or_else(|| daemon.directory.clone()).join(HomingConfig::FILE_NAME);
        MarksFile::new(state.directory(), Some(older))
    }

    /// Where a file came from, for people.
    pub fn origin(&self) -> String {
        match self.find(DAEMON) {
            Some(file) => file.display().to_string(),
            None => format!(
                "what the program brings along, as there is no daemon.toml in {}",
                PLACES.join(" or ")
            ),
        }
    }

    /// None where what the program brings along is used.
    fn find(&self, name: &str) -> Option<PathBuf> {
        match self.source(name) {
            Some(Source::File(file)) => Some(file),
            _ => None,
        }
    }

    fn source(&self, name: &str) -> Option<Source> {
        match &self.config {
            // What was typed is meant, whether it is there or not.
            Some(directory) => Some(Source::File(directory.join(name).with_extension("toml"))),
            None => Source::named(name),
        }
    }

    fn load<T: DeserializeOwned + Validate>(&self, name: &str) -> Result<T, ConfigError> {
        let source = self.source(name).unwrap_or_else(|| Source::File(name.into()));
        config::parse(&source.text()?, source.path())
    }
}

/// Where the program keeps what it finds out by itself.
#[derive(Debug, Clone, Args)]
pub struct State {
    /// Directory for reference marks, token and certificate; default: $STATE_DIRECTORY as systemd sets it,
    /// /var/lib/ballbard where that is there, else `ballbard` in $XDG_STATE_HOME or ~/.local/state
    #[arg(long = "state", value_name = "DIR")]
    directory: Option<PathBuf>,
}

impl State {
    /// Somebody typed one.
    pub fn is_given(&self) -> bool {
        self.directory.is_some()
    }

    /// What was typed, or where it is by default.
    pub fn directory(&self) -> PathBuf {
        let variable = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let of_user = || {
            let local = || Some(std::env::home_dir()?.join(".local/state"));
            Some(variable("XDG_STATE_HOME").or_else(local)?.join("ballbard"))
        };
        let installed = Some(PathBuf::from(STATE)).filter(|path| path.is_dir());
        let chosen = self.directory.clone().or_else(|| variable("STATE_DIRECTORY")).or(installed);
        let directory = chosen.or_else(of_user).unwrap_or_else(|| STATE.into());
        // Whoever is told where it is may be in another directory.
        std::path::absolute(&directory).unwrap_or(directory)
    }
}
