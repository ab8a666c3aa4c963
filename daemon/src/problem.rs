//! Problems of bus, disk, encoders, cables and host, as values.
//!
//! A [`Fact`] identifies a detected problem by a code and contains the measured values. The code that
//! detects the problem creates the fact. A [`Problem`] adds severity, text and remedy. Only this module
//! defines them, so file, log, status, check, page, metrics and API show the same texts. Codes do not
//! change between versions; `docs/src/reference/warnings.md` explains each code.

use std::fmt;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shared::recording::schema::{PortCounts, flags};

use crate::devices::el5021::StatusWord;

/// How serious a state is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// There is no problem.
    #[default]
    Good,
    /// Recording is possible, but a person should check it.
    Check,
    /// Recording is impossible or at risk.
    Bad,
}

/// A detected problem with its severity, text and remedy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Problem {
    /// Serialised as `code` and `fields`.
    #[serde(flatten)]
    #[schemars(with = "Described")]
    pub fact: Box<Fact>,
    /// How serious it is.
    pub severity: Level,
    /// Bar joints that have no valid samples because of the problem.
    #[serde(default)]
    pub joints: Vec<u8>,
    /// Description of the problem, including its values.
    pub text: String,
    /// What the person at the machine should do; may be empty.
    pub remedy: String,
}

