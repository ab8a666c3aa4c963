//! Description of a run, its bus and its setup.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig, HomingConfig};
use shared::recording::run_name;

use crate::record::Storage;
use crate::scheduler::Scheduler;
use crate::segment::faults::FaultWindow;

/// The bus to record from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum BusChoice {
    /// The simulated segment in this process, with generated motion.
    #[default]
    Simulated,
    /// The simulated segment in this process, with the motion of a recording.
    Replay(PathBuf),
    /// The network interface of this name.
    Interface(String),
}

/// Texts that describe a run, for its file.
#[derive(Debug, Clone, Default, PartialEq, Eq, clap::Args)]
#[command(next_help_heading = "Recording")]
pub struct About {
    /// Name of the person who records
    #[arg(long, default_value = "", hide_default_value = true)]
    pub operator: String,
    /// Name or serial number of the robot
    #[arg(long, default_value = "", hide_default_value = true)]
    pub robot: String,
    /// Name or serial number of the bar
    #[arg(long, default_value = "", hide_default_value = true)]
    pub bar: String,
    /// Payload of the robot in addition to the bar
    #[arg(long, default_value = "", hide_default_value = true)]
    pub payload: String,
    /// Free text about the run
    #[arg(long, default_value = "", hide_default_value = true)]
    pub note: String,
}

/// Scheduler, storage and configuration that all runs on a bus share.
#[derive(Clone)]
pub struct Setup {
    /// Provides the clock, and runs steppers and futures.
    pub scheduler: Arc<dyn Scheduler>,
    /// Directories of the recordings.
    pub storage: Storage,
    /// `daemon.toml`.
    pub daemon: DaemonConfig,
    /// `ball_bar.toml`.
    pub bar: BallBarConfig,
}

/// A run and the bus to record it from.
#[derive(Debug, Clone, Default)]
pub struct RunRequest {
    /// Description of the run.
    pub run: RunDetails,
    /// The bus to record from.
    pub bus: BusChoice,
    /// Faults to inject into the simulated bus.
    pub faults: Vec<FaultWindow>,
    /// Repeat the attempt to bring the bus into operation until it succeeds.
    pub wait: bool,
    /// Use virtual time, as fast as the machine allows. Only for the simulated bus.
    pub fast: bool,
}

/// A run on a bus that is in operation.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunDetails {
    /// Name of the run, and of its file.
    pub name: String,
    /// Texts that describe the run.
    pub about: About,
    /// Duration; `None` if the run lasts until it is stopped, or to the end of a replay.
    pub duration: Option<Duration>,
    /// Reference marks of the encoders. A mark is used only if the latch of the encoder's terminal still agrees with the
    /// mark. `None` for a replay, because the recording contains its own marks.
    pub homing: Option<HomingConfig>,
}

impl About {
    /// Refuses texts that are too long, and texts with control characters, which could manipulate the terminal of a reader.
    pub fn check(&self) -> Result<(), &'static str> {
        let Self { operator, robot, bar, payload, note } = self;
        [operator, robot, bar, payload, note].into_iter().try_for_each(|text| check_text(text))
    }
}

/// Default name of a run: local date and time.
pub fn name_by_time() -> String {
    chrono::Local::now().format("%Y-%m-%d_%H-%M-%S").to_string()
}

/// Converts typed text into the name of a run; see [`run_name`].
pub fn typed_name(typed: &str) -> Result<String, String> {
    run_name(typed)
        .ok_or_else(|| format!("run name {typed:?} has no letter or digit; choose another, or omit it"))
}

/// Longest text that describes a run \[bytes\].
const TEXT_BYTES_MAX: usize = 4000;

/// Refuses a text of a run that is too long or contains control characters.
pub fn check_text(text: &str) -> Result<(), &'static str> {
    if text.len() > TEXT_BYTES_MAX {
        return Err("the text is longer than 4000 bytes; shorten it");
    }
    if text.chars().any(|c| c.is_control() && c != '\n' && c != '\t') {
        return Err("the text contains control characters; remove them");
    }
    Ok(())
}
