//! The first sheet of the page: what an engineer signs. One A4, results in the words of ISO 9283 with the uncertainty of the GUM.

use maud::{Markup, html};

use super::sections::mm;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::{CubeError, Expected, WorkspaceError};
use crate::report::result::file::{CalibrationFile, MeasurementEntry, ParameterEntry, Status};
use crate::report::verdict::Grade;

/// What is certified of a calibration, whatever it was measured with.
pub(super) fn certificate(file: &CalibrationFile, workspace: &WorkspaceError) -> Markup {
    html! {
        section.certificate {
            header {
                h1 { "Calibration of " (file.robot) }
                p.about { "Certificate · " (to_the_second(&file.created)) " · " (file.software) }
            }
            (verdict(file, workspace))
            (identity(&file.robot, &file.instrument, &file.measured, Some(required(file))))
            (results(file, workspace))
            (conditions(file))
            (signature())
        }
    }
}

/// Whether it is calibrated, and the one reason for doubt.
fn verdict(file: &CalibrationFile, workspace: &WorkspaceError) -> Markup {
    let verdict = file.verdict.as_ref();
    let class = match verdict.map(|verdict| verdict.grade) {
        Some(Grade::Red) => "verdict refused",
        Some(Grade::Amber) => "verdict doubt",
        Some(Grade::Green) | None => "verdict",
    };
    let red = verdict.is_some_and(|verdict| verdict.grade == Grade::Red);
    html! { div class=(class) {
        strong { @if red { "Not calibrated. " } @else { "Calibrated. " } }
        @if let Some(reason) = verdict.and_then(|verdict| verdict.reason.as_ref()) { b { (reason) } " " }
        @else if let Some(required_m) = verdict.and_then(|verdict| verdict.required_m) {
            "The required " (mm(required_m)) " mm are met. "
        }
        @if red { "Nothing of it may be applied." } @else {
            @if let Some([nominal_m, calibrated_m]) = file.held_out_m(Deployment::Full) {
                "On data that no fit has seen the robot is off by " b { (mm(calibrated_m)) " mm" } " (RMS) instead of "
                b { (mm(nominal_m)) " mm" } ". "
            }
            "The position error that is expected of the geometry alone falls from "
            b { (mm(workspace.before.mean_m)) " mm" } " to " b { (mm(workspace.after.mean_m)) " mm" }
            " in the mean over the workspace."
        }
    } }
}

/// An instant of a file for a person.
pub(super) fn to_the_second(utc: &str) -> String {
    utc.get(..19).map_or_else(|| utc.to_owned(), |second| format!("{} UTC", second.replace('T', " ")))
}

/// Robot, instrument, who and when: what no file says is left to be written by hand.
pub(super) fn identity(
    robot: &str,
    instrument: &str,
    measured: &[MeasurementEntry],
    required: Option<String>,
) -> Markup {
    let of = |what: fn(&MeasurementEntry) -> String| {
        let mut all: Vec<String> = measured.iter().map(what).collect();
        all.retain(|one| !one.is_empty());
        all.dedup();
        all.join("; ")
    };
    let lines = [
        ("Robot", Some(robot.to_owned())),
        ("Which one (serial number)", Some(of(|one| one.robot.clone()))),
        ("Instrument", Some(instrument.to_owned())),
        ("Which one (serial number)", Some(of(|one| one.bar.clone()))),
        ("Measured", Some(of(|one| to_the_second(&one.started)))),
        ("Operator", Some(of(|one| one.operator.clone()))),
        ("Payload", Some(of(|one| one.payload.clone()))),
        ("Required", required),
    ];
    html! { dl.identity { @for (what, value) in &lines { @if let Some(value) = value {
        dt { (what) }
        dd.blank[value.is_empty()] { (value) }
    } } } }
}

fn required(file: &CalibrationFile) -> String {
    let required = file.verdict.as_ref().and_then(|verdict| verdict.required_m);
    required.map_or("none stated".into(), |required_m| {
        format!(
            "position error of at most {} mm in 95 % of the workspace and on held-out data",
            mm(required_m)
        )
    })
}

/// Before and after: expected, at the standard's poses, and on data that no fit has seen.
fn results(file: &CalibrationFile, workspace: &WorkspaceError) -> Markup {
    let expected = |what: &str, before: &Expected, after: &Expected| {
        html! {
            tr { td.text { (what) ", mean" } td { (mm(before.mean_m)) } td { (mm(after.mean_m)) } td { "mm" } }
            tr { td.text { "95 % of it below" } td { (mm(before.p95_m)) } td { (mm(after.p95_m)) } td { "mm" } }
        }
    };
    html! {
        table {
            thead { tr { th.text { "position error" } th { "nominal" } th { "calibrated" } th { "" } } }
            tbody {
                (expected("Expected over the workspace", &workspace.before, &workspace.after))
                @if let Some(CubeError { edge_m, centre_m, before, after }) = &workspace.cube {
                    (expected(
                        &format!(
                            "Pose accuracy expected at the five poses of ISO 9283, cube of {:.0} mm at ({:.0}, {:.0}, {:.0}) mm",
                            edge_m * 1e3, centre_m[0] * 1e3, centre_m[1] * 1e3, centre_m[2] * 1e3
                        ),
                        before,
                        after,
                    ))
                }
                @for one in file.predicted() { tr {
                    td.text { (one.what) ", no fit has seen them, RMS" }
                    td { (mm(one.nominal)) } td { (mm(one.calibrated)) } td { (one.unit) }
                } }
                @if let Some(budget) = &file.budget { tr {
                    td.text { "Expanded uncertainty of a position by the calibrated geometry, RMS over the workspace, k = "
                        (budget.coverage_factor) }
                    td { "" } td { b { (mm(budget.expanded_m)) } } td { "mm" }
                } }
            }
        }
        p.note {
            "Expected: nominal against identified geometry where the instrument was mounted, and what the uncertainty of that geometry "
            "leaves. Errors that do not depend on it (gears, load, temperature) come on top; data that no fit has seen have them."
        }
    }
}

/// Where it holds, for whom, and on what it rests.
fn conditions(file: &CalibrationFile) -> Markup {
    let parts = file.deployments_reported();
    let held = |entry: &&ParameterEntry| entry.status == Status::Fixed;
    let (held, exact): (Vec<&ParameterEntry>, Vec<&ParameterEntry>) =
        file.parameters.iter().filter(held).partition(|entry| entry.sigma.is_some());
    let names =
        |entries: &[&ParameterEntry]| entries.iter().map(|entry| entry.held()).collect::<Vec<_>>().join(", ");
    html! {
        dl.conditions {
            @if let Some(validity) = &file.validity {
                dt { "Supported [deg]" } dd { "where the joints were measured: " (validity) }
            }
            @if !parts.is_empty() {
                dt { "In parts" }
                dd {
                    "Who applies only part of it needs another geometry, which is in files of its own; on the same held-out data: "
                    (parts.join("; ")) ". Held-out data were predicted by fits without them; what is in the files is fitted to all."
                }
            }
            @if !held.is_empty() { dt { "Held within" } dd { (names(&held)) } }
            @if !exact.is_empty() { dt { "Taken as exact" } dd { (names(&exact)) } }
        }
    }
}

/// Lines for who answers for it.
pub(super) fn signature() -> Markup {
    html! { dl.signature {
        @for what in ["Place and date", "Name", "Signature"] { dt { (what) } dd.blank {} }
    } }
}
