//! The command line of `ballbard`: exit codes, messages and files.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use shared::recording::schema::{RunMetadata, flags};
use shared::recording::{Recording, RecordingWriter};

use crate::support::{PROGRAM, isolated};

fn config() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")
}

fn ballbard() -> Command {
    let mut command = isolated(Command::new(PROGRAM));
    command.env("RUST_LOG", "off");
    command
}

fn record(out: &Path, arguments: &[&str]) -> Output {
    let mut command = ballbard();
    command.args(["record", "--config"]).arg(config()).arg("--out").arg(out).args(arguments);
    if !arguments.iter().any(|argument| ["--bus", "--replay"].contains(argument)) {
        command.args(["--bus", "simulated"]);
    }
    command.output().unwrap()
}

/// Checks that the command failed with a message that contains each text of `why`. The directory `out` must be empty.
fn refused(output: &Output, why: &[&str], out: &Path) {
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{text}");
    for part in why {
        assert!(text.contains(part), "`{part}` is missing in: {text}");
    }
    let left: Vec<_> = std::fs::read_dir(out).map(|dir| dir.flatten().collect()).unwrap_or_default();
    assert!(left.is_empty(), "left behind: {left:?}");
}

#[test]
fn a_run_is_recorded_and_exported_with_counts_and_angles() {
    let out = tempfile::tempdir().unwrap();
    let output = record(out.path(), &["--name", "trial", "--duration", "2s", "--fast"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("CHECK: it is 2.0 s long") && said.contains("next: "), "{said}");
    let file = out.path().join("trial.mcap");
    let export = ballbard().args(["export", "--csv"]).arg(&file).output().unwrap();
    assert!(export.status.success());
    let recording = Recording::open(&file).unwrap();
    let version = ballbard().arg("--version").output().unwrap();
    assert_eq!(String::from_utf8_lossy(&version.stdout).trim(), recording.run.software);
    let mut table = csv::Reader::from_path(out.path().join("trial.csv")).unwrap();
    assert_eq!(table.headers().unwrap().iter().take(3).collect::<Vec<_>>(), ["time_utc", "count1", "count2"]);
    let rows: Vec<csv::StringRecord> = table.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 200);
    for (row, cycle) in rows.iter().zip(&recording.cycles) {
        assert_eq!(row[0], cycle.sample_time.to_string());
        for (index, encoder) in cycle.encoders().iter().enumerate() {
            assert_eq!(row[1 + index], encoder.count.to_string());
            // The encoder has 3600 lines, each interpolated with 12 bits. The angle is zero where the count is zero.
            let angle_rad = f64::from(encoder.count as i32) * std::f64::consts::TAU / 14_745_600.0;
            assert!((row[6 + index].parse::<f64>().unwrap() - angle_rad).abs() < 1e-8);
        }
    }
}

#[test]
fn no_bus_is_assumed() {
    let out = tempfile::tempdir().unwrap();
    for verb in ["record", "run"] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ballbard"));
        let bare = command.args([OsStr::new(verb), OsStr::new("--out"), out.path().as_os_str()]);
        let output = bare.env_remove("STATE_DIRECTORY").output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{}", said(&output));
        refused(&output, &["--bus INTERFACE", "--bus simulated", "this machine: ", "lo"], out.path());
        // Starts the command with the environment that the package's systemd unit sets.
        let output = bare.env("STATE_DIRECTORY", out.path()).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{}", said(&output));
        refused(&output, &["BALLBARD_OPTIONS in /etc/default/ballbard", "lo"], out.path());
    }
}

