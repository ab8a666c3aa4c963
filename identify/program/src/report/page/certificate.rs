//! The certificate is the first sheet of the page. It fills one A4 sheet and is signed by an engineer. Results are in the
//! terms of ISO 9283, with uncertainties by the GUM.

use chrono::{DateTime, Datelike};
use maud::{Markup, html};

use super::drawing::workspace;
use super::sections::mm;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::{CubeError, Expected, WorkspaceError};
use crate::report::result::deployments::what;
use crate::report::result::file::{CalibrationFile, MeasurementEntry, ParameterEntry};
use crate::report::verdict::Grade;

/// The certificate: verdict, identity of robot and instrument, errors before and after, map, conditions and signature.
pub(super) fn certificate(file: &CalibrationFile, workspace: &WorkspaceError) -> Markup {
    let body = html! {
        header {
            h1 { "Calibration of " (file.robot) }
            p.about { "Certificate · " (to_the_second(&file.created)) " · " (file.software) }
        }
        (verdict(file, workspace))
        (identity(&file.robot, &file.instrument, &file.measured, Some(required(file)), dated(file)))
        (results(file, workspace))
        (workspace::map(workspace))
        (conditions(file))
        dl.signature { @for what in ["Place and date", "Name", "Signature"] { dt { (what) } dd.blank {} } }
    };
    sheet(file.is_simulated(), &body)
}

/// Wraps the content of the first sheet. If the data were simulated, a band across the sheet reports this, on the
/// screen and in print.
pub(super) fn sheet(simulated: bool, content: &Markup) -> Markup {
    html! {
        section.certificate.simulated[simulated] {
            @if simulated { div.band { "SIMULATED" small { "no robot was measured" } } }
            (content)
        }
    }
}

/// Date of the measurement according to the instrument's clock, to be used if no recording contains a date. `None` if no
/// clock has a date.
fn dated(file: &CalibrationFile) -> Option<String> {
    let mut dates = file.clocks.iter().map(|clock| clock.reference_utc.as_str());
    // The text of a clock without a date is a number of seconds. In files of earlier versions it is a time in 1970.
    let is_date = |text: &&str| DateTime::parse_from_rfc3339(text).is_ok_and(|date| date.year() > 1970);
    dates.find(is_date).map(to_the_second)
}

/// Paragraph with the verdict: whether the robot is calibrated, its errors, and the reason that limits the verdict.
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
        @if let Some([nominal_m, calibrated_m]) = file.held_out_m(Deployment::Full) {
            b { (mm(calibrated_m)) " mm" } " RMS on held-out data, " b { (mm(nominal_m)) " mm" } " with the nominal robot. "
        }
        @if let Some(reason) = verdict.and_then(|verdict| verdict.reason.as_ref()) { b { (reason) } " " }
        @else if let Some(required_m) = verdict.and_then(|verdict| verdict.required_m) {
            "The required " (mm(required_m)) " mm are met. "
        }
        @if red { "Nothing of it may be applied." } @else {
            "The expected position error falls from "
            b { (mm(workspace.before.mean_m)) " mm" } " to " b { (mm(workspace.after.mean_m)) " mm" }
            " in the mean over the workspace."
        }
    } }
}

/// An RFC 3339 time without fractions of a second, for display.
pub(super) fn to_the_second(utc: &str) -> String {
    utc.get(..19).map_or_else(|| utc.to_owned(), |second| format!("{} UTC", second.replace('T', " ")))
}

/// Lists robot, instrument, operator and time. An unknown item is a blank line to be filled in by hand. `dated` is the date
/// of the measurement if no recording contains the date.
pub(super) fn identity(
    robot: &str,
    instrument: &str,
    measured: &[MeasurementEntry],
    required: Option<String>,
    dated: Option<String>,
) -> Markup {
    // Joins the values of one field in all measurements to one text.
    let field = |value: fn(&MeasurementEntry) -> String| {
        let mut values: Vec<String> = measured.iter().map(value).collect();
        values.retain(|value| !value.is_empty());
        values.dedup();
        values.join("; ")
    };
    // A text that only repeats the line above does not identify the device, so this line is blank.
    let recorded = |text: String, above: &str| {
        if text.eq_ignore_ascii_case(above) { String::new() } else { text }
    };
    let started = Some(field(|one| to_the_second(&one.started))).filter(|started| !started.is_empty());
    let lines = [
        ("Robot", Some(robot.to_owned())),
        ("Robot: name or serial number", Some(recorded(field(|one| one.robot.clone()), robot))),
        ("Instrument", Some(instrument.to_owned())),
        ("Instrument: name or serial number", Some(recorded(field(|one| one.bar.clone()), instrument))),
        ("Measured", Some(started.or(dated).unwrap_or_default())),
        ("Operator", Some(field(|one| one.operator.clone()))),
        ("Payload", Some(field(|one| one.payload.clone()))),
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

/// Position errors with the nominal and the calibrated robot: expected over the workspace, expected at the poses of ISO 9283,
/// and measured on held-out data.
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
                @for (deployment, one) in file.deployments_expected(workspace) { tr {
                    td.text { "The same with " (what(deployment)) ", mean" }
                    td { (mm(workspace.before.mean_m)) } td { (mm(one.mean_m)) } td { "mm" }
                } }
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
                    td.text { (one.what) ", not used in the fit, RMS" }
                    td { (mm(one.nominal)) } td { (mm(one.calibrated)) } td { (one.unit) }
                } }
                @if let Some(budget) = &file.budget { tr {
                    td.text { "Expanded uncertainty of a position by the calibrated robot, RMS over the workspace, k = "
                        (budget.coverage_factor) }
                    td { "" } td { b { (mm(budget.expanded_m)) } } td { "mm" }
                } }
            }
        }
        p.note {
            "Expected: nominal against identified robot where the instrument was mounted, at rest, and what the uncertainty of its links "
            "and of the errors of its joints leaves. Other errors (temperature, other loads) come on top; the errors on held-out data "
            "include them."
        }
    }
}

/// Lists the measured length that determines the scale, the supported joint ranges, the deployments
/// and the fixed parameters.
fn conditions(file: &CalibrationFile) -> Markup {
    let parts = file.deployments_reported();
    let [exact, held] = ParameterEntry::fixed(&file.parameters);
    html! {
        dl.conditions {
            @if let Some(scale) = &file.scale { dt { "Scale rests on" } dd { (scale) } }
            @if let Some(validity) = &file.validity {
                dt { "Supported [deg]" } dd { "where the joints were measured: " (validity) }
            }
            @if !parts.is_empty() {
                dt { "In parts" }
                dd {
                    "A controller that applies only part of the model needs another geometry, in separate files; on the same "
                    "held-out data: " (parts.join("; ")) ". Held-out data were predicted by fits without them; what is in the files is fitted to all."
                }
            }
            @if !held.is_empty() { dt { "Held within" } dd { (held.join(", ")) } }
            @if !exact.is_empty() { dt { "Taken as exact" } dd { (exact.join(", ")) } }
        }
    }
}
