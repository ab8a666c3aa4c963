//! The smoke test over a raw socket and a veth pair.

use serde_json::Value;

use super::namespace::{Namespace, serve_segment};

/// Outcome of the check with this subject in a report.
fn outcome<'a>(report: &'a Value, subject: &str) -> &'a Value {
    let checks = report["checks"].as_array().unwrap();
    &checks.iter().find(|check| check["subject"] == subject).unwrap()["outcome"]
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn a_smoke_test_reports_the_devices_and_how_the_bus_came_up() {
    let namespace = Namespace::new("smoke");
    let _segment = serve_segment(&namespace, &["--revision", "22"]);
    let directory = tempfile::tempdir().unwrap();
    let (checks, file) = (directory.path().join("short.toml"), directory.path().join("report.json"));
    let shipped = shared::config::Kind::Smoke.built_in("smoke");
    let short = shipped.replace("duration_s = 60", "duration_s = 3").replace("17, 18, 19, 20, 21, 22", "17");
    std::fs::write(&checks, short).unwrap();
    let mut smoke = namespace.ballbard();
    smoke.args(["smoke", "--bus", "near", "--checks"]).arg(&checks).arg("--report").arg(&file);
    let output = smoke.output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("FAILED    revisions: EL5021 r22"), "{text}");
    let report: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    // Only these checks do not depend on the load of the machine.
    for (subject, expected) in [
        ("interface", "passed"),
        ("devices", "passed"),
        ("revisions", "failed"),
        ("bring_up", "passed"),
        ("cables", "passed"),
        ("homing", "not_done"),
        // No person can pull the cable here, so this check is not done.
        ("pulled_cable", "not_done"),
    ] {
        assert_eq!(outcome(&report, subject), expected, "{subject}: {text}");
    }
    assert_eq!(report["devices"].as_array().unwrap().len(), 6);
    assert!(report["host"]["kernel"].is_string() && report["host"]["interface"].is_object(), "{report}");
    assert!(report["cycles"][1]["timing"]["lateness"]["p99_ns"].is_u64(), "{report}");
}
