//! Status, requests and replies of the API.

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

/// State of the service. The figures of a run count only what is safe on disk, unless the description of a field states otherwise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Status {
    /// What the service is doing.
    #[serde(default)]
    pub state: ServiceState,
    /// In the state `fault`: why nothing can be recorded. In `closing`: why the run ends. Otherwise `problems` in one line.
    pub reason: Option<String>,
    /// The highest severity of `problems`.
    #[serde(default)]
    pub severity: Level,
    /// Current problems of bus, encoders and disk.
    #[serde(default)]
    pub problems: Vec<Problem>,
    /// Counts since the service began.
    #[serde(default)]
    pub totals: Totals,
    /// The current run, if there is one.
    pub run: Option<RunStatus>,
    /// The run that ended last; absent if no run has ended since the service began.
    pub last: Option<LastRun>,
    /// Number of runs that have ended since the service began.
    #[serde(default)]
    pub runs_over: u64,
    /// The current homing; if there is none, the previous homing.
    pub homing: Option<HomingStatus>,
    /// Name and version of the program.
    #[serde(default)]
    pub version: String,
    /// Network interface of the bus, or `simulated`.
    pub bus: String,
    /// A program generates the encoder counts, without hardware.
    #[serde(default)]
    pub simulated: bool,
    /// Names of the devices in operation, in bus order.
    pub devices: Vec<String>,
    /// The latest sample of each encoder.
    pub encoders: Vec<EncoderStatus>,
    /// One problem for each port that has counted errors: a fault of a cable, plug or contact. Counting begins with the run;
    /// without a run, when the bus is brought up.
    #[serde(default)]
    pub bad_cables: Vec<Problem>,
    /// Age of the latest sample \[ms\]; absent before the first sample.
    pub sample_age_ms: Option<i64>,
    /// Time at which the latest sample was received; 0 before the first sample.
    #[serde(default)]
    pub sampled: MonoNs,
    /// Number of the counters' origin in the latest sample. It increases when the counters restart, because a terminal lost
    /// power. It is 0 again when a run begins.
    #[serde(default)]
    pub origin: u32,
    /// Free disk space above the reserve `disk_floor_mb` \[MB\].
    pub disk_usable_mb: Option<u64>,
    /// Address of the service for other machines, with the fingerprint of its certificate, as
    /// text; absent without remote access.
    #[serde(default)]
    pub remote: Option<String>,
}

/// What the service is doing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ServiceState {
    /// Nothing can be recorded; `reason` has the cause.
    #[default]
    Fault,
    /// A run can begin.
    Waiting,
    /// The encoders are being homed.
    Homing,
    /// A run has been requested, and its file is being created.
    Opening,
    /// A run is being recorded, but its latest seconds are not safe on disk.
    Sampling,
    /// A run is being recorded, and its cycles reach the disk in time.
    Writing,
    /// The file of a run is being finished.
    Closing,
}

/// Counts since the service began.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Totals {
    /// Number of bus cycles, within and between runs.
    pub cycles: u64,
    /// Number of these cycles in which every encoder was valid.
    pub cycles_valid: u64,
    /// Number of these cycles that missed their deadline.
    pub cycles_late: u64,
    /// Number of cycles of runs that were lost between bus and file.
    pub cycles_lost: u64,
    /// Number of times that each problem began, by the code of the problem.
    pub problems: BTreeMap<String, u64>,
}

/// The state in one to four words, for people.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Headline {
    /// The text that commands and page show.
    pub word: String,
    /// Severity of the state.
    pub level: Level,
}

impl Status {
    /// The state as text for the page and the commands. A run whose cycles do not reach the disk is not shown as recording.
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

    /// Whether no encoder has valid samples because of the bus, which was never in operation or has a problem.
    pub fn is_without_bus(&self) -> bool {
        let has_problem = |joint: u8| self.problems.iter().any(|problem| problem.joints.contains(&joint));
        self.encoders.iter().all(|encoder| has_problem(encoder.joint))
    }
}

