//! The smoke test on the simulated segment, in virtual time. If the bus has a fault, only the check that is named
//! after this fault may fail.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use ballbard::clock::Clock;
use ballbard::run::{BusChoice, RunRequest, Stop};
use ballbard::scheduler::Threads;
use ballbard::smoke::{Bench, Check, CyclesConfig, Outcome, Reason, Report, SmokeConfig, Subject, smoke};
use shared::config::{self, DaemonConfig, Kind};

use crate::support::runs::bar;

/// The shipped configuration with homing. Each check of cycles is shortened to ten seconds.
fn shipped() -> SmokeConfig {
    let shipped: SmokeConfig = config::parse(Kind::Smoke.built_in("smoke"), Path::new("smoke.toml")).unwrap();
    let cycles = shipped.cycles.iter().map(|asked| CyclesConfig { duration_s: 10, ..*asked }).collect();
    SmokeConfig { homing: true, cycles, ..shipped }
}

fn tested_until(smoke_config: &SmokeConfig, faults: &[&str], stop: &Stop) -> (Report, Vec<String>) {
    let faults = faults.iter().map(|fault| fault.parse().unwrap()).collect();
    let request = RunRequest { bus: BusChoice::Simulated, faults, fast: true, ..RunRequest::default() };
    let directory = tempfile::tempdir().unwrap();
    let daemon = DaemonConfig { directory: directory.path().to_owned(), ..DaemonConfig::default() };
    let bar = bar();
    let bench =
        Bench { smoke: smoke_config, daemon: &daemon, bar: &bar, request: &request, has_person: false, stop };
    let mut told = Vec::new();
    let mut tell = |line: &str| told.push(line.to_owned());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    let report = runtime.block_on(smoke(&Threads::on(Clock::Real), &bench, &mut tell)).unwrap();
    (report, told)
}

fn tested(smoke_config: &SmokeConfig, faults: &[&str]) -> Report {
    tested_until(smoke_config, faults, &Stop::default()).0
}

fn failed(report: &Report) -> Vec<(Subject, Option<u32>)> {
    let failed = |check: &&Check| matches!(check.outcome, Outcome::Failed { .. });
    report.checks.iter().filter(failed).map(|check| (check.subject, check.rate_hz)).collect()
}

/// Codes of the failed checks.
fn codes(report: &Report) -> Vec<Option<&'static str>> {
    let code = |check: &Check| match &check.outcome {
        Outcome::Failed { code, .. } => Some(*code),
        _ => None,
    };
    report.checks.iter().filter_map(code).collect()
}

#[test]
fn a_healthy_bus_passes_every_check_and_the_report_has_its_figures() {
    let (report, told) = tested_until(&shipped(), &[], &Stop::default());
    assert!(report.checks.iter().all(|check| matches!(check.outcome, Outcome::Passed { .. })), "{told:#?}");
    assert_eq!(report.checks.len(), 3 + 2 * 6 + 2);
    assert_eq!(report.devices.len(), 6);
    assert!(report.devices[1..].iter().all(|device| device.revision >> 16 == 20));
    for (figures, cycles) in report.cycles.iter().zip([1_000, 10_000]) {
        assert_eq!((figures.cycles, figures.cycles_valid), (cycles, cycles), "{figures:?}");
        assert_eq!(figures.working_counters, [(15, cycles)].into());
        assert!(figures.encoders.iter().all(|encoder| encoder.valid == cycles && encoder.sync_errors == 0));
        assert_eq!(figures.clocks.devices.len(), 5);
        // The rate errors of the segment's crystals are up to 20 ppm.
        assert!(figures.clocks.host_rate_ppm.unwrap().abs() < 25.0);
    }
    // After the cable was pulled, the bus was initialised again and returned to operation.
    let pulled = report.pulled_cable.as_ref().unwrap();
    assert!(pulled.events.contains_key("bus_restored") && pulled.flags["bus_down"] > 0, "{pulled:?}");
    let asked = told.iter().filter(|line| line.contains("turn it slowly")).count();
    assert_eq!(asked, 5);
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["checks"][0]["outcome"], "passed");
    assert_eq!(json["cycles"][0]["working_counters"]["15"], 1_000);
}