#[test]
fn simulated_data_are_called_that_from_the_beginning_to_the_end() {
    let out = tempfile::tempdir().unwrap();
    let arguments = ["record", "--bus", "simulated", "--name", "made-up", "--duration", "1s", "--fast"];
    let recorded = |arguments: &[&str]| {
        let mut command = ballbard();
        command
            .env_remove("RUST_LOG")
            .args(arguments)
            .arg("--config")
            .arg(config())
            .arg("--out")
            .arg(out.path());
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", said(&output));
        output
    };
    let output = recorded(&arguments);
    let (begin, end) = (String::from_utf8_lossy(&output.stderr), String::from_utf8_lossy(&output.stdout));
    assert!(begin.contains("SIMULATED") && end.contains("SIMULATED"), "{}", said(&output));
    // A replay of simulated data is marked as simulated. A replay of measured data is not.
    let made_up = out.path().join("made-up.mcap");
    let Recording { run, cycles, .. } = Recording::open(&made_up).unwrap();
    let ended = run.started;
    let measured = RunMetadata { name: "measured".into(), bus: "eth1".into(), ..run };
    let mut writer = RecordingWriter::create(out.path(), &measured).unwrap();
    cycles.iter().for_each(|cycle| writer.write_cycle(cycle).unwrap());
    let measured = writer.finish("stopped", ended).unwrap();
    for (file, name, is_simulated) in [(made_up, "again", true), (measured, "repeated", false)] {
        let output = recorded(&["record", "--replay", file.to_str().unwrap(), "--name", name, "--fast"]);
        assert_eq!(said(&output).contains("SIMULATED"), is_simulated, "{}", said(&output));
        let origin = file.file_stem().unwrap().to_str().unwrap();
        assert!(said(&output).contains(&format!("replay of `{origin}`, recorded 20")), "{}", said(&output));
    }
    let again = out.path().join("again.mcap").display().to_string();
    let part = ["record", "--replay", &again, "--name", "part", "--duration", "0.5s", "--fast"];
    recorded(&part);
    let listed = ballbard().arg("runs").arg(out.path()).output().unwrap();
    let lines = said(&listed);
    let line = |name: &str| lines.lines().find(|line| line.starts_with(name)).unwrap();
    assert!(line("made-up").contains("  [SIMULATED]"), "{lines}");
    assert!(line("again").contains("[SIMULATED, replay of `made-up`, recorded"), "{lines}");
    assert!(
        line("repeated").contains("[replay of `measured`") && line("repeated").contains("on eth1]"),
        "{lines}"
    );
    assert!(!line("measured").contains('['), "{lines}");
    assert!(line("again").contains("; end of the replayed recording  ["), "{lines}");
    assert!(line("part").contains("; duration reached  ["), "{lines}");
}

#[test]
fn an_unknown_interface_is_refused_with_those_that_exist() {
    let out = tempfile::tempdir().unwrap();
    refused(
        &record(out.path(), &["--bus", "eth99"]),
        &["network interface `eth99` not found", "lo"],
        out.path(),
    );
}

#[test]
fn without_permission_the_message_says_what_to_type() {
    let out = tempfile::tempdir().unwrap();
    let root = nix::unistd::geteuid().is_root();
    let mut command = isolated(Command::new(if root { "setpriv" } else { PROGRAM }));
    if root {
        command.args(["--reuid=65534", "--regid=65534", "--clear-groups", "--inh-caps=-all", PROGRAM]);
    }
    command.args(["record", "--bus", "lo", "--config"]).arg(config()).arg("--out").arg(out.path());
    refused(&command.output().expect("setpriv of util-linux"), &["no permission", "setcap"], out.path());
}

#[test]
#[ignore = "needs root for a raw socket"]
fn an_interface_where_nobody_answers_is_refused() {
    let out = tempfile::tempdir().unwrap();
    refused(
        &record(out.path(), &["--bus", "lo"]),
        &["no EtherCAT device answers on lo", "power"],
        out.path(),
    );
}

#[test]
fn contradictions_are_refused() {
    let out = tempfile::tempdir().unwrap();
    refused(&record(out.path(), &["--fast"]), &["--duration"], out.path());
    refused(
        &record(out.path(), &["--bus", "lo", "--fast", "--duration", "1s"]),
        &["virtual time"],
        out.path(),
    );
    refused(&record(out.path(), &["--bus", "lo", "--replay", "x.mcap"]), &["--replay"], out.path());
    refused(&record(out.path(), &["--name", "///", "--duration", "1s", "--fast"]), &["run name"], out.path());
}