/// Declares [`Fact`] and [`CODES`] from one table. Each entry of the table contains name, code, severity, fields, text and
/// remedy. Text and remedy may use the fields. The macro also generates the function [`code`](Fact::code) and the private
/// functions `severity` and `texts`.
macro_rules! facts {
    ($($(#[doc = $doc:literal])+ $name:ident = $code:literal, $severity:ident
        $({ $($field:ident: $type:ty),+ $(,)? })? => $text:expr, $remedy:expr;)+) => {
        /// A detected problem. Serialised as its `code` and, if it has any, its `fields`; units are suffixes.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "code", content = "fields")]
        #[allow(missing_docs, reason = "fields are explained by their names and units")]
        pub enum Fact {
            $($(#[doc = $doc])+ #[serde(rename = $code)] $name { $($($field: $type),+)? },)+
        }

        impl Fact {
            /// Stable name for programs and documents.
            pub fn code(&self) -> &'static str {
                match self {
                    $(Self::$name { .. } => $code,)+
                }
            }

            fn severity(&self) -> Level {
                match self {
                    $(Self::$name { .. } => Level::$severity,)+
                }
            }

            #[allow(unused_variables, reason = "not every text has every field")]
            fn texts(&self) -> (String, String) {
                match self {
                    $(Self::$name { $($($field),+)? } => (String::from($text), String::from($remedy)),)+
                }
            }
        }

        /// The codes of all facts, for the API and the manual.
        pub const CODES: &[&str] = &[$($code),+];

        /// [`Fact`] in the document of the API.
        #[derive(JsonSchema)]
        #[allow(dead_code, reason = "describes the JSON of a fact")]
        struct Described {
            /// Name of the problem for programs, which does not change between versions. The manual explains each code.
            #[schemars(extend("enum" = CODES))]
            code: String,
            /// Values and locations of the problem; the end of each name is the unit.
            fields: serde_json::Map<String, serde_json::Value>,
        }
    };
}

const REPLACE_TERMINAL: &str =
    "power the terminals off and on; if the problem persists, replace the named terminal";
const CHECK_DISK: &str = "check the cable, the power or the network connection of the disk";
const REDUCE_LOAD: &str = "run `ballbard tune`; end programs that load the processor";

facts! {
    /// The bus has not been in operation yet.
    BusStarting = "bus_starting", Bad =>
        "the bus is being brought into operation",
        "wait a few seconds";
    /// No frame returns to this PC.
    BusNoAnswer = "bus_no_answer", Bad { bus: String } =>
        format!("no EtherCAT device answers on {bus}"),
        "check that the coupler has power, that its upper (IN) socket is cabled to this interface, and that the \
         interface is up";
    /// The terminals from this position on do not answer. The coupler has position 0.
    BusDeviceMissing = "bus_device_missing", Bad { position: usize, expected: Vec<String>, found: Vec<String> } =>
        format!("{} and all behind it do not answer: {}", device(*position), expected_and_found(expected, found)),
        format!(
            "check the power of {} (bus position {position}), and press it and the terminals behind it firmly onto the \
             device before; if it was removed, correct the list of encoders in ball_bar.toml",
            device(*position)
        );
    /// There are more devices than configured.
    BusDeviceUnexpected = "bus_device_unexpected", Bad { position: usize, expected: Vec<String>, found: Vec<String> } =>
        format!("{} is not configured: {}", device(*position), expected_and_found(expected, found)),
        "add its encoder and those of the terminals behind it to ball_bar.toml, or remove these terminals";
    /// A device is of another type than configured.
    BusDeviceWrong = "bus_device_wrong", Bad { position: usize, expected: Vec<String>, found: Vec<String> } =>
        format!("{} is another device than configured: {}", device(*position), expected_and_found(expected, found)),
        "correct the order of the terminals or the list of encoders in ball_bar.toml";
    /// A device has lost its address or configuration, because it was without power.
    BusDeviceRestarted = "bus_device_restarted", Bad =>
        "a device has lost its address or configuration: it was without power",
        "check the supply of the coupler and the contacts between the terminals";
    /// A device has left the state OP.
    BusNotOperational = "bus_not_operational", Bad { position: Option<usize>, al_status_code: Option<u16> } =>
        not_operational(*position, *al_status_code),
        first_check(*position);
    /// A device does not enter a requested state.
    BusStateRefused = "bus_state_refused", Bad { position: usize, state: String, wanted: String, al_status: String } =>
        format!("{} stays in {state} instead of {wanted}: AL status {al_status}", device(*position)),
        REPLACE_TERMINAL;
    /// A terminal refuses a setting.
    BusSettingRefused = "bus_setting_refused", Bad { position: usize, doing: String, error: String } =>
        format!("{} refused a command while {doing}: {error}", device(*position)),
        REPLACE_TERMINAL;
    /// A terminal did not accept the configured number of interpolation bits.
    BusInterpolation = "bus_interpolation", Bad { position: usize, wanted: u8, found: u32 } =>
        format!("{} interpolates with {found} bits instead of the {wanted} that were set", device(*position)),
        "power the terminals off and on, or give a number of bits in ball_bar.toml that its firmware offers";
    /// The process data of a terminal have an unexpected length.
    BusProcessData = "bus_process_data", Bad { position: usize, inputs_bytes: usize, outputs_bytes: usize } =>
        format!(
            "{} has {inputs_bytes} bytes of inputs and {outputs_bytes} of outputs instead of 10 and 6",
            device(*position)
        ),
        "restore its default PDO assignment";
    /// The reference clock does not advance.
    BusClockStopped = "bus_clock_stopped", Bad { time_ns: u64 } =>
        format!("the distributed clock stands still (time {time_ns} ns)"),
        "the first device after this PC must be an EK1100 with distributed clocks, or set `distributed_clocks = false` \
         in daemon.toml and accept samples up to one cycle old";
    /// The clock of a terminal does not follow the reference clock.
    BusClockUnsettled = "bus_clock_unsettled", Bad { position: usize, difference_ns: i64 } =>
        format!(
            "the clock of {} differs from the bus time by {difference_ns} ns; 1000 ns are allowed",
            device(*position)
        ),
        REPLACE_TERMINAL;
    /// The reference clock has jumped.
    BusClockJumped = "bus_clock_jumped", Check { by_ns: Option<i64> } =>
        match by_ns {
            Some(by_ns) => format!("the reference clock jumped by {:.3} ms", *by_ns as f64 * 1e-6),
            None => "the reference clock jumped".into(),
        },
        "nothing to do: sample times follow it; replace the coupler if this happens again";
    /// Several replies in a row have a wrong working counter.
    BusBadReplies = "bus_bad_replies", Bad { position: Option<usize>, flags: Vec<String> } =>
        format!("several replies in a row have errors ({})", flags.join(", ")),
        first_check(*position);
    /// The EtherCAT stack failed.
    BusStackFailed = "bus_stack_failed", Bad { doing: String, error: String } =>
        format!("EtherCAT error while {doing}: {error}"),
        "check cables, contacts and the terminals' power";
    /// The program was stopped while it brought the bus into operation.
    BusInterrupted = "bus_interrupted", Bad =>
        "the program was stopped while it brought the bus up",
        "start again";
    /// The network interface cannot be used.
    InterfaceUnusable = "interface_unusable", Bad { error: String } =>
        error,
        "correct --bus or the interface";
    /// The cycle thread is blocked or starved.
    CycleStalled = "cycle_stalled", Bad { age_s: i64 } =>
        format!("no bus cycle for {age_s} s: the cycle thread is blocked or starved"),
        REDUCE_LOAD;
    /// A thread of the service has ended.
    ThreadEnded = "thread_ended", Bad { thread: String } =>
        format!("the {thread} thread has ended"),
        "report this with the log, which shows why";
    /// The bus is in OP again. This fact reports the end of a fault.
    BusRestored = "bus_restored", Good { attempts: u32 } =>
        match attempts {
            1 => "bus in operation again".into(),
            _ => format!("bus in operation again, after {attempts} attempts"),
        },
        "";
    /// A port has counted errors. Port 0 leads to the preceding device.
    LinkErrors = "link_errors", Check {
        position: usize, port: usize, receive_errors: u32, invalid_frames: u32, lost_links: u32,
    } =>
        format!(
            "{}: {} has counted {receive_errors} receive errors, {invalid_frames} invalid frames and {lost_links} lost \
             links",
            link(*position, *port).0,
            device(*position)
        ),
        link(*position, *port).1;
    /// No cycle contained a sample in the last second.
    NoSamples = "no_samples", Bad =>
        "no sample in the last second",
        "bring the bus into operation first";
    /// Encoders have too few valid samples. `joints` lists them. `status` and `valid_share` belong to the first of these
    /// encoders. `valid_share` is its fraction of valid samples in the last second.
    EncoderInvalid = "encoder_invalid", Bad { joints: Vec<u8>, status: Option<u16>, valid_share: f64 } =>
        invalid_encoders(joints, *status, *valid_share),
        encoder_remedy(*status, *valid_share);
    /// The counters may have restarted, so that counts before and after the restart have different origins.
    CountsRestarted = "counts_restarted", Check { joint: Option<u8>, because: String } =>
        format!("counts may have a new origin: {because}"),
        "home again if runs use reference marks; a calibration estimates the new offsets";
    /// Cycles were started after their deadline.
    CyclesLate = "cycles_late", Check =>
        "cycles were started after their deadline",
        "run `ballbard tune`";
    /// Cycles were lost between bus and file.
    CyclesLost = "cycles_lost", Bad { cycles: u64 } =>
        format!("{cycles} cycles are lost: the disk did not accept them in time"),
        "find the programs that keep the disk busy, or record to another one";
    /// The directory of the recordings cannot be written.
    DiskUnwritable = "disk_unwritable", Bad { directory: PathBuf } =>
        format!(
            "{} cannot be written: it is not a directory, is read-only, or belongs to another user",
            directory.display()
        ),
        "correct this directory, or choose another one with --out or `directory` in daemon.toml";
    /// The free space of the disk is below the limit `disk_floor_mb`.
    DiskFull = "disk_full", Bad { directory: PathBuf, floor_mb: u64 } =>
        format!("less than {floor_mb} MB are free on the disk of {} (disk floor)", directory.display()),
        "move recordings, or delete some and empty the bin, or lower `disk_floor_mb` in daemon.toml";
    /// A call to the disk returned an error.
    DiskError = "disk_error", Bad { place: String, error: String } =>
        format!("{place}: {error}"),
        "check free space and permissions, and the state of the disk";
    /// A call to the disk has not returned.
    DiskSilent = "disk_silent", Bad { directory: Option<PathBuf>, silent_s: Option<f64> } =>
        format!(
            "the disk{} {}",
            directory.as_ref().map_or(String::new(), |place| format!(" of {}", place.display())),
            silent_s.map_or("does not answer".into(), |s| format!("has not answered for {s:.1} s"))
        ),
        CHECK_DISK;
    /// Files of earlier runs are being recovered.
    DiskRecovering = "disk_recovering", Check { since_s: Option<f64> } =>
        match since_s {
            Some(since_s) => {
                format!("files of earlier runs are being recovered, for {since_s:.1} s now")
            }
            None => "files of earlier runs are being recovered".into(),
        },
        "wait; if it takes minutes check the disk";
    /// A run waits until its file has been created.
    FilePending = "file_pending", Bad { since_s: f64, step: String } =>
        format!("the run has no file yet: the disk has been {step} for {since_s:.1} s"),
        CHECK_DISK;
    /// The file of the run no longer exists under its path.
    FileLost = "file_lost", Bad { error: String } =>
        format!("{error}; the run's cycles are being moved to another place"),
        "wait for the new place, then check the directory";
    /// The run continues in another file.
    FileMoved = "file_moved", Check { file: PathBuf, error: String } =>
        format!("the run continues in {}, because: {error}", file.display()),
        "`ballbard stop` names the file; repair the disk before the next run";
    /// The file of the run could not be finished.
    FileBroken = "file_broken", Bad { error: String } =>
        error,
        "check the disk, then run `ballbard recover` on the file";
    /// Cycles wait to be written to the file.
    DiskBacklog = "disk_backlog", Bad { backlog_s: f64, limit_s: f64 } =>
        format!(
            "the disk accepts nothing: {backlog_s:.1} s of cycles wait to be written; above {limit_s:.0} s cycles are lost"
        ),
        "find the programs that keep the disk busy";
    /// Cycles wait to be synchronised with the disk.
    DiskSlow = "disk_slow", Check { unsynced_s: f64 } =>
        format!("the disk is slow: a power failure now would cost the last {unsynced_s:.1} s of the run"),
        "find the programs that keep the disk busy";
    /// The disk has little space left.
    DiskSpaceLow = "disk_space_low", Check { left_h: f64 } =>
        format!("the disk has room for {left_h:.1} hours"),
        "move recordings elsewhere, or delete some and empty the bin, before the run needs the space";
    /// Files were left behind by a crash.
    FilesLeft = "files_left", Check { files: Vec<PathBuf> } =>
        format!(
            "files that a crash left unfinished: {}",
            files.iter().map(|file| file.display().to_string()).collect::<Vec<_>>().join(", ")
        ),
        "run `ballbard recover` on each";
    /// The run cannot begin.
    RunRefused = "run_refused", Bad { error: String } =>
        error,
        "";
    /// The encoders are being homed.
    HomingActive = "homing_active", Check =>
        "the encoders are being homed",
        "wait until the homing has ended, or stop it with `ballbard stop`";
    /// The queue of requests to the control is full.
    ServiceBusy = "service_busy", Bad =>
        "too many requests wait for the service",
        "try again in a second";
    /// The service is ending.
    ServiceEnding = "service_ending", Bad =>
        "the service is ending",
        "start it again: `ballbard run`";
    /// `homing.toml` cannot be read.
    MarksUnreadable = "marks_unreadable", Bad { error: String } =>
        error,
        "correct the file, or home again";
    /// Reference marks are no longer valid.
    MarksStale = "marks_stale", Check { joints: Vec<u8> } =>
        format!("reference marks of joint {} are no longer valid", numbers(joints)),
        "run `ballbard home`, or remove homing.toml if runs need no marks";
    /// Reference marks could not be saved.
    MarksUnwritable = "marks_unwritable", Check { error: String } =>
        format!("{error}, so reference marks could not be saved"),
        "permit this user to write to that directory, or choose another one with --state";
    /// Priority, core or locked memory were not granted.
    RealtimeDenied = "realtime_denied", Check { report: String } =>
        report,
        "type the commands that `ballbard tune` prints; without them cycles are late when the machine is busy";
    /// The host's clock is not synchronised.
    ClockUnsynchronised = "clock_unsynchronised", Check =>
        "the host's clock is not synchronised: UTC in the file is only as accurate as this clock",
        "start chrony or systemd-timesyncd; ignore this without a network: the calibration estimates clock differences";
    /// The kernel does not report whether the clock is synchronised.
    ClockUnknown = "clock_unknown", Check { error: String } =>
        format!("the kernel does not report whether the clock is synchronised: {error}"),
        "allow the system call clock_adjtime in the sandbox of this process";
    /// The host's UTC was set while a run was recorded.
    ClockStepped = "clock_stepped", Check { by_ns: i64 } =>
        format!("the host's clock was set by {:.3} ms; sample times of this run do not follow it", *by_ns as f64 * 1e-6),
        "find the program that set the clock";
    /// Lines of the log were lost.
    LogLinesLost = "log_lines_lost", Check { lines: u64 } =>
        format!("{lines} lines of the log were lost: standard error did not accept them"),
        "check its destination: a full disk, a closed terminal, a pipe that is not read; recording continues";
    /// A joint has been turned so far that its cable winds up.
    JointWound = "joint_wound", Check { joint: u8, turned_deg: f64, from_mark: bool } =>
        format!(
            "joint {joint} is turned by {turned_deg:.0} degrees from {}",
            if *from_mark { "its reference mark" } else { "its first position" }
        ),
        "unwind its cable before it is torn";
    /// A joint is close to a singular pose.
    JointSingular = "joint_singular", Check { joint: u8, distance_deg: f64 } =>
        format!("joint {joint} is {distance_deg:.1} degrees from a singular pose of the bar"),
        "change the path: the rod must not align with the first or the last axis of the bar";
    /// A joint turns faster than its terminal can interpolate at full resolution.
    JointFast = "joint_fast", Check { joint: u8, speed_deg_per_s: f64, limit_deg_per_s: f64 } =>
        format!(
            "joint {joint} turns at {:.0} degrees/s; above {limit_deg_per_s:.0} its terminal does not resolve the finest steps",
            speed_deg_per_s.abs()
        ),
        "move the robot more slowly";
    /// A joint has not turned since the run began.
    JointStill = "joint_still", Check { joint: u8, range_deg: f64 } =>
        format!("joint {joint} has turned by only {range_deg:.1} degrees since the run began"),
        "check whether its coupling is loose, or change the path so that it turns the joint";
    /// Angles count from zero again, because the counters have restarted.
    AnglesRestarted = "angles_restarted", Check { since_s: f64 } =>
        format!("since {} angles and coverage count from zero again", clock_time(*since_s)),
        "nothing to do: the counters restarted, as after an outage of the bus, and the calibration accounts for it";
}

impl Fact {
    /// Returns the most severe problem that explains these flags of cycles. `silent` lists the joints without valid samples.
    /// `position` is the bus position of the terminal of the first of these joints. `position` is `None` if it is unknown,
    /// or if no joint at all has valid samples.
    pub fn of_flags(bits: u32, bus: &str, silent: Vec<u8>, position: Option<usize>) -> Self {
        let has = |bit| bits & bit != 0;
        if has(flags::NO_REPLY) {
            Self::BusNoAnswer { bus: bus.to_owned() }
        } else if has(flags::NOT_OPERATIONAL) {
            Self::BusNotOperational { position, al_status_code: None }
        } else if has(flags::WORKING_COUNTER) {
            Self::BusBadReplies { position, flags: flag_names(bits) }
        } else if has(flags::BUS_DOWN) {
            Self::BusStarting {}
        } else if has(flags::NO_DC) && !has(flags::TERMINAL_ERROR) {
            Self::BusClockJumped { by_ns: None }
        } else if has(flags::DEADLINE_MISSED) {
            Self::CyclesLate {}
        } else {
            Self::EncoderInvalid { joints: silent, status: None, valid_share: 0.0 }
        }
    }

    /// Returns code and location, which together distinguish problems that exist at the same time. The location is a number
    /// that is derived from the joint or the port. Measured values are not part of the key, so the key of a problem stays
    /// the same while its values change.
    pub fn key(&self) -> (&'static str, usize) {
        let place = match self {
            // A device has at most four ports.
            Self::LinkErrors { position, port, .. } => 4 * position + port,
            Self::EncoderInvalid { joints, .. } => joints.first().copied().map_or(0, usize::from),
            Self::JointWound { joint, .. }
            | Self::JointSingular { joint, .. }
            | Self::JointFast { joint, .. }
            | Self::JointStill { joint, .. } => usize::from(*joint),
            _ => 0,
        };
        (self.code(), place)
    }
}

impl From<PortCounts> for Fact {
    fn from(counts: PortCounts) -> Self {
        let PortCounts { position, port, invalid_frames, receive_errors, lost_links } = counts;
        let (position, port) = (position.into(), port.into());
        Self::LinkErrors { position, port, receive_errors, invalid_frames, lost_links }
    }
}

impl Problem {
    /// Marks the problem as the reason why these joints have no valid samples. `all` is true if no joint
    /// of the bar has valid samples.
    pub fn with_joints(self, joints: Vec<u8>, all: bool) -> Self {
        let subject = if all { "any encoder".into() } else { format!("joint {}", numbers(&joints)) };
        Self {
            text: format!("no samples from {subject}: {}", self.text),
            severity: Level::Bad,
            joints,
            ..self
        }
    }

    /// Overrides the default severity of the problem.
    pub fn with_severity(self, severity: Level) -> Self {
        Self { severity, ..self }
    }

    /// Stable name for programs and documents.
    pub fn code(&self) -> &'static str {
        self.fact.code()
    }

    /// Joins several problems into one line: first the texts, then the remedies. Repeated texts are written only once.
    pub fn line(problems: &[Self]) -> String {
        let mut parts: Vec<&str> = Vec::new();
        let texts = problems.iter().map(|problem| &problem.text);
        for part in texts.chain(problems.iter().map(|problem| &problem.remedy)) {
            if !part.is_empty() && !parts.contains(&part.as_str()) {
                parts.push(part);
            }
        }
        parts.join("; ")
    }
}

impl From<Fact> for Problem {
    fn from(fact: Fact) -> Self {
        let ((text, remedy), severity) = (fact.texts(), fact.severity());
        Self { fact: Box::new(fact), severity, joints: Vec::new(), text, remedy }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&Self::line(std::slice::from_ref(self)))
    }
}