#[test]
fn each_fault_fails_the_check_of_its_name() {
    use Subject::{Cables, Cycles, Devices, Revisions, Signals, WorkingCounter};
    let asked = SmokeConfig { homing: false, pulled_cable: false, ..shipped() };
    let other = SmokeConfig { terminal_revisions: vec![16, 17], ..asked.clone() };
    let at_both = |subject| vec![(subject, Some(100)), (subject, Some(1000))];
    let cases = [
        (&other, "duplicated:0.0", vec![(Revisions, None)], None),
        (&asked, "gone:4", vec![(Devices, None)], Some("bus_device_missing")),
        (&asked, "link-down", vec![(Devices, None)], Some("bus_no_answer")),
        (&asked, "noise:3,0.1", at_both(Cables), Some("link_errors")),
        (&asked, "lost:0.01@5s", at_both(Cycles), Some("bus_no_answer")),
        (&asked, "short:0.01,3", at_both(WorkingCounter), Some("bus_bad_replies")),
        (&asked, "no-signal:2", at_both(Signals), Some("encoder_invalid")),
    ];
    for (config, fault, expected, code) in cases {
        let report = tested(config, &[fault]);
        assert_eq!(failed(&report), expected, "{fault}: {:#?}", report.checks);
        assert!(codes(&report).iter().all(|found| *found == code), "{fault}: {:?}", codes(&report));
        assert!(!report.is_good());
    }
}

#[test]
fn terminals_that_are_there_are_in_the_report_of_a_bus_that_does_not_come_up() {
    let report = tested(&shipped(), &["gone:4"]);
    assert_eq!(report.devices.len(), 4);
    let not_done =
        |check: &&Check| check.outcome == Outcome::NotDone { because: Reason::After(Subject::Devices) };
    // These are all checks of cycles at two rates, homing, and the pulled cable.
    assert_eq!(report.checks.iter().filter(not_done).count(), 2 * 6 + 2);
    let report = tested(&shipped(), &["abort:2,0x06090011"]);
    assert_eq!(
        failed(&report),
        vec![(Subject::BringUp, Some(100)), (Subject::BringUp, Some(1000))],
        "{report:?}"
    );
    assert_eq!((report.devices.len(), codes(&report)[0]), (6, Some("bus_setting_refused")));
}

#[test]
fn what_is_not_asked_for_is_not_missed_and_what_nobody_can_do_is() {
    let asked = SmokeConfig { homing: false, pulled_cable: false, signals: false, ..shipped() };
    let report = tested(&asked, &["no-signal:2"]);
    assert!(report.is_good(), "{:#?}", report.checks);
    let stop = Stop::default();
    stop.stop("stopped by SIGINT");
    let (report, told) = tested_until(&asked, &[], &stop);
    let stopped = Outcome::NotDone { because: Reason::Stopped("stopped by SIGINT".into()) };
    assert!(!report.is_good() && report.checks.iter().filter(|check| check.outcome == stopped).count() > 10);
    // The summary counts the lines that begin with these words.
    let is_bad = |line: &&String| ["FAILED", "not done"].iter().any(|word| line.starts_with(word));
    assert_eq!(told.iter().filter(is_bad).count(), report.bad_checks(), "{told:#?}");
}

#[test]
fn a_configuration_that_cannot_be_tested_is_refused_with_its_key() {
    let shipped = Kind::Smoke.built_in("smoke");
    for (from, to, key) in [
        ("rate_hz = 1000", "rate_hz = 5000", "rate_hz"),
        ("duration_s = 60", "duration_s = 0", "duration_s"),
        ("bad_share_max = 0.001", "bad_share_max = nan", "bad_share_max"),
        ("signals = true", "signal = true", "signals"),
        ("[[cycles]]", "[[cycle]]", "cycles"),
    ] {
        let text = shipped.replace(from, to);
        let error = config::parse::<SmokeConfig>(&text, Path::new("bench.toml")).unwrap_err().to_string();
        assert!(error.contains("bench.toml") && error.contains(&format!("`{key}`")), "{error}");
    }
}