#[test]
fn what_goes_wrong_on_the_simulated_bus_is_chosen_by_hand() {
    let out = tempfile::tempdir().unwrap();
    let arguments = ["--name", "faulty", "--duration", "6s", "--fast", "--fault", "lost:1@3s-3500ms"];
    let output = record(out.path(), &arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let recording = Recording::open(&out.path().join("faulty.mcap")).unwrap();
    let silent = recording.cycles.iter().filter(|cycle| cycle.flags & flags::NO_REPLY != 0).count();
    assert!((49..=51).contains(&silent), "{silent} cycles without a reply");
    std::fs::remove_file(out.path().join("faulty.mcap")).unwrap();
    refused(
        &record(out.path(), &["--fault", "gnoe:3"]),
        &["`gnoe:3` is not a fault", "gone:POSITION"],
        out.path(),
    );
    refused(&record(out.path(), &["--bus", "lo", "--fault", "lost:1"]), &["simulated bus"], out.path());
    refused(&record(out.path(), &["--fault", "gone:6"]), &["no device for a fault"], out.path());
}

#[test]
fn faults_are_listed_on_request() {
    for verb in ["record", "run", "smoke", "segment"] {
        let output = ballbard().args([verb, "--fault", "list"]).output().unwrap();
        let listed = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && output.stderr.is_empty(), "{verb}: {}", said(&output));
        assert!(listed.lines().any(|line| line == "gone:POSITION"), "{verb}: {listed}");
    }
}

#[test]
fn a_bus_gone_for_good_ends_the_run_with_a_finished_file_that_says_so() {
    let out = tempfile::tempdir().unwrap();
    // The limit `full_fault_s` ends the run long before its requested duration.
    let output =
        record(out.path(), &["--name", "gone", "--duration", "1h", "--fast", "--fault", "link-down@3s"]);
    // Most cycles of the run are invalid. The exit code must be nonzero so that a batch job notices this.
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    assert!(said(&output).contains("run `gone` is unusable: 60"), "{}", said(&output));
    let recording = Recording::open(&out.path().join("gone.mcap")).unwrap();
    assert!(recording.end.cause.contains("limit `full_fault_s`"), "{}", recording.end.cause);
    let blind = recording.cycles.iter().rev().take_while(|cycle| !cycle.is_valid()).count();
    // The run ends after 60 s without a valid cycle, plus at most the longest check of the bus.
    assert!((6000..6100).contains(&blind), "{blind} cycles");
}

/// The segment delays every reply beyond the end of its cycle, so the bus never reaches OP. The command must print
/// a warning after 5 s.
#[test]
fn a_bus_that_does_not_come_into_operation_is_not_waited_for_in_silence() {
    let out = tempfile::tempdir().unwrap();
    let mut command = ballbard();
    command.args(["record", "--bus", "simulated", "--fault", "late:1,22ms", "--config"]).arg(config());
    command.arg("--out").arg(out.path()).env("RUST_LOG", "warn").stderr(Stdio::piped()).stdout(Stdio::null());
    let child = command.spawn().unwrap();
    std::thread::sleep(Duration::from_secs(7));
    kill(&child, nix::sys::signal::Signal::SIGINT);
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && said.contains("the bus is not in operation after 5 s"), "{said}");
}

fn kill(child: &Child, signal: nix::sys::signal::Signal) {
    let pid = nix::unistd::Pid::from_raw(i32::try_from(child.id()).unwrap());
    nix::sys::signal::kill(pid, signal).unwrap();
}

#[test]
fn a_bus_that_is_waited_for_can_be_given_up() {
    let out = tempfile::tempdir().unwrap();
    let mut command = ballbard();
    command
        .args(["record", "--wait", "--bus", "eth99", "--config"])
        .arg(config())
        .arg("--out")
        .arg(out.path());
    let child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_millis(1500));
    kill(&child, nix::sys::signal::Signal::SIGINT);
    let output = child.wait_with_output().unwrap();
    refused(&output, &["nothing was recorded", "Ctrl-C", "network interface `eth99` not found"], out.path());
}