/// Names of the flags that are set in `bits`.
pub fn flag_names(bits: u32) -> Vec<String> {
    let set = flags::NAMES.iter().filter(|(bit, _)| bits & bit != 0);
    set.map(|(_, name)| (*name).to_owned()).collect()
}

/// Formats a time since the start of a run, such as 1:02:03 or 0:07.
pub fn clock_time(seconds: f64) -> String {
    let whole = seconds.max(0.0) as u64;
    let (hours, minutes, seconds) = (whole / 3600, whole / 60 % 60, whole % 60);
    if hours > 0 { format!("{hours}:{minutes:02}:{seconds:02}") } else { format!("{minutes}:{seconds:02}") }
}

/// Name of a device. The coupler is at position 0, so the terminal next to it is terminal 1.
fn device(position: usize) -> String {
    if position == 0 { "the coupler".into() } else { format!("terminal {position}") }
}

fn not_operational(position: Option<usize>, al_status_code: Option<u16>) -> String {
    let who = position.map_or("a device".into(), device);
    match al_status_code {
        Some(code) => format!("{who} fell to SAFE-OP, AL status code {code:#06x}"),
        None => format!("{who} is not in OP"),
    }
}

fn invalid_encoders(joints: &[u8], status: Option<u16>, valid_share: f64) -> String {
    let why = if is_only_unsynchronised(status) { ": cycles not synchronous with the terminal" } else { "" };
    let word = status.map_or(String::new(), |status| format!(" (status {status:#06x}{why})"));
    let who = format!("joint {}{word}", numbers(joints));
    if valid_share > 0.0 {
        return format!("{who} was valid for {:.0} % of the last second", 100.0 * valid_share);
    }
    format!("no valid sample from {who}")
}

