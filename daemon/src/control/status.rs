//! What the service says of itself: the words of the API and of the commands.

use serde::{Deserialize, Serialize};
use shared::recording::{DiskTiming, TimingSummary};
use shared::time::UtcNs;

/// What the service is doing, as far as it is on disk.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// `fault`, `waiting`, `homing`, `opening`, `sampling`, `writing` or `closing`.
    pub state: String,
    /// Why nothing can be recorded, in a fault; why the run ends, when closing; else what is wrong with the bus or an
    /// encoder.
    pub reason: Option<String>,
    /// The run that goes on.
    pub run: Option<RunStatus>,
    /// The run before.
    pub last: Option<LastRun>,
    /// Runs that are over since the service began.
    #[serde(default)]
    pub runs_over: u64,
    /// The homing that goes on, or the last one.
    pub homing: Option<HomingStatus>,
    /// Network interface, or `simulated`.
    pub bus: String,
    /// Devices in operation, in bus order.
    pub devices: Vec<String>,
    /// The latest sample of each encoder.
    pub encoders: Vec<EncoderStatus>,
    /// Cables and plugs that have shown errors since the run began, or since the bus came up.
    #[serde(default)]
    pub bad_cables: Vec<String>,
    /// Age of that sample \[ms\]; none before the first.
    pub sample_age_ms: Option<i64>,
    /// Space above the floor \[MB\]; 0 at the floor.
    pub disk_usable_mb: Option<u64>,
}

/// The run that goes on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunStatus {
    /// Its name.
    pub name: String,
    /// When it began, ns since 1970.
    pub started: UtcNs,
    /// Where it is written.
    pub file: String,
    /// Cycles on disk: synchronised, so that a power cut leaves them.
    pub cycles: u64,
    /// Cycles among them in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that are written, so that a kill of the program leaves them.
    pub cycles_written: u64,
    /// Cycles that were due.
    pub cycles_taken: u64,
    /// Cycles that were lost between bus and file, up to now.
    pub cycles_lost: u64,
    /// Length of the file when it was synchronised \[bytes\].
    pub bytes: u64,
    /// All that was written so long ago is on disk \[ms\]; none before the first time.
    pub sync_age_ms: Option<i64>,
    /// What is taken and not synchronised: the cost of a power cut \[s\].
    pub unsynced_s: f64,
    /// What is taken and not written: the cost of a kill \[s\].
    pub backlog_s: f64,
    /// Cycles are lost from this backlog on \[s\].
    pub backlog_limit_s: f64,
    /// How long the disk kept the recorder waiting.
    pub disk: DiskTiming,
    /// How well the loop kept its time so far.
    #[serde(default)]
    pub timing: Option<TimingSummary>,
}

/// A run that is over.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastRun {
    /// Its name.
    pub name: String,
    /// Its finished file; none where there is none.
    pub file: Option<String>,
    /// Cycles in it.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that were lost between bus and file.
    pub cycles_lost: u64,
    /// Why it ended.
    pub cause: String,
    /// Why its file could not be finished in the ordinary way; the cycles are then those that could be saved.
    #[serde(default)]
    pub error: Option<String>,
    /// How well the loop kept its time.
    #[serde(default)]
    pub timing: Option<TimingSummary>,
}

/// How far a homing is.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct HomingStatus {
    /// What was asked and found so far, for people.
    pub lines: Vec<String>,
    /// Joint that is to be turned now.
    pub joint: Option<u8>,
    /// How far it was turned; positive where the counts of its encoder rise \[deg\].
    pub turned_deg: Option<f64>,
    /// It has ended.
    pub is_over: bool,
    /// Why it found nothing, and what to do.
    pub error: Option<String>,
}

/// One encoder, now.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EncoderStatus {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Counter.
    pub count: u32,
    /// Status word of its terminal.
    pub status: u16,
    /// Fresh and without error.
    pub valid: bool,
}

/// What is asked for with `start`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StartRequest {
    /// Name of the run and of its file; without one the service makes one of date and time.
    pub name: Option<String>,
    /// Who records.
    pub operator: String,
    /// Which robot.
    pub robot: String,
    /// Free text.
    pub note: String,
    /// How long \[s\]; without it until stopped.
    pub duration_s: Option<f64>,
}

/// What is asked for with `stop`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StopRequest {
    /// Why, for the file.
    pub cause: Option<String>,
}

/// What is asked for with `home`: nothing in particular.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HomeRequest {}

/// What is asked for with `mark`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkRequest {
    /// Text of the marker.
    pub text: String,
}

/// What became of a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reply {
    /// In one word: `begun`, `running`, `stopped`, `idle`, `homing` or `marked`.
    pub answer: String,
    /// The run that it is about.
    pub run: Option<String>,
    /// The run that has ended.
    pub last: Option<LastRun>,
}

/// Why a request was not granted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// What is wrong and what to do.
    pub error: String,
}

/// One line of the preflight check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CheckLine {
    /// What was looked at.
    pub subject: String,
    /// What was found.
    pub finding: String,
    /// What to do; none if all is well.
    pub remedy: Option<String>,
}
