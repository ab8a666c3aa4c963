//! What the service says of itself: the words of the API and of the commands.

use std::collections::BTreeMap;
use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shared::recording::schema::Provenance;
use shared::recording::{DiskTiming, Flagged, RunMark, TimingSummary};
use shared::time::{MonoNs, UtcNs};

use super::recordings::verdict::Verdict;
pub use crate::problem::Level;
use crate::problem::Problem;
use crate::record::RunSummary;
use crate::run::About;

/// What the service is doing, as far as it is on disk.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Status {
    /// What it is doing.
    #[serde(default)]
    pub state: ServiceState,
    /// Why nothing can be recorded, in a fault; why the run ends, when closing; else `problems` in one line.
    pub reason: Option<String>,
    /// The highest severity of `problems`.
    #[serde(default)]
    pub severity: Level,
    /// What is wrong with bus, encoders and disk.
    #[serde(default)]
    pub problems: Vec<Problem>,
    /// Counts since the service began.
    #[serde(default)]
    pub totals: Totals,
    /// The run that goes on.
    pub run: Option<RunStatus>,
    /// The run before.
    pub last: Option<LastRun>,
    /// Runs that are over since the service began.
    #[serde(default)]
    pub runs_over: u64,
    /// The homing that goes on, or the last one.
    pub homing: Option<HomingStatus>,
    /// Name and version of the program.
    #[serde(default)]
    pub version: String,
    /// Network interface, or `simulated`.
    pub bus: String,
    /// The encoder counts are made up by a program.
    #[serde(default)]
    pub simulated: bool,
    /// Devices in operation, in bus order.
    pub devices: Vec<String>,
    /// The latest sample of each encoder.
    pub encoders: Vec<EncoderStatus>,
    /// Ports that have counted errors since the run began, or since the bus came up: of cables, plugs and contacts.
    #[serde(default)]
    pub bad_cables: Vec<Problem>,
    /// Age of that sample \[ms\]; none before the first.
    pub sample_age_ms: Option<i64>,
    /// When that sample was fetched, 0 before the first.
    #[serde(default)]
    pub sampled: MonoNs,
    /// Number of the counters' origin in it: it grows when a terminal that lost power counts anew.
    #[serde(default)]
    pub origin: u32,
    /// Space above the floor \[MB\]; 0 at the floor.
    pub disk_usable_mb: Option<u64>,
    /// How other machines reach the service, with the fingerprint of its certificate; none where they do not.
    #[serde(default)]
    pub remote: Option<String>,
}

/// What the service is doing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ServiceState {
    /// Nothing can be recorded; `reason` has why.
    #[default]
    Fault,
    /// A run can begin.
    Waiting,
    /// The encoders are being homed.
    Homing,
    /// A run waits for its file.
    Opening,
    /// A run is being recorded, but nothing of its last seconds is on disk.
    Sampling,
    /// A run is being recorded and reaches the disk.
    Writing,
    /// The file of a run is being finished.
    Closing,
}

/// Counts since the service began.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Totals {
    /// Bus cycles of all kinds.
    pub cycles: u64,
    /// Cycles among them in which every encoder was valid.
    pub cycles_valid: u64,
    /// Cycles among them that missed their deadline.
    pub cycles_late: u64,
    /// Cycles of runs that were lost between bus and file.
    pub cycles_lost: u64,
    /// How often each problem began, by its code.
    pub problems: BTreeMap<String, u64>,
}

/// The state in one or two words, for people.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Headline {
    /// What the commands print and the page shows.
    pub word: String,
    /// How grave it is.
    pub level: Level,
}

impl Status {
    /// The state in the words that page and commands share. It follows what is on disk: a run whose cycles do not reach
    /// the disk is no recording.
    pub fn headline(&self) -> Headline {
        let (word, level) = match self.state {
            ServiceState::Waiting if self.severity > Level::Good => ("CHECK", self.severity),
            ServiceState::Waiting => ("READY", Level::Good),
            ServiceState::Homing => ("HOMING", Level::Good),
            ServiceState::Opening => ("STARTING", Level::Good),
            ServiceState::Sampling => ("NOT ON DISK YET", Level::Check),
            ServiceState::Writing => ("RECORDING", Level::Good),
            ServiceState::Closing => ("STOPPING", Level::Good),
            ServiceState::Fault => ("NOT READY", Level::Bad),
        };
        Headline { word: word.into(), level: level.max(self.severity) }
    }
}

