//! Finds the configuration. Sources are, in this order, the command line, the working directory, the machine (/etc), and the
//! defaults built into the program.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::de::DeserializeOwned;
use shared::config::{
    self, BallBarConfig, ConfigError, DaemonConfig, HomingConfig, PLACES, Source, Validate,
};

use crate::homing::MarksFile;

/// Default state directory of an installed package.
const STATE: &str = "/var/lib/ballbard";
const DAEMON: &str = "daemon";
const BALL_BAR: &str = "ball_bar";

#[derive(Debug, Clone, Args)]
pub struct ConfigurationFiles {
    /// Directory with daemon.toml and ball_bar.toml; default: `config` in the current directory, else /etc/ballbard,
    /// else the built-in configuration
    #[arg(long, help_heading = "Input", value_name = "DIR")]
    config: Option<PathBuf>,
}

impl ConfigurationFiles {
    /// `daemon.toml`.
    pub fn daemon(&self) -> Result<DaemonConfig, ConfigError> {
        self.load(DAEMON)
    }

    /// `ball_bar.toml`.
    pub fn ball_bar(&self) -> Result<BallBarConfig, ConfigError> {
        self.load(BALL_BAR)
    }

    /// The file of reference marks, in the state directory. If it does not exist, a file from an earlier
    /// version of the program is read. That file is next to `ball_bar.toml`, or in the directory of the
    /// recordings if there is no `ball_bar.toml`.
    pub fn marks_file(&self, state: &StateDirectory, daemon: &DaemonConfig) -> MarksFile {
        let beside = self.find(BALL_BAR).and_then(|file| file.parent().map(Path::to_owned));
        let older = beside.unwrap_or_else(|| daemon.directory.clone()).join(HomingConfig::FILE_NAME);
        MarksFile::new(state.directory(), Some(older))
    }

    /// Text for messages: where the configuration of the daemon comes from.
    pub fn origin(&self) -> String {
        match self.find(DAEMON) {
            Some(file) => file.display().to_string(),
            None => format!(
                "the built-in configuration, because there is no daemon.toml in {}",
                PLACES.join(" or ")
            ),
        }
    }

    /// Path of a configuration file; `None` for the built-in configuration.
    fn find(&self, name: &str) -> Option<PathBuf> {
        match self.source(name) {
            Some(Source::File(file)) => Some(file),
            _ => None,
        }
    }

    fn source(&self, name: &str) -> Option<Source> {
        match &self.config {
            // Return the path even if the file is missing, so that a directory without the file is reported as an error.
            Some(directory) => Some(Source::File(directory.join(name).with_extension("toml"))),
            None => Source::named(name),
        }
    }

    fn load<T: DeserializeOwned + Validate>(&self, name: &str) -> Result<T, ConfigError> {
        let source = self.source(name).unwrap_or_else(|| Source::File(name.into()));
        config::parse(&source.text()?, source.path())
    }
}

/// Directory of the program's state.
#[derive(Debug, Clone, Args)]
pub struct StateDirectory {
    /// Directory for reference marks, token and certificate; default: $STATE_DIRECTORY (set by systemd), else
    /// /var/lib/ballbard if it exists, else `ballbard` in $XDG_STATE_HOME or ~/.local/state
    #[arg(long = "state", help_heading = "Input", value_name = "DIR")]
    directory: Option<PathBuf>,
}

impl StateDirectory {
    /// Whether the directory was given on the command line.
    pub fn is_given(&self) -> bool {
        self.directory.is_some()
    }

    /// The directory from the command line, or the default.
    pub fn directory(&self) -> PathBuf {
        let variable = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let of_user = || {
            let local = || Some(std::env::home_dir()?.join(".local/state"));
            Some(variable("XDG_STATE_HOME").or_else(local)?.join("ballbard"))
        };
        let installed = Some(PathBuf::from(STATE)).filter(|path| path.is_dir());
        let chosen = self.directory.clone().or_else(|| variable("STATE_DIRECTORY")).or(installed);
        let directory = chosen.or_else(of_user).unwrap_or_else(|| STATE.into());
        // Make the path absolute, because it is shown to processes with another working directory.
        std::path::absolute(&directory).unwrap_or(directory)
    }
}