/// State of the current run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunStatus {
    /// Name of the run.
    pub name: String,
    /// Beginning of the run \[ns since 1970\]. JavaScript numbers cannot represent it exactly; use `started_ms` there.
    pub started: UtcNs,
    /// Beginning of the run \[ms since 1970\].
    #[serde(default)]
    pub started_ms: i64,
    /// Requested duration \[s\]; absent if the run lasts until it is stopped.
    #[serde(default)]
    pub duration_s: Option<f64>,
    /// The latest 50 markers of the run.
    #[serde(default)]
    pub marks: Vec<RunMark>,
    /// Invalid cycles, grouped by joint and reason.
    #[serde(default)]
    pub flagged: Vec<Flagged>,
    /// Path of the run's file; empty until the file is created.
    pub file: String,
    /// Number of cycles that are safe on disk, so that they survive a power failure.
    pub cycles: u64,
    /// Number of the cycles in `cycles` in which every encoder is valid.
    pub cycles_valid: u64,
    /// Number of cycles that are written to the file, so that they survive a crash of the program.
    pub cycles_written: u64,
    /// Number of cycles since the run began, including those that are not written yet.
    pub cycles_taken: u64,
    /// Number of cycles that were lost between bus and file so far.
    pub cycles_lost: u64,
    /// Length of the file at the last complete synchronisation \[bytes\].
    pub bytes: u64,
    /// Time since the last complete synchronisation of the file \[ms\]; absent before the first synchronisation.
    pub sync_age_ms: Option<i64>,
    /// Duration of the cycles that are not safe on disk; a power failure now would lose them \[s\].
    pub unsynced_s: f64,
    /// Duration of the cycles that wait to be written; a crash of the program now would lose them \[s\].
    pub backlog_s: f64,
    /// Largest value of `backlog_s` without a loss; above it cycles are lost \[s\].
    pub backlog_limit_s: f64,
    /// Longest waits of the recorder for the disk.
    pub disk: DiskTiming,
    /// Timing of the run's cycles so far; absent on virtual time.
    #[serde(default)]
    pub timing: Option<TimingSummary>,
}

/// A run that has ended.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LastRun {
    /// Name of the run.
    pub name: String,
    /// Path of the finished file; absent if there is none.
    pub file: Option<String>,
    /// Number of cycles in the file.
    pub cycles: u64,
    /// Number of these cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Number of cycles that were lost between bus and file.
    pub cycles_lost: u64,
    /// Why the run ended.
    pub cause: String,
    /// Why the file could not be finished; `cycles` then counts the cycles that were saved. Absent if the file is finished.
    #[serde(default)]
    pub error: Option<String>,
    /// Grade of the run; absent until it has been derived from the file.
    #[serde(default)]
    pub verdict: Option<Verdict>,
    /// The command that calibrates a robot from this run and the robot's log; absent without valid cycles.
    #[serde(default)]
    pub next: Option<String>,
    /// Timing of the run's cycles; absent on virtual time.
    #[serde(default)]
    pub timing: Option<TimingSummary>,
    /// Whether it is simulated, or a replay.
    #[serde(flatten)]
    pub provenance: Provenance,
}

impl LastRun {
    /// Creates the status of a run that has a finished file.
    pub fn from_summary(name: String, summary: RunSummary) -> Self {
        let RunSummary { path, cycles, cycles_valid, cycles_lost, cause, provenance, timing } = summary;
        let file = path.display().to_string();
        let next = (cycles_valid > 0).then(|| next_command(&name, &file));
        let last = Self { name, file: Some(file), next, timing, provenance, ..Self::default() };
        Self { cycles, cycles_valid, cycles_lost, cause, ..last }
    }
}

/// Prefix of a marker that contains the reason of the user. A run gets this marker if it was begun
/// although the pre-flight check found a severe problem.
pub const IN_SPITE_OF: &str = "begun in spite of";

/// Command that calibrates with the file of a run. Names with special characters are quoted for the shell.
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
    format!("identify calibrate --recording {file} --robot-log {log} --robot ROBOT --out {out}")
}

/// Progress of a homing.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct HomingStatus {
    /// Instructions and results so far, for people.
    pub lines: Vec<String>,
    /// Bar joint that the person must turn now, 1 to 5; absent if none.
    pub joint: Option<u8>,
    /// Angle by which this joint has been turned; positive if the counts of its encoder increased \[deg\].
    pub turned_deg: Option<f64>,
    /// The homing has ended.
    pub is_over: bool,
    /// Why no reference marks were saved, and what to do; absent without an error.
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

/// State of one encoder.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EncoderStatus {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Value of the counter.
    pub count: u32,
    /// Count at the last reference mark that the encoder's terminal latched.
    #[serde(default)]
    pub latch: u32,
    /// Status word of the encoder's terminal.
    pub status: u16,
    /// The latest sample is new and has no error.
    pub valid: bool,
    /// The encoder has had no valid sample for several cycles.
    #[serde(default)]
    pub silent: bool,
    /// Fraction of the cycles of the last second that are valid, 0 to 1; absent before the first second.
    #[serde(default)]
    pub valid_share: Option<f64>,
}

/// Body of `start`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StartRequest {
    /// Name of the run and of its file. Characters other than letters, digits and `-_.+` become `-`. If absent, the service
    /// makes a name from date, robot, bar and a number.
    pub name: Option<String>,
    /// Name of the person who records.
    pub operator: String,
    /// Name or serial number of the robot.
    pub robot: String,
    /// Name or serial number of the bar.
    pub bar: String,
    /// Payload of the robot in addition to the bar.
    pub payload: String,
    /// Free text about the run.
    pub note: String,
    /// Duration of the run \[s\]; if absent, the run lasts until it is stopped.
    pub duration_s: Option<f64>,
    /// Begins the run even if the check finds a problem that prevents it. The reason is stored in the file.
    pub reason: Option<String>,
}

