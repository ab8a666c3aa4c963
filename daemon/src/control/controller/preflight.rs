//! The pre-flight check: the conditions for a run, each with a remedy if it is not met. Inputs are the status, the
//! controller, and what a task found on the disk. `ballbard check` and the page show the result. A line with a severe
//! problem prevents `ballbard start`.

use std::io;
use std::path::PathBuf;

use shared::config::HomingConfig;
use shared::recording::Disk;

use super::Controller;
use crate::control::recordings::runs;
use crate::control::recordings::verdict::{VALID_SHARE_BAD, VALID_SHARE_GOOD};
use crate::control::settings::Settings;
use crate::control::status::{CheckLine, EncoderStatus, Status};
use crate::log;
use crate::problem::{Fact, Level, Problem};
use crate::run::Session;

/// Largest age of the latest sample \[ms\]. An older sample does not show the present state of the encoders.
const SAMPLE_AGE_MS_MAX: i64 = 1000;

/// What was found on the disk, collected by a thread that may wait for the disk.
pub(in crate::control) struct DiskFindings {
    homing: Result<Option<HomingConfig>, String>,
    left_behind: Result<Vec<PathBuf>, io::Error>,
    /// Why the marks of a homing could not be saved.
    unsavable: Option<Problem>,
}

impl DiskFindings {
    /// Reads the disk now.
    pub fn now(settings: &Settings, disk: &dyn Disk) -> Self {
        Self {
            homing: settings.marks_file.read(disk).map_err(|error| error.to_string()),
            left_behind: runs::left_behind(disk, &settings.daemon.directories()),
            unsavable: settings.marks_file.problem(disk),
        }
    }
}

/// Computes all lines of the check. Each line is independent of the others. `found` is `None` if the
/// disk did not respond in time.
pub(in crate::control) fn check(controller: &Controller, found: Option<&DiskFindings>) -> Vec<CheckLine> {
    let status = controller.status();
    let findings = [
        (BUS, bus(controller, &status)),
        ("encoders", encoders(&status)),
        ("cables", cables(&status)),
        ("reference marks", reference_marks(controller, found)),
        ("state", state(controller, found)),
        (DISK, disk(controller)),
        ("real time", realtime(controller)),
        ("clock", clock()),
        ("left-over files", leftovers(found)),
        ("log", log()),
    ];
    findings.into_iter().map(|(subject, finding)| line(subject, finding)).collect()
}

/// Subjects of the lines without which no run can begin, whatever reason the request to start contains.
const BUS: &str = "bus";
const DISK: &str = "disk";

/// A text if the condition is met, otherwise the problems.
type CheckResult = Result<String, Vec<Problem>>;

/// Converts a result into a line. A line prevents a run if one of its problems is [`Level::Bad`].
fn line(subject: &str, finding: CheckResult) -> CheckLine {
    let problems = match finding {
        Ok(finding) => {
            return CheckLine { subject: subject.into(), finding, ..CheckLine::default() };
        }
        Err(problems) => problems,
    };
    let joined = |text_of: fn(&Problem) -> &str| {
        let mut parts: Vec<&str> = problems.iter().map(text_of).filter(|part| !part.is_empty()).collect();
        parts.dedup();
        parts.join("; ")
    };
    let stops = problems.iter().any(|problem| problem.severity == Level::Bad);
    CheckLine {
        finding: joined(|problem| &problem.text),
        remedy: Some(joined(|problem| &problem.remedy)),
        stops,
        reason_suffices: stops && ![BUS, DISK].contains(&subject),
        subject: subject.into(),
        problems,
    }
}

/// Returns the problems, or the text if there are no problems.
fn none_of(problems: impl IntoIterator<Item = Problem>, text: impl Into<String>) -> CheckResult {
    let problems: Vec<_> = problems.into_iter().collect();
    if problems.is_empty() { Ok(text.into()) } else { Err(problems) }
}

fn bus(controller: &Controller, status: &Status) -> CheckResult {
    let fault = controller.machine.bus_fault().cloned().map(|problem| problem.with_severity(Level::Bad));
    none_of(fault, format!("in operation on {}: {}", status.bus, status.devices.join(", ")))
}

fn encoders(status: &Status) -> CheckResult {
    // Without replies of the bus, the samples contain neither counts nor status words, so no encoder is named.
    if status.is_without_bus() || status.sample_age_ms.is_none_or(|age| age > SAMPLE_AGE_MS_MAX) {
        return Err(vec![Fact::NoSamples {}.into()]);
    }
    // The limits are those of the grade of a run. If an encoder is silent now, its fraction of valid samples is set to zero.
    let share =
        |encoder: &EncoderStatus| if encoder.silent { 0.0 } else { encoder.valid_share.unwrap_or(1.0) };
    let problem = |encoder: &EncoderStatus| {
        let (joints, status, valid_share) = (vec![encoder.joint], Some(encoder.status), share(encoder));
        let severity = if valid_share < VALID_SHARE_BAD { Level::Bad } else { Level::Check };
        Problem::from(Fact::EncoderInvalid { joints, status, valid_share }).with_severity(severity)
    };
    let invalid = status.encoders.iter().filter(|encoder| share(encoder) < VALID_SHARE_GOOD);
    let joints: Vec<_> = status.encoders.iter().map(|encoder| encoder.joint.to_string()).collect();
    none_of(invalid.map(problem), format!("all valid: joints {}", joints.join(", ")))
}

