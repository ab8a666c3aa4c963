//! Section on held-out validation of runs with a bar. Each segment of time was predicted by a fit that does not use it. The
//! section shows the errors as text, figures and a table.

use maud::{Markup, html};
use plotters::prelude::RGBColor;

use super::Page;
use super::drawing::figures::{HALF, TimeAxis, dots};
use super::drawing::plot::{BLUE, COLOURS, GREEN, GREY, Mark, Panel, Series};
use super::run::runs;
use crate::evaluate::{HeldOut, HeldOutSegment};
use crate::instrument::PoseError;

const BLACK: RGBColor = RGBColor(30, 36, 44);
const LIGHT_GREY: RGBColor = RGBColor(196, 202, 210);
const RED: RGBColor = COLOURS[5];

/// Selects the position or the rotation of a pose error, in the unit of figures and tables. Returns `None` if
/// it was not measured.
pub(super) type Value = fn(&PoseError) -> Option<f64>;
pub(super) const POSITION_MM: Value = |error| Some(error.position_m * 1e3);
pub(super) const ROTATION_MRAD: Value = |error| error.rotation_rad.map(|rad| rad * 1e3);

pub(super) fn section(page: &Page<'_>) -> Markup {
    let Some(held_out) = page.evidence.held_out.as_ref().filter(|held_out| !held_out.segments.is_empty())
    else {
        return html! {};
    };
    let rms = held_out.rms();
    html! {
        h2 { "Held-out validation" }
        p {
            "Each of " (held_out.segments.len()) " segments of time was predicted from a fit to all others. Robot against bar "
            "there, RMS: "
            @if let [nominal, predicted, fitted] = &texts(&rms, POSITION_MM)[..] {
                (nominal) " mm with the nominal robot, " b { (predicted) " mm" }
                " with the calibrated one (" (fitted) " mm in the fit with this segment)"
            }
            @if let [nominal, predicted, fitted] = &texts(&rms, ROTATION_MRAD)[..] {
                "; in rotation " (nominal) " mrad, " b { (predicted) " mrad" } " (" (fitted) " mrad)"
            }
            ". "
            @if held_out.undetermined > 0 {
                (held_out.undetermined) " more cannot be left out: without them the parameters are not determined. "
            }
            @let parts = page.file.deployments_reported();
            @if !parts.is_empty() { "If only a part of the model is applied, that part is fitted alone: " (parts.join("; ")) "." }
        }
        @for (number, name) in runs::names(page).iter().enumerate() {
            figure {
                @if let Some(name) = name { p.run { (name) } }
                div.panels { (panels(held_out, number)) }
            }
        }
        p.note {
            "Dots are samples, lines the RMS of each segment: black as predicted without it, red as fitted with it. Mind the "
            "scales: left the nominal robot, the bar's place and encoder offsets fitted to the other segments; right the "
            "calibrated one. Which errors of the axes the model has was decided on the whole run."
        }
        (table(page, held_out))
    }
}

/// RMS values of several errors as text. Rotations that were not measured are left out.
fn texts(rms: &[PoseError; 3], value: Value) -> Vec<String> {
    rms.iter().filter_map(value).map(|value| format!("{value:.4}")).collect()
}

/// Figures of the errors of a run over time, in position and rotation, for the nominal robot and for the prediction.
fn panels(held_out: &HeldOut, run: usize) -> Markup {
    let segments: Vec<&HeldOutSegment> =
        held_out.segments.iter().filter(|segment| segment.run == run).collect();
    let has_rotations = held_out.rms()[0].rotation_rad.is_some();
    html! {
        (panel("Position, nominal", "[mm]", &segments, false, POSITION_MM))
        (panel("Position, calibrated without the segment", "[mm]", &segments, true, POSITION_MM))
        @if has_rotations {
            (panel("Rotation, nominal", "[mrad]", &segments, false, ROTATION_MRAD))
            (panel("Rotation, calibrated without the segment", "[mrad]", &segments, true, ROTATION_MRAD))
        }
    }
}

/// Draws one figure of errors over time: of the prediction by the calibrated robot if `calibrated` is true, otherwise
/// of the nominal robot.
fn panel(title: &str, y: &str, segments: &[&HeldOutSegment], calibrated: bool, value: Value) -> Markup {
    let time = TimeAxis::spanning(segments.iter().flat_map(|segment| segment.span_s()));
    // Indices of the stages of a segment: 0 nominal, 1 predicted without the segment, 2 fitted with the segment.
    // Neighbouring segments have different colours.
    let (stage, colours) = if calibrated { (1, [BLUE, GREEN]) } else { (0, [GREY, LIGHT_GREY]) };
    let alternate = (0..).zip(colours).map(|(first, colour)| {
        let samples = segments.iter().skip(first).step_by(2).flat_map(|segment| &segment.stages[stage]);
        dots("", colour, samples.filter_map(|(t_s, error)| Some((time.at(*t_s), value(error)?))).collect())
    });
    // A horizontal line over each segment, at the RMS of its errors.
    let rms_lines = |(stage, colour): (usize, RGBColor)| {
        let ends = segments.iter().filter_map(|segment| {
            let rms = value(&segment.rms()[stage])?;
            Some(segment.span_s().map(|t_s| (time.at(t_s), rms)))
        });
        Series::new("", colour, Mark::Segments, ends.flatten().collect())
    };
    let lines: &[(usize, RGBColor)] = if calibrated { &[(2, RED), (1, BLACK)] } else { &[(0, BLACK)] };
    let series = alternate.chain(lines.iter().copied().map(rms_lines)).collect();
    Panel::new(title, [&time.label(), y], HALF, series).with_zero().draw()
}

fn table(page: &Page<'_>, held_out: &HeldOut) -> Markup {
    let several = page.evidence.runs.len() > 1;
    let spans = held_out.segments.iter().flat_map(|segment| segment.span_s());
    let time = TimeAxis::spanning(spans);
    html! {
        table {
            caption { "RMS on each segment: nominal, calibrated without it, fitted with it" }
            thead { tr {
                @if several { th { "run" } }
                th { "from [" (time.unit) "]" } th { "to" } th { "samples" }
                th { "position [mm]" } th { "without" } th { "with" }
                @if page.evidence.rotations { th { "rotation [mrad]" } th { "without" } th { "with" } }
            } }
            tbody { @for segment in &held_out.segments {
                @let [from, to] = segment.span_s().map(|t_s| time.at(t_s));
                @let rms = segment.rms();
                tr {
                    @if several { td { (segment.run + 1) } }
                    td { (format!("{from:.1}")) } td { (format!("{to:.1}")) } td { (segment.stages[2].len()) }
                    @for value in [POSITION_MM, ROTATION_MRAD] { @for text in texts(&rms, value) { td { (text) } } }
                }
            } }
        }
    }
}
