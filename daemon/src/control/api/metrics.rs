//! Exports the latest content of the page to Prometheus.

use std::fmt;
use std::sync::atomic::AtomicU64;

use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::registry::Registry;
use shared::version::version;

use crate::control::live::{Joint, Live};
use crate::control::status::{ServiceState, Status, Totals};
use crate::problem::{Level, Problem};

/// Path of the metrics.
pub(super) const PATH: &str = "/metrics";
/// Media type of [`text`].
pub(super) const MEDIA_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The metrics in the OpenMetrics format. Metrics with unknown values are omitted.
pub(super) fn text(live: &Live) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix("ballbard");
    let Live { status, warnings, disk_hours, joints, .. } = live;
    let one_in = |state: ServiceState| one_if(status.state == state);
    let (recording, ready) = (one_in(ServiceState::Writing), one_in(ServiceState::Waiting));
    add(
        &mut registry,
        "recording",
        "1 if a run is recorded and its cycles reach the disk in time, else 0",
        recording,
    );
    add(&mut registry, "ready", "1 if a run can begin, else 0", ready);
    add(&mut registry, "warnings", "Warnings on the page", warnings.len() as f64);
    if let Some(hours) = disk_hours {
        add(&mut registry, "disk_left_hours", "Recording time until the disk is full", *hours);
    }
    add_totals(&mut registry, status);
    add_problems(&mut registry, status, warnings);
    add_run(&mut registry, status);
    add_joints(&mut registry, joints);
    let mut text = String::new();
    encode(&mut text, &registry)?;
    Ok(text)
}

fn add_totals(registry: &mut Registry, status: &Status) {
    let Totals { cycles, cycles_valid, cycles_late, cycles_lost, problems } = &status.totals;
    let counts = [
        ("cycles", "Bus cycles since the service began", cycles),
        ("cycles_valid", "Bus cycles in which every encoder was valid", cycles_valid),
        ("cycles_late", "Bus cycles that missed their deadline", cycles_late),
        ("cycles_lost", "Cycles of runs lost between bus and file", cycles_lost),
    ];
    for (name, help, count) in counts {
        registry.register(name, help, ConstCounter::new(*count));
    }
    let began = Family::<[(&'static str, String); 1], Counter>::default();
    for (code, times) in problems {
        began.get_or_create(&[("code", code.clone())]).inc_by(*times);
    }
    registry.register("problems", "Number of times that each problem began, by code", began);
    let build = Family::<[(&'static str, String); 1], Gauge>::default();
    build.get_or_create(&[("version", version().to_owned())]).set(1);
    registry.register("build_info", "Version and commit of the program", build);
}

/// Number of current problems by code and severity.
fn add_problems(registry: &mut Registry, status: &Status, warnings: &[Problem]) {
    let active = Family::<[(&'static str, String); 2], Gauge>::default();
    for problem in status.problems.iter().chain(warnings) {
        let severity = if problem.severity == Level::Bad { "bad" } else { "check" };
        active.get_or_create(&[("code", problem.code().to_owned()), ("severity", severity.to_owned())]).inc();
    }
    registry.register("problem", "Number of current problems, by code and severity", active);
}

fn add_run(registry: &mut Registry, status: &Status) {
    let Some(run) = &status.run else { return };
    let mut figures = vec![
        (
            "run_cycles_taken",
            "Cycles since the run began, including those that are not written yet",
            run.cycles_taken as f64,
        ),
        ("run_cycles_synced", "Cycles safe on disk", run.cycles as f64),
        ("run_cycles_valid", "Cycles safe on disk in which every encoder is valid", run.cycles_valid as f64),
        ("run_cycles_lost", "Cycles lost between bus and file", run.cycles_lost as f64),
        ("run_file_bytes", "Length of the file", run.bytes as f64),
        ("run_unsynced_seconds", "Duration of cycles that a power failure would lose", run.unsynced_s),
    ];
    if let Some(timing) = &run.timing {
        let seconds = |ns: u64| ns as f64 * 1e-9;
        let (p99_s, max_s) = (seconds(timing.lateness.p99_ns), seconds(timing.lateness.max_ns));
        figures.push(("run_late_p99_seconds", "99th percentile of the lateness of wake-ups", p99_s));
        figures.push(("run_late_max_seconds", "Largest lateness of a wake-up", max_s));
    }
    for (name, help, value) in figures {
        add(registry, name, help, value);
    }
}

fn add_joints(registry: &mut Registry, joints: &[Joint]) {
    type OfJoint = Family<[(&'static str, String); 1], Gauge<f64, AtomicU64>>;
    let (angle, good) = (OfJoint::default(), OfJoint::default());
    for joint in joints {
        let label = [("joint", joint.joint.to_string())];
        good.get_or_create(&label).set(one_if(joint.level == Level::Good));
        if let Some(angle_deg) = joint.angle_deg {
            angle.get_or_create(&label).set(angle_deg);
        }
    }
    registry.register("encoder_good", "The encoder gives valid samples: 1, else 0", good);
    registry.register("encoder_angle_degrees", "Angle of the joint, as on the page", angle);
}

fn add(registry: &mut Registry, name: &str, help: &str, value: f64) {
    registry.register(name, help, ConstGauge::new(value));
}

fn one_if(is_true: bool) -> f64 {
    f64::from(u8::from(is_true))
}
