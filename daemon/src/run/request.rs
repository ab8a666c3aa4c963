//! What is to be recorded, and from where.

use std::path::PathBuf;
use std::time::Duration;

use shared::config::HomingConfig;
use shared::recording::run_name;

use crate::segment::faults::FaultWindow;

/// Which bus to record from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum BusChoice {
    /// The simulated segment in this process, moving by itself.
    #[default]
    Simulated,
    /// The simulated segment, its encoders following a recording.
    Replay(PathBuf),
    /// A network interface.
    Interface(String),
}

/// What people say of a run, for its file.
#[derive(Debug, Clone, Default, PartialEq, Eq, clap::Args)]
pub struct About {
    /// Who records
    #[arg(long, default_value = "")]
    pub operator: String,
    /// Which robot
    #[arg(long, default_value = "")]
    pub robot: String,
    /// Which bar and ball pair
    #[arg(long, default_value = "")]
    pub bar: String,
    /// What the robot carries beside the bar
    #[arg(long, default_value = "")]
    pub payload: String,
    /// Free text
    #[arg(long, default_value = "")]
    pub note: String,
}

/// What to record, and from where.
#[derive(Debug, Clone, Default)]
pub struct RunRequest {
    /// Name of the run, and of its file.
    pub name: String,
    /// What people say of it.
    pub about: About,
    /// How long; none: until stopped, or to the end of a replay.
    pub duration: Option<Duration>,
    /// Which bus.
    pub bus: BusChoice,
    /// What goes wrong on the simulated bus, on purpose.
    pub faults: Vec<FaultWindow>,
    /// A bus that does not come up is tried again until it does.
    pub wait: bool,
    /// Reference marks of the encoders, used where the terminals still show them; not for a replay, whose recording
    /// has its own.
    pub homing: Option<HomingConfig>,
    /// Virtual time, as fast as the machine allows. Simulated bus only.
    pub fast: bool,
}

/// One run of a bus that is in operation.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunDetails {
    /// Name of the run, and of its file.
    pub name: String,
    /// What people say of it.
    pub about: About,
    /// How long; none: until stopped.
    pub duration: Option<Duration>,
    /// Reference marks of the encoders, used where the terminals still show them.
    pub homing: Option<HomingConfig>,
}

impl About {
    /// Refuses texts that would play with the terminals of those who read them.
    pub fn check(&self) -> Result<(), &'static str> {
        let Self { operator, robot, bar, payload, note } = self;
        [operator, robot, bar, payload, note].into_iter().try_for_each(|text| check_text(text))
    }
}

/// A run's name where nobody chose one: the date and time of this place.
pub fn name_by_time() -> String {
    chrono::Local::now().format("%Y-%m-%d_%H-%M-%S").to_string()
}

/// The name of a run from what was typed: see [`run_name`].
pub fn typed_name(typed: &str) -> Result<String, String> {
    run_name(typed)
        .ok_or_else(|| format!("run name {typed:?} has no letter or digit; type another, or leave it out"))
}

/// Longest name, note and so on \[bytes\].
const TEXT_BYTES_MAX: usize = 4000;

/// Text that people give with a run: no longer than anybody reads, and nothing but text.
pub fn check_text(text: &str) -> Result<(), &'static str> {
    if text.len() > TEXT_BYTES_MAX {
        return Err("a text is longer than 4000 bytes; shorten it");
    }
    if text.chars().any(|c| c.is_control() && c != '\n' && c != '\t') {
        return Err("a text has control characters; leave them out");
    }
    Ok(())
}

impl RunRequest {
    pub(super) fn details(&self) -> RunDetails {
        RunDetails {
            name: self.name.clone(),
            about: self.about.clone(),
            duration: self.duration,
            homing: self.homing.clone().filter(|_| !matches!(self.bus, BusChoice::Replay(_))),
        }
    }
}