/// Whether the status word reports a synchronisation error, which late cycles cause, but no error of the encoder signal.
fn is_only_unsynchronised(status: Option<u16>) -> bool {
    let is_only =
        |status: StatusWord| status.sync_error() && !status.amplitude_error() && !status.frequency_error();
    status.map(StatusWord).is_some_and(is_only)
}

fn encoder_remedy(status: Option<u16>, valid_share: f64) -> &'static str {
    // If the terminal reports no error but has no valid sample, the encoder is not the cause. Either the terminal is not in
    // operation, or the bus was just restored. After that, no encoder counts as valid until all encoders deliver samples.
    let is_without_error = status.map(StatusWord).is_some_and(|status| !status.has_error());
    if is_only_unsynchronised(status) {
        REDUCE_LOAD
    } else if is_without_error && valid_share <= 0.0 {
        "its terminal reports no error: correct the bus and the other encoders first"
    } else {
        "check the encoder's cable and plug, and its signal amplitude"
    }
}

/// Remedy that names what to check first: the device at `position`, or the coupler if the position is unknown.
fn first_check(position: Option<usize>) -> String {
    let place = match position {
        Some(position) => format!("{} and the contact before it", device(position)),
        None => "the coupler's cable and power, then one terminal after the other".into(),
    };
    format!("first check {place}; the bus returns to operation once all devices answer")
}