#[test]
fn what_a_killed_run_left_is_recovered_when_the_next_begins() {
    let out = tempfile::tempdir().unwrap();
    let mut command = ballbard();
    command.args(["record", "--bus", "simulated", "--name", "killed", "--config"]).arg(config());
    command.arg("--out").arg(out.path());
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let active = out.path().join("killed.mcap.active");
    while !active.exists() {
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(2500));
    kill(&child, nix::sys::signal::Signal::SIGKILL);
    child.wait().unwrap();
    let output = record(out.path(), &["--name", "next", "--duration", "1s", "--fast"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let killed = Recording::open(&out.path().join("killed.mcap")).unwrap();
    assert!(killed.end.recovered && killed.end.cause.contains("recovered"), "{:?}", killed.end);
    assert!(killed.cycles.len() > 50 && !active.exists(), "{}", killed.cycles.len());
    let listed = ballbard().arg("runs").arg(out.path()).output().unwrap();
    let text = String::from_utf8_lossy(&listed.stdout);
    assert!(text.lines().any(|line| line.contains("killed") && line.contains("[recovered]")), "{text}");
}

#[test]
fn homing_without_a_service_or_a_bus_says_what_to_do() {
    let home = |arguments: &[&str]| ballbard().arg("home").args(arguments).output().unwrap();
    let alone = home(&["--port", "1"]);
    assert!(!alone.status.success());
    assert!(String::from_utf8_lossy(&alone.stderr).contains("ballbard run"), "{alone:?}");
    let state = tempfile::tempdir().unwrap();
    let state = state.path().to_str().unwrap();
    let unknown = home(&["--bus", "eth99", "--state", state, "--config", config().to_str().unwrap()]);
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("network interface"), "{unknown:?}");
    let elsewhere = home(&["--state", "elsewhere"]);
    assert!(String::from_utf8_lossy(&elsewhere.stderr).contains("--state needs --bus"), "{elsewhere:?}");
    assert!(!config().join("homing.toml").exists());
}

#[test]
fn a_homing_of_simulated_encoders_says_so_before_the_first_joint() {
    let state = tempfile::tempdir().unwrap();
    let mut command = ballbard();
    command.args(["home", "--bus", "simulated", "--config"]).arg(config()).arg("--state").arg(state.path());
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    kill(&child, nix::sys::signal::Signal::SIGINT);
    child.wait().unwrap();
    assert!(line.starts_with("SIMULATED: "), "{line}");
}

#[test]
fn a_file_that_is_no_recording_is_refused_and_exports_nothing() {
    let out = tempfile::tempdir().unwrap();
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("notes.mcap");
    std::fs::write(&file, "not a recording").unwrap();
    let replay = record(out.path(), &["--replay", file.to_str().unwrap(), "--fast"]);
    refused(&replay, &["notes.mcap", "damaged or not an MCAP file"], out.path());
    let export = ballbard().args(["export", "--csv"]).arg(&file).output().unwrap();
    assert!(!export.status.success());
    let left: Vec<_> = std::fs::read_dir(directory.path()).unwrap().map(|one| one.unwrap().path()).collect();
    assert_eq!(left, [file]);
}

#[test]
fn a_wrong_key_in_the_configuration_is_named_with_its_file() {
    let directory = tempfile::tempdir().unwrap();
    let out = tempfile::tempdir().unwrap();
    for name in ["daemon.toml", "ball_bar.toml"] {
        std::fs::copy(config().join(name), directory.path().join(name)).unwrap();
    }
    let shipped = std::fs::read_to_string(config().join("daemon.toml")).unwrap();
    for (broken, why) in [
        (shipped.replace("rate_hz = 100", "rate_hz = 0"), "rate_hz"),
        (shipped.replace("rate_hz = 100", "rate_hz = \"fast\""), "rate_hz"),
        (shipped.replace("rate_hz = 100", "rate_herz = 100"), "rate_herz"),
        (shipped.replace("rate_hz = 100", "rate_hz = "), "line"),
    ] {
        std::fs::write(directory.path().join("daemon.toml"), broken).unwrap();
        let mut command = ballbard();
        command.args(["record", "--bus", "simulated", "--fast", "--duration", "1s"]);
        command.arg("--config").arg(directory.path());
        let output = command.arg("--out").arg(out.path()).output().unwrap();
        refused(&output, &["daemon.toml", why], out.path());
    }
}

#[test]
fn a_configuration_that_cannot_be_read_is_named_with_its_cause_once() {
    let (directory, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    std::fs::create_dir(directory.path().join("daemon.toml")).unwrap();
    let mut command = ballbard();
    command.args(["record", "--bus", "simulated", "--fast", "--duration", "1s"]);
    command.arg("--config").arg(directory.path());
    let output = command.arg("--out").arg(out.path()).output().unwrap();
    refused(&output, &["daemon.toml", "check the path"], out.path());
    assert_eq!(said(&output).matches("Is a directory").count(), 1, "{}", said(&output));
}

#[test]
fn default_names_and_lists_are_in_the_time_of_the_place_and_lists_say_which() {
    let out = tempfile::tempdir().unwrap();
    let there = |mut command: Command| command.env("TZ", "JST-9").output().unwrap();
    let mut record = ballbard();
    record.args(["record", "--bus", "simulated", "--duration", "1s", "--fast", "--config"]).arg(config());
    record.arg("--out").arg(out.path());
    let before = chrono::Utc::now().timestamp();
    let recorded = there(record);
    assert!(recorded.status.success(), "{}", said(&recorded));
    let file = std::fs::read_dir(out.path()).unwrap().next().unwrap().unwrap().path();
    let name = file.file_stem().unwrap().to_str().unwrap();
    let named = chrono::NaiveDateTime::parse_from_str(name, "%Y-%m-%d_%H-%M-%S").unwrap().and_utc();
    let named = named.timestamp() - 9 * 3600;
    assert!((before..=chrono::Utc::now().timestamp()).contains(&named), "{name}");
    let mut list = ballbard();
    list.arg("runs").arg(out.path());
    let listed = said(&there(list));
    let started = Recording::open(&file).unwrap().run.started.to_datetime() + chrono::TimeDelta::hours(9);
    assert!(listed.contains(&started.format("%Y-%m-%d %H:%M:%S +09:00").to_string()), "{listed}");
}

#[test]
fn a_signal_ends_a_run_with_a_finished_file_that_states_it() {
    let out = tempfile::tempdir().unwrap();
    let mut command = ballbard();
    command.args(["record", "--bus", "simulated", "--name", "signal", "--config"]).arg(config());
    command.arg("--out").arg(out.path());
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let active = out.path().join("signal.mcap.active");
    while !active.exists() {
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(500));
    kill(&child, nix::sys::signal::Signal::SIGTERM);
    assert!(child.wait().unwrap().success());
    let recording = Recording::open(&out.path().join("signal.mcap")).unwrap();
    assert!(recording.end.cause.contains("SIGTERM"), "{}", recording.end.cause);
    assert!(!recording.cycles.is_empty() && !active.exists());
}

/// Runs a command with `--json`. Returns its output, which must be a single JSON value, and its exit code.
fn json(arguments: &[&str]) -> (serde_json::Value, Option<i32>) {
    let output = ballbard().args(arguments).arg("--json").output().unwrap();
    let value = serde_json::from_slice(&output.stdout).unwrap();
    (value, output.status.code())
}

#[test]
fn commands_without_a_service_answer_programs_too() {
    let (out, config) = (tempfile::tempdir().unwrap(), config());
    let (directory, config) = (out.path().to_str().unwrap(), config.to_str().unwrap());
    let recorded = |name: &str, fault: &str| {
        let arguments = ["record", "--bus", "simulated", "--name", name, "--fault", fault];
        let arguments = [&arguments[..], &["--duration", "2s", "--fast"]].concat();
        json(&[&arguments[..], &["--config", config, "--out", directory]].concat())
    };
    // Records a complete run, and a run without a valid cycle. The second command fails but still prints a result.
    let (last, code) = recorded("whole", "lost:1@2s-2100ms");
    let file = out.path().join("whole.mcap");
    let recording = Recording::open(&file).unwrap();
    assert_eq!((code, last["name"].as_str(), last["file"].as_str()), (Some(0), Some("whole"), file.to_str()));
    assert_eq!(last["cycles"], recording.cycles.len());
    assert_eq!(last["cycles_valid"], recording.cycles.iter().filter(|cycle| cycle.is_valid()).count());
    assert_ne!(last["cycles_valid"], last["cycles"]);
    let (blind, code) = recorded("blind", "no-signal:1");
    assert_eq!((code, &blind["cycles_valid"]), (Some(1), &0.into()), "{blind}");
    assert_eq!((&last["verdict"]["level"], &blind["verdict"]["level"]), (&"check".into(), &"bad".into()));

    let file = file.to_str().unwrap();
    let (table, _) = json(&["export", "--csv", file]);
    assert_eq!(
        (&table["rows"], table["file"].as_str().unwrap()),
        (&last["cycles"], &*file.replace("mcap", "csv"))
    );
    let both = ballbard().args(["export", "--csv", "--out", "-", "--json", file]).output().unwrap();
    assert!(both.stdout.is_empty() && said(&both).contains("omit --json"), "{both:?}");

    assert_eq!(json(&["recover", file]).0["outcome"], "whole");
    let torn = out.path().join("torn.mcap");
    let bytes = std::fs::read(file).unwrap();
    std::fs::write(&torn, &bytes[..bytes.len() * 3 / 4]).unwrap();
    let (recovered, code) = json(&["recover", torn.to_str().unwrap()]);
    let kept = Recording::open(&torn).unwrap();
    assert_eq!((code, &recovered["outcome"]), (Some(0), &"recovered".into()), "{recovered}");
    assert_eq!(recovered["cycles"], kept.cycles.len());
    assert!(recovered["file"] == torn.to_str().unwrap(), "{recovered}");

    let (findings, code) = json(&["tune", "--config", config]);
    let standing = ["fine", "slight", "problem", "unknown"];
    for finding in findings.as_array().unwrap() {
        assert!(standing.contains(&finding["verdict"].as_str().unwrap()), "{finding}");
    }
    let has_problem = findings.as_array().unwrap().iter().any(|finding| finding["verdict"] == "problem");
    assert_eq!(code, Some(i32::from(has_problem)));
    assert!(findings.as_array().unwrap().iter().any(|finding| finding["subject"] == "kernel"), "{findings}");
}

#[test]
fn tune_says_how_each_setting_stands() {
    let output = ballbard().args(["tune", "--config"]).arg(config()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(i32::from(text.contains("PROBLEM"))), "{text}");
    for subject in ["kernel", "isolated core", "priority", "locked memory", "interrupt coalescing"] {
        assert!(text.contains(subject), "`{subject}` is missing in: {text}");
    }
}

#[test]
fn tune_refuses_an_interface_that_is_not_there() {
    let output = ballbard().args(["tune", "--interface", "nope", "--config"]).arg(config()).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(text.contains("network interface `nope` not found") && text.contains("lo"), "{text}");
    assert!(output.stdout.is_empty());
}

/// Runs a command in an empty directory that has no configuration. Returns this directory and the output.
fn nowhere(arguments: &[&str]) -> (tempfile::TempDir, Output) {
    let directory = tempfile::tempdir().unwrap();
    let output = ballbard().current_dir(&directory).args(arguments).output().unwrap();
    (directory, output)
}

/// Runs a command in network and mount namespaces in which no service runs or is installed. Without the right to create
/// namespaces, the command runs directly.
fn alone(arguments: &[&str]) -> Output {
    const WITHIN: [&str; 5] = ["--map-root-user", "--net", "--mount", "sh", "-c"];
    const INSTALLED: &str = "[ ! -d /etc/ballbard ] || mount -t tmpfs none /etc/ballbard";
    let unshare = || isolated(Command::new("unshare"));
    let has_namespaces = unshare().args(WITHIN).arg(INSTALLED).output().is_ok_and(|out| out.status.success());
    let directory = tempfile::tempdir().unwrap();
    let mut command = if has_namespaces { unshare() } else { ballbard() };
    if has_namespaces {
        command.args(WITHIN).arg(format!("{INSTALLED} && exec \"$0\" \"$@\"")).arg(PROGRAM);
    }
    command.current_dir(&directory).args(arguments).output().unwrap()
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[test]
fn a_run_is_recorded_from_any_directory_and_a_bare_number_is_seconds() {
    let arguments = ["record", "--bus", "simulated", "--name", "bare", "--duration", "2", "--fast"];
    let (directory, output) = nowhere(&[&arguments[..], &["--out", "here"]].concat());
    assert!(output.status.success(), "{}", said(&output));
    let file = directory.path().join("here/bare.mcap");
    assert_eq!(Recording::open(&file).unwrap().cycles.len(), 200);
    for wrong in ["2 parsecs", "5x", "-1", "1e400"] {
        let argument = format!("--duration={wrong}");
        let wrong = ballbard().args(["record", "--bus", "simulated", &argument, "--fast"]).output().unwrap();
        assert_eq!(wrong.status.code(), Some(2), "{}", said(&wrong));
        assert!(said(&wrong).contains("such as 90s or 1h 30m"), "{}", said(&wrong));
    }
}

#[test]
fn a_directory_that_was_typed_is_meant_and_what_is_missing_in_it_is_named() {
    let (_directory, output) =
        nowhere(&["record", "--bus", "simulated", "--config", "nothing-here", "--fast", "--duration", "1"]);
    assert!(
        !output.status.success() && said(&output).contains("nothing-here/daemon.toml"),
        "{}",
        said(&output)
    );
    // If there is no port file, the error must state where the port number came from.
    let output = alone(&["status"]);
    let text = said(&output);
    let counts = ["no daemon.toml in config or /etc/ballbard", "7311"].map(|part| text.matches(part).count());
    assert!(!output.status.success(), "{text}");
    assert_eq!(counts, [1, 1], "{text}");
}

#[test]
fn an_export_replaces_nothing_unasked_and_has_marks_relative_seconds_and_continental_numbers() {
    let out = tempfile::tempdir().unwrap();
    let about = ["--robot", "IRB 2400", "--note", "=cmd()\nnext", "--fault", "gone:3@1s-1500ms"];
    let arguments = ["--name", "trial", "--duration", "4s", "--fast"];
    assert!(record(out.path(), &[&arguments[..], &about].concat()).status.success());
    let (file, table) = (out.path().join("trial.mcap"), out.path().join("trial.csv"));
    let export = |arguments: &[&str]| ballbard().arg("export").args(arguments).arg(&file).output().unwrap();
    assert!(export(&[]).status.success());
    let first = std::fs::read_to_string(&table).unwrap();
    assert!(first.lines().next().unwrap().ends_with(",cycle,flags,event"), "{}", &first[..200]);
    assert!(
        first
            .lines()
            .nth(1)
            .unwrap()
            .ends_with(",SIMULATED; angles from: counter at 0; robot: IRB 2400; note: =cmd() next"),
        "{:?}",
        first.lines().nth(1)
    );
    assert!(
        first.contains(",gap: ") || first.contains("; gap: ") || first.contains("bus: "),
        "no event is in it"
    );
    let nowhere = out.path().join("nodir");
    let failed = export(&["--out", nowhere.join("x.csv").to_str().unwrap()]);
    let message = format!("--out: the directory {} does not exist", nowhere.display());
    assert!(!failed.status.success() && said(&failed).contains(&message), "{}", said(&failed));
    let again = export(&["--excel", "--relative"]);
    assert!(!again.status.success() && said(&again).contains("--force"), "{}", said(&again));
    assert_eq!(std::fs::read_to_string(&table).unwrap(), first);
    assert!(export(&["--excel", "--relative", "--force"]).status.success());
    let excel = std::fs::read_to_string(&table).unwrap();
    let row: Vec<&str> = excel.lines().nth(2).unwrap().split(';').collect();
    assert!(excel.starts_with("\u{feff}t_s;count1;") && row[0].starts_with("0,01"), "{row:?}");
    assert_eq!(row.len(), excel.lines().next().unwrap().split(';').count());
}

#[test]
fn a_smoke_test_ends_with_0_only_if_all_passed_and_always_with_a_report() {
    let out = tempfile::tempdir().unwrap();
    let smoke = |arguments: &[&str]| {
        let mut command = ballbard();
        command.current_dir(out.path()).args(["smoke", "--bus", "simulated", "--fast"]).args(arguments);
        command.output().unwrap()
    };
    let healthy = smoke(&[]);
    let text = String::from_utf8_lossy(&healthy.stdout);
    assert!(healthy.status.success() && text.contains("passed    pulled cable"), "{text}");
    assert!(
        text.contains("disabled  homing: `homing = false`") && text.contains("smoke-simulated.json"),
        "{text}"
    );
    // A link is followed and not replaced.
    std::os::unix::fs::symlink("linked.json", out.path().join("noisy.json")).unwrap();
    let noisy = smoke(&["--fault", "noise:2,0.1", "--json", "--report", "noisy.json"]);
    assert_eq!(noisy.status.code(), Some(1));
    let printed: serde_json::Value = serde_json::from_slice(&noisy.stdout).unwrap();
    let written = std::fs::read(out.path().join("linked.json")).unwrap();
    assert_eq!(serde_json::from_slice::<serde_json::Value>(&written).unwrap(), printed);
    assert_eq!(smoke(&["--checks", "daemon"]).status.code(), Some(1));
    for arguments in [&["--bus", "eth9", "--fast"][..], &["--fault", "lost:0.01"]] {
        let refused = ballbard().arg("smoke").args(arguments).output().unwrap();
        assert_eq!(refused.status.code(), Some(2));
        assert!(said(&refused).contains("type --bus simulated"), "{}", said(&refused));
    }
}

#[test]
fn completions_and_man_pages_know_every_command() {
    let bash = ballbard().args(["generate", "completions", "bash"]).output().unwrap();
    let pages = tempfile::tempdir().unwrap();
    assert!(ballbard().args(["generate", "man"]).arg(pages.path()).status().unwrap().success());
    for command in ["run", "start", "stop", "export", "home"] {
        assert!(said(&bash).contains(command), "{command}");
        assert!(pages.path().join(format!("ballbard-{command}.1")).exists(), "{command}");
    }
}