fn cables(status: &Status) -> CheckResult {
    none_of(status.bad_cables.iter().cloned(), "no port has counted an error")
}

/// Checks the reference marks. A run needs no marks, because the calibration estimates the offsets. This check exists because
/// invalid marks would otherwise remain unnoticed.
fn reference_marks(controller: &Controller, found: Option<&DiskFindings>) -> CheckResult {
    let found = found.ok_or_else(unanswered)?;
    let homing = match &found.homing {
        Ok(None) => {
            return Ok(
                "not homed, which is not necessary: the calibration estimates the encoder offsets".into()
            );
        }
        Ok(Some(homing)) => homing,
        Err(error) => return Err(vec![Fact::MarksUnreadable { error: error.clone() }.into()]),
    };
    let Some(session) = controller.bus.session() else {
        return Ok("checked when the bus is in operation".into());
    };
    // Use a copy of the encoders, because only the list of stale marks is needed.
    let stale = homing.apply(&mut session.encoders.clone(), &session.live.latches());
    if stale.is_empty() {
        return Ok(format!("valid for all joints, homed {}", homing.homed));
    }
    Err(vec![Fact::MarksStale { joints: stale }.into()])
}

/// Checks whether reference marks can be saved. A homing takes a person minutes, so the check reports this beforehand.
fn state(controller: &Controller, found: Option<&DiskFindings>) -> CheckResult {
    let file = controller.settings.marks_file.path().display();
    let unsavable = found.ok_or_else(unanswered)?.unsavable.clone();
    none_of(unsavable, format!("reference marks can be saved in {file}"))
}

/// Recording time below which the free space is reported as low \[h\].
const DISK_HOURS_MIN: f64 = 4.0;
/// Size of a cycle in the file, measured with five turning encoders at 100 Hz \[bytes\]. Three encoders need 132 bytes. At
/// 1000 Hz a cycle needs 125 bytes, because longer chunks compress better.
const BYTES_PER_CYCLE: f64 = 170.0;

/// Recording time that fits into this space \[h\].
pub(in crate::control) fn hours_left(usable_bytes: u64, rate_hz: u32) -> f64 {
    usable_bytes as f64 / (BYTES_PER_CYCLE * f64::from(rate_hz.max(1)) * 3600.0)
}

/// Reports that the space suffices for a short time only.
pub(in crate::control) fn space_problem(left_h: f64) -> Option<Problem> {
    (left_h < DISK_HOURS_MIN).then(|| Fact::DiskSpaceLow { left_h }.into())
}

fn disk(controller: &Controller) -> CheckResult {
    // No run begins while the disk has a problem, even a slight one.
    let problems: Vec<Problem> =
        controller.disk_problems().into_iter().map(|problem| problem.with_severity(Level::Bad)).collect();
    if !problems.is_empty() {
        return Err(problems);
    }
    let usable = controller.storage.usable_bytes().unwrap_or(0);
    let rate_hz = controller.settings.daemon.rate_hz;
    let hours = hours_left(usable, rate_hz);
    let waited = controller.run.as_ref().map_or(String::new(), |run| {
        let progress = run.progress.get();
        format!("; {:.1} s wait to be written, {}", progress.backlog_s, progress.longest)
    });
    let usable_mb = usable / 1_000_000;
    let text = format!("{usable_mb} MB usable, about {hours:.0} hours at {rate_hz} Hz{waited}");
    none_of(space_problem(hours), text)
}

fn realtime(controller: &Controller) -> CheckResult {
    let denied = controller.bus.session().and_then(Session::realtime_problem);
    none_of(denied, "priority, core and memory as configured")
}

fn clock() -> CheckResult {
    match clock_is_synchronised() {
        Ok(true) => Ok("synchronised".into()),
        Ok(false) => Err(vec![Fact::ClockUnsynchronised {}.into()]),
        Err(error) => Err(vec![Fact::ClockUnknown { error: error.to_string() }.into()]),
    }
}