/// The run that goes on.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunStatus {
    /// Its name.
    pub name: String,
    /// When it began \[ns since 1970\]. Exceeds a JavaScript number: see `started_ms`.
    pub started: UtcNs,
    /// When it began \[ms since 1970\].
    #[serde(default)]
    pub started_ms: i64,
    /// How long it is to last \[s\]; none: until stopped.
    #[serde(default)]
    pub duration_s: Option<f64>,
    /// Its markers, the latest 50.
    #[serde(default)]
    pub marks: Vec<RunMark>,
    /// The cycles that are not valid, by joint and reason.
    #[serde(default)]
    pub flagged: Vec<Flagged>,
    /// Where it is written; empty until its file is there.
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
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
    /// Its grade in the list of runs; none until it is read from the file.
    #[serde(default)]
    pub verdict: Option<Verdict>,
    /// The command that calibrates with it and the robot's log; absent without valid cycles.
    #[serde(default)]
    pub next: Option<String>,
    /// How well the loop kept its time.
    #[serde(default)]
    pub timing: Option<TimingSummary>,
    /// Whether it is simulated, or a replay.
    #[serde(flatten)]
    pub provenance: Provenance,
}

impl LastRun {
    /// Of a run with a file.
    pub fn of(name: String, summary: RunSummary) -> Self {
        let RunSummary { path, cycles, cycles_valid, cycles_lost, cause, provenance, timing } = summary;
        let file = path.display().to_string();
        let next = (cycles_valid > 0).then(|| next_command(&name, &file));
        let (file, error, verdict) = (Some(file), None, None);
        Self {
            name,
            file,
            cycles,
            cycles_valid,
            cycles_lost,
            cause,
            error,
            verdict,
            next,
            timing,
            provenance,
        }
    }
}

/// How the marker begins that states why a run began although a line of the check stops it.
pub const IN_SPITE_OF: &str = "begun in spite of";

/// The command that follows a run.
pub fn next_command(name: &str, file: &str) -> String {
    let quoted = |text: &str| {
        let is_plain = |c: char| c.is_alphanumeric() || "/._-+".contains(c);
        if text.chars().all(is_plain) {
            text.to_owned()
        } else {
            format!("'{}'", text.replace('\'', r"'\''"))
        }
    };
    let (file, log) = (quoted(file), quoted(&format!("{name}.csv")));
    let out = quoted(name);
    format!(
        "identify calibrate --recording {file} --robot-log {log} --robot ROBOT.toml --bar ball_bar.toml --out {out}"
    )
}

/// How far a homing is.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct HomingStatus {
    /// What was asked and found so far, for people.
    pub lines: Vec<String>,
    /// Joint that is to be turned now.
    pub joint: Option<u8>,
    /// How far it was turned; positive where the counts of its encoder rise \[deg\].
    pub turned_deg: Option<f64>,
    /// It has ended.
    pub is_over: bool,
    /// Why no marks were kept, and what to do.
    pub error: Option<String>,
}

impl fmt::Display for HomingStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.error, self.joint) {
            (Some(error), _) => write!(f, "not homed: {error}"),
            (None, _) if self.is_over => write!(f, "homed: {}", self.lines.last().map_or("", String::as_str)),
            (None, Some(joint)) => write!(f, "homing: joint {joint} is to be turned"),
            (None, None) => write!(f, "homing: no joint is to be turned now"),
        }
    }
}

/// One encoder, now.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EncoderStatus {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Counter.
    pub count: u32,
    /// Count at the last reference mark that its terminal latched.
    #[serde(default)]
    pub latch: u32,
    /// Status word of its terminal.
    pub status: u16,
    /// Fresh and without error.
    pub valid: bool,
    /// No sample has been for several cycles.
    #[serde(default)]
    pub silent: bool,
    /// Share of the cycles of the last second in which it was; none before the first.
    #[serde(default)]
    pub valid_share: Option<f64>,
}

/// What is asked for with `start`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StartRequest {
    /// Name of the run and of its file. Characters that a file's name cannot have become `-`; without a name the service
    /// makes one of date, robot, bar and a number.
    pub name: Option<String>,
    /// Who records.
    pub operator: String,
    /// Which robot.
    pub robot: String,
    /// Which bar and ball pair.
    pub bar: String,
    /// What the robot carries beside the bar.
    pub payload: String,
    /// Free text.
    pub note: String,
    /// How long \[s\]; without it until stopped.
    pub duration_s: Option<f64>,
    /// Why it begins in spite of a line of the check that stops it; goes into the file.
    pub reason: Option<String>,
}

impl StartRequest {
    /// What it says of the run.
    pub fn about(&self) -> About {
        let Self { operator, robot, bar, payload, note, .. } = self.clone();
        About { operator, robot, bar, payload, note }
    }
}