impl StartRequest {
    /// The texts that describe the run.
    pub fn about(&self) -> About {
        let Self { operator, robot, bar, payload, note, .. } = self.clone();
        About { operator, robot, bar, payload, note }
    }
}

/// Body of `stop`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StopRequest {
    /// Reason of the stop, stored in the file.
    pub cause: Option<String>,
}

/// Body of `home`, without content.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HomeRequest {}

/// Body of `mark`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MarkRequest {
    /// Text of the marker. If absent, the text is `mark N`, where N counts the markers without a text.
    #[serde(default)]
    pub text: Option<String>,
    /// Time since the marked event, such as the time for typing the text \[ms\].
    #[serde(default)]
    pub ago_ms: u32,
}

/// Body of `note`, which replaces the note of a finished recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NoteRequest {
    /// Name of the recording.
    pub name: String,
    /// The new note; an empty text removes the note.
    pub note: String,
}

/// Body of `delete`, which moves a finished recording into the bin, and of `restore`, which moves a recording out of the bin.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DeleteRequest {
    /// Name of the recording.
    pub name: String,
}

/// Body of `bin/empty`, without content.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EmptyBinRequest {}

/// Body of `name`: the input from which the service derives a name.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NameRequest {
    /// Name as typed; empty to request an automatic name.
    pub name: String,
    /// Name or serial number of the robot, for an automatic name.
    pub robot: String,
    /// Name or serial number of the bar, for an automatic name.
    pub bar: String,
}

/// Name that a run would get.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct NameReply {
    /// The name; empty if no valid name can be made from the typed text.
    pub name: String,
    /// Why no run can begin under this name, and what to do; absent if a run can begin.
    pub problem: Option<String>,
}

/// Body of `pair`, without content.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PairRequest {}

/// Links that admit a phone without typing the token.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PairReply {
    /// One link for each address of this machine, all with the same single-use code.
    pub links: Vec<PairingLink>,
    /// How long the code is valid \[s\].
    pub valid_s: u64,
    /// SHA-256 fingerprint of the certificate that the service presents to the phone.
    pub fingerprint: String,
}

/// A link that contains a single-use code instead of the token.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PairingLink {
    /// The link without the code, for display.
    pub address: String,
    /// The link with its code.
    pub url: String,
    /// The link as a QR code, SVG.
    pub svg: String,
}

/// Outcome of a request, in one word.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Granted {
    /// Neither a run nor a homing was active, so nothing was stopped.
    #[default]
    Idle,
    /// A run or a homing begins.
    Begun,
    /// The requested run is already active; nothing was changed.
    Running,
    /// The run has ended.
    Stopped,
    /// Reply to `home`: a homing is already in progress. Reply to `stop`: the homing has ended.
    Homing,
    /// The marker is in the run.
    Marked,
    /// The note is saved.
    Noted,
    /// The recording is in the bin.
    Deleted,
    /// The recording has been moved out of the bin.
    Restored,
    /// The bin is empty.
    Emptied,
}

/// Outcome of a request.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Reply {
    /// Outcome in one word.
    pub answer: Granted,
    /// Name of the run or recording to which the request applied.
    pub run: Option<String>,
    /// A program generates the encoder counts of the service, without hardware.
    #[serde(default)]
    pub simulated: bool,
    /// The run that has ended.
    pub last: Option<LastRun>,
    /// Grade of the run that has ended.
    #[serde(default)]
    pub verdict: Option<Verdict>,
    /// Result of the homing that has ended.
    #[serde(default)]
    pub homing: Option<HomingStatus>,
    /// Text of the marker that was added.
    #[serde(default)]
    pub mark: Option<String>,
    /// Number of recordings that were removed from the bin.
    #[serde(default)]
    pub removed: Option<u64>,
}

/// Why a request was refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Refusal {
    /// The problem and its remedy.
    pub error: String,
    /// The problems as values, if the reason is the state of bus, disk or service; otherwise empty.
    #[serde(default)]
    pub problems: Vec<Problem>,
}

impl Refusal {
    /// Creates a refusal for an invalid request, as opposed to a problem of the machine.
    pub fn new(error: impl Into<String>) -> Self {
        Self { error: error.into(), problems: Vec::new() }
    }
}

impl From<Problem> for Refusal {
    fn from(problem: Problem) -> Self {
        Self { error: problem.to_string(), problems: vec![problem] }
    }
}

/// One line of the pre-flight check.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CheckLine {
    /// Name of the checked condition.
    pub subject: String,
    /// Result of the check.
    pub finding: String,
    /// What to do; absent if the check found no problem.
    pub remedy: Option<String>,
    /// The problem prevents a run.
    #[serde(default)]
    pub stops: bool,
    /// The run can begin despite the problem if the request to start contains a `reason`; never without bus or disk.
    #[serde(default)]
    pub reason_suffices: bool,
    /// The problems that the check found, as values; empty if there are none.
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