/// Whether the kernel reports the clock as synchronised. The NTP or PTP daemon sets this state.
#[allow(unsafe_code, reason = "nix offers no adjtimex")]
fn clock_is_synchronised() -> io::Result<bool> {
    // SAFETY: `timex` is a plain C structure for which all zeros mean "change nothing", and it outlives the call.
    let state = unsafe {
        let mut query: libc::timex = std::mem::zeroed();
        libc::adjtimex(&raw mut query)
    };
    if state < 0 { Err(io::Error::last_os_error()) } else { Ok(state != libc::TIME_ERROR) }
}

fn log() -> CheckResult {
    let lost = Some(log::lines_lost()).filter(|lines| *lines > 0);
    none_of(lost.map(|lines| Fact::LogLinesLost { lines }.into()), "every line was written")
}

fn leftovers(found: Option<&DiskFindings>) -> CheckResult {
    match &found.ok_or_else(unanswered)?.left_behind {
        Err(error) => {
            let (place, error) = ("the directory of the recordings".into(), error.to_string());
            Err(vec![Problem::from(Fact::DiskError { place, error }).with_severity(Level::Check)])
        }
        Ok(files) if files.is_empty() => Ok("none".into()),
        Ok(files) => Err(vec![Fact::FilesLeft { files: files.clone() }.into()]),
    }
}

fn unanswered() -> Vec<Problem> {
    let silent = Problem::from(Fact::DiskSilent { directory: None, silent_s: None });
    vec![silent.with_severity(Level::Check)]
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::time::Duration;

    use shared::config::{self, DaemonConfig};

    use super::*;
    use crate::clock::Clock;
    use crate::run::{self, BusChoice, RunDetails, RunRequest, Setup, Stop, Storage};
    use crate::scheduler::Threads;

    #[test]
    fn a_minute_takes_the_space_that_the_hours_left_assume() {
        let place = tempfile::tempdir().unwrap();
        let bar = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/ball_bar.toml");
        let daemon =
            DaemonConfig { directory: place.path().into(), disk_floor_mb: 0, ..DaemonConfig::default() };
        let scheduler = Threads::on(Clock::Real);
        let storage = Storage::new(&daemon, &*scheduler).unwrap();
        let duration = Some(Duration::from_secs(60));
        let run = RunDetails { name: "minute".into(), duration, ..RunDetails::default() };
        let request = RunRequest { run, bus: BusChoice::Simulated, fast: true, ..RunRequest::default() };
        let (rate_hz, stop) = (daemon.rate_hz, Stop::default());
        let setup = Setup { scheduler, storage, daemon, bar: config::load(&bar).unwrap() };
        let recorded = run::record(&setup, &request, &stop);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let bytes = std::fs::metadata(runtime.block_on(recorded).unwrap().path).unwrap().len();
        let minutes = 60.0 * hours_left(bytes, rate_hz);
        assert!((minutes - 1.0).abs() < 0.05, "{minutes}");
    }

    /// Returns the line of the encoders if joint 2 had this fraction of valid samples in the last second.
    fn line(valid: bool, silent: bool, valid_share: f64) -> CheckLine {
        let good =
            EncoderStatus { joint: 1, valid: true, valid_share: Some(1.0), ..EncoderStatus::default() };
        let other = EncoderStatus { joint: 2, valid, silent, valid_share: Some(valid_share), ..good };
        super::line(
            "encoders",
            encoders(&Status { sample_age_ms: Some(1), encoders: vec![good, other], ..Status::default() }),
        )
    }

    #[test]
    fn without_a_bus_the_cause_is_reported_and_not_each_encoder() {
        let encoders = [1, 2].map(|joint| EncoderStatus { joint, silent: true, ..EncoderStatus::default() });
        let line_for = |joints: Vec<u8>| {
            let problem = Problem::from(Fact::BusNoAnswer { bus: "eth1".into() }).with_joints(joints, true);
            let (problems, encoders) = (vec![problem], encoders.to_vec());
            let status = Status { sample_age_ms: Some(1), problems, encoders, ..Status::default() };
            super::line("encoders", super::encoders(&status))
        };
        assert_eq!(line_for(vec![1, 2]).problems, [Problem::from(Fact::NoSamples {})]);
        // Joint 1 has no valid samples either, but not because of the bus.
        assert_eq!(line_for(vec![2]).problems[0].code(), "encoder_invalid");
    }

    #[test]
    fn the_last_second_of_an_encoder_decides_and_not_its_last_sample() {
        // One invalid sample among a hundred.
        assert_eq!(line(false, false, 0.99).remedy, None);
        // One valid sample after a second without valid samples.
        assert!(line(true, false, 0.01).stops);
        // An encoder that is silent now, although it was valid for 90 % of the second.
        assert!(line(false, true, 0.9).stops);
        // A bad contact causes a warning that does not prevent a run.
        let contact = line(true, false, 0.9);
        assert!(contact.remedy.is_some() && !contact.stops, "{contact:?}");
        assert!(contact.finding.contains("joint 2") && contact.finding.contains("90 %"), "{contact:?}");
    }
}