/// What is asked for with `stop`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StopRequest {
    /// Why, for the file.
    pub cause: Option<String>,
}

/// What is asked for with `home`: nothing in particular.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HomeRequest {}

/// What is asked for with `mark`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MarkRequest {
    /// Text of the marker; without one the service numbers it.
    #[serde(default)]
    pub text: Option<String>,
    /// How long ago it happened: who writes a text takes a while \[ms\].
    #[serde(default)]
    pub ago_ms: u32,
}

/// What is asked for with `note`: another note for a finished recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NoteRequest {
    /// Its name.
    pub name: String,
    /// The note that it has from now on; empty for none.
    pub note: String,
}

/// Body of `delete` (moves a finished recording into the bin) and of `restore` (moves one out of it).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DeleteRequest {
    /// Its name.
    pub name: String,
}

/// Body of `bin/empty`, without content.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EmptyBinRequest {}

/// Body of `name`: for which input a name is wanted.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NameRequest {
    /// Name as typed; empty for an automatic name.
    pub name: String,
    /// Which robot, for an automatic name.
    pub robot: String,
    /// Which bar, for an automatic name.
    pub bar: String,
}

/// How a run would be called.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct NameReply {
    /// Its name; empty where what was typed gives none.
    pub name: String,
    /// Why no run can begin under this name, and what to do.
    pub problem: Option<String>,
}

/// Body of `pair`, without content.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PairRequest {}

/// Links that let a phone in without typing the token.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PairReply {
    /// One for each address of this machine, all with the same code, which works once.
    pub links: Vec<PairingLink>,
    /// How long the code is valid \[s\].
    pub valid_s: u64,
    /// SHA-256 of the certificate that the phone is shown.
    pub fingerprint: String,
}

/// A link with a code in the place of the token.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PairingLink {
    /// The address without the code, for people.
    pub address: String,
    /// The link with its code.
    pub url: String,
    /// The link as a QR code, SVG.
    pub svg: String,
}

/// What became of a request, in one word.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Granted {
    /// Nothing was there to stop.
    #[default]
    Idle,
    /// A run, or the homing, begins.
    Begun,
    /// The run was begun before.
    Running,
    /// The run has ended.
    Stopped,
    /// The encoders were being homed already, or the homing has been stopped.
    Homing,
    /// The marker is in the run.
    Marked,
    /// The note is saved.
    Noted,
    /// The recording is in the bin.
    Deleted,
    /// The recording is out of the bin.
    Restored,
    /// The bin is empty.
    Emptied,
}

/// What became of a request.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Reply {
    /// Outcome for programs.
    pub answer: Granted,
    /// The run that it is about.
    pub run: Option<String>,
    /// The service has no real bus: what it records is made up by a program.
    #[serde(default)]
    pub simulated: bool,
    /// The run that has ended.
    pub last: Option<LastRun>,
    /// What its file is worth.
    #[serde(default)]
    pub verdict: Option<Verdict>,
    /// How the homing ended.
    #[serde(default)]
    pub homing: Option<HomingStatus>,
    /// Text of the marker that was put into the run.
    #[serde(default)]
    pub mark: Option<String>,
    /// Number of recordings that were removed with the bin.
    #[serde(default)]
    pub removed: Option<u64>,
}

/// Why a request was not granted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Refusal {
    /// What is wrong and what to do.
    pub error: String,
    /// The same as values, where it is a state of bus, disk or service.
    #[serde(default)]
    pub problems: Vec<Problem>,
}

impl Refusal {
    /// Of a request that is wrong itself.
    pub fn new(error: impl Into<String>) -> Self {
        Self { error: error.into(), problems: Vec::new() }
    }
}

impl From<Problem> for Refusal {
    fn from(problem: Problem) -> Self {
        Self { error: problem.to_string(), problems: vec![problem] }
    }
}

/// One line of the preflight check.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CheckLine {
    /// What was looked at.
    pub subject: String,
    /// What was found.
    pub finding: String,
    /// What to do; none if all is well.
    pub remedy: Option<String>,
    /// No run begins before that is done, unless somebody gives a reason.
    #[serde(default)]
    pub stops: bool,
    /// Finding and remedy as values; empty if all is well.
    #[serde(default)]
    pub problems: Vec<Problem>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_command_survives_a_shell() {
        let command = next_command("Prüfling-1", "/data/cell 3/it's/Prüfling-1.mcap");
        assert!(command.contains(r"--recording '/data/cell 3/it'\''s/Prüfling-1.mcap' "), "{command}");
        assert!(
            command.contains("--robot-log Prüfling-1.csv ") && command.ends_with("--out Prüfling-1"),
            "{command}"
        );
    }
}