fn expected_and_found(expected: &[String], found: &[String]) -> String {
    let list = |names: &[String]| if names.is_empty() { "nothing".into() } else { names.join(", ") };
    format!("expected [{}], found [{}]", list(expected), list(found))
}

/// Describes a bad link at a port. Returns the text and the remedy. Port 0 leads to the preceding device and port 1 to the
/// next terminal. Port 2 of the coupler leads to its OUT socket. The links of the coupler to this PC and at its OUT socket are
/// cables. All other links are contacts between adjacent devices. An EK1100 has no port 3, and an EL5021 has neither port 2
/// nor port 3. A port that does not exist counts no errors, so it is never reported.
fn link(position: usize, port: usize) -> (String, String) {
    let cable = "push the plug in, or replace the cable";
    match (position, port) {
        (0, 0) => ("bad cable or plug between this PC and the coupler".into(), cable.into()),
        (0, 2..) => ("bad cable or plug at the OUT socket of the coupler".into(), cable.into()),
        _ => {
            let before = if port == 0 { position.saturating_sub(1) } else { position };
            let (first, second) = (device(before), device(before + 1));
            (
                format!("bad contact between {first} and {second}"),
                format!("press {second} firmly onto {first}, and replace it if the errors continue"),
            )
        }
    }
}

/// The numbers of these joints as a text.
pub(crate) fn numbers(joints: &[u8]) -> String {
    joints.iter().map(u8::to_string).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_problem_is_code_fields_severity_and_words_in_json_and_comes_back_from_it() {
        let fact =
            Fact::LinkErrors { position: 3, port: 0, receive_errors: 7, invalid_frames: 0, lost_links: 1 };
        let problem = Problem::from(fact);
        let json = serde_json::to_value(&problem).unwrap();
        assert_eq!((&json["code"], &json["fields"]["receive_errors"]), (&"link_errors".into(), &7.into()));
        assert_eq!(json["severity"], "check");
        assert_eq!(serde_json::from_value::<Problem>(json).unwrap(), problem);
        let plain = Problem::from(Fact::CyclesLate {});
        assert_eq!(serde_json::from_value::<Problem>(serde_json::to_value(&plain).unwrap()).unwrap(), plain);
    }

    #[test]
    fn links_are_cables_only_where_there_are_cables() {
        assert!(link(0, 0).0.contains("cable or plug between this PC and the coupler"));
        assert_eq!(link(1, 0).0, "bad contact between the coupler and terminal 1");
        assert_eq!(link(0, 1).0, link(1, 0).0);
        assert!(link(0, 2).0.contains("cable or plug at the OUT socket"));
        assert_eq!(link(3, 0).0, "bad contact between terminal 2 and terminal 3");
        assert_eq!(link(2, 1).0, link(3, 0).0);
    }

    #[test]
    fn the_first_terminal_without_samples_is_checked_first() {
        let of = |silent: Vec<u8>, position, all| {
            let fact = Fact::of_flags(flags::WORKING_COUNTER, "eth1", silent.clone(), position);
            Problem::from(fact).with_joints(silent, all).to_string()
        };
        let some = of(vec![2, 5], Some(3), false);
        assert!(
            some.contains("from joint 2, 5:") && some.contains("check terminal 3 and the contact"),
            "{some}"
        );
        let none = of(vec![1, 2], None, true);
        assert!(none.contains("from any encoder:") && none.contains("check the coupler"), "{none}");
    }

    #[test]
    fn several_problems_state_each_remedy_once() {
        let silent = |joint| {
            Problem::from(Fact::EncoderInvalid { joints: vec![joint], status: Some(0x10), valid_share: 0.0 })
        };
        assert_eq!(
            Problem::line(&[silent(2), silent(4)]),
            "no valid sample from joint 2 (status 0x0010); no valid sample from joint 4 (status 0x0010); check the \
             encoder's cable and plug, and its signal amplitude"
        );
    }

    #[test]
    fn late_cycles_are_no_fault_of_an_encoder() {
        let text = |status| {
            Problem::from(Fact::EncoderInvalid { joints: vec![1], status: Some(status), valid_share: 0.0 })
                .to_string()
        };
        let late = text(0xa000);
        assert!(
            late.contains("(status 0xa000: cycles not synchronous") && late.contains("ballbard tune"),
            "{late}"
        );
        // With a low signal, the cable is the cause.
        assert!(text(0x2010).contains("check the encoder's cable"), "{}", text(0x2010));
    }

    #[test]
    fn an_encoder_without_an_error_is_not_the_cause() {
        let text = |status, valid_share| {
            Problem::from(Fact::EncoderInvalid { joints: vec![1], status: Some(status), valid_share })
                .to_string()
        };
        assert!(text(0x8000, 0.0).contains("correct the bus"), "{}", text(0x8000, 0.0));
        // A loose contact: this sample has no error, but other samples of the last second have errors.
        assert!(text(0x8000, 0.5).contains("check the encoder's cable"), "{}", text(0x8000, 0.5));
    }

    #[test]
    fn every_code_has_a_row_in_the_manual() {
        let manual = include_str!("../../docs/src/reference/warnings.md");
        let missing: Vec<_> = CODES.iter().filter(|code| !manual.contains(&format!("`{code}`"))).collect();
        assert!(missing.is_empty(), "docs/src/reference/warnings.md has no row for {missing:?}");
    }
}
