//! Held-out validation of runs with a bar: each segment as predicted by a fit to the others, in text, figures and a table.

use maud::{Markup, html};
use plotters::prelude::RGBColor;

use super::Page;
use super::drawing::figures::{HALF, TimeAxis, dots};
use super::drawing::plot::{BLUE, COLOURS, GREEN, GREY, Mark, Panel, PlotError, Series};
use super::run::runs;
use crate::evaluate::{HeldOut, HeldOutSegment, PoseError, PoseErrorRms};

const BLACK: RGBColor = RGBColor(30, 36, 44);
const RED: RGBColor = COLOURS[5];

pub(super) fn section(page: &Page<'_>) -> Result<Markup, PlotError> {
    let Some(held_out) = page.evidence.held_out.as_ref().filter(|held_out| !held_out.segments.is_empty())
    else {
        return Ok(html! {});
    };
    let [nominal, predicted, fitted] = held_out.rms();
    Ok(html! {
        h2 { "Held-out validation" }
        p {
            "Each of " (held_out.segments.len()) " segments of time was predicted from a fit to all others. Robot against bar "
            "there, RMS: " (position(nominal)) " mm with the nominal robot, " b { (position(predicted)) " mm" }
            " with the calibrated one (" (position(fitted)) " mm in the fit with this segment)"
            @if page.evidence.rotations {
                "; in rotation " (rotation(nominal)) " mrad, " b { (rotation(predicted)) " mrad" } " (" (rotation(fitted)) " mrad)"
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
                div.panels { (panels(held_out, number, page.evidence.rotations)?) }
            }
        }
        p.note {
            "Dots are samples, lines the RMS of each segment: black as predicted without it, red as fitted with it. Mind the "
            "scales: left the nominal robot, the bar's place and encoder offsets fitted to the other segments; right the "
            "calibrated one. Which errors of the axes the model has was decided on the whole run."
        }
        (table(page, held_out))
    })
}

fn position(rms: PoseErrorRms) -> String {
    format!("{:.4}", rms.position_m * 1e3)
}

fn rotation(rms: PoseErrorRms) -> String {
    format!("{:.4}", rms.rotation_rad * 1e3)
}

/// Figures of a run over time: errors in position and rotation, nominal and predicted.
fn panels(held_out: &HeldOut, run: usize, rotations: bool) -> Result<Markup, PlotError> {
    let segments: Vec<&HeldOutSegment> =
        held_out.segments.iter().filter(|segment| segment.run == run).collect();
    let position = |one: &PoseError| one.position_m * 1e3;
    let rotation = |one: &PoseError| one.rotation_rad * 1e3;
    Ok(html! {
        (panel("Position, nominal", "[mm]", &segments, false, position)?)
        (panel("Position, calibrated without the segment", "[mm]", &segments, true, position)?)
        @if rotations {
            (panel("Rotation, nominal", "[mrad]", &segments, false, rotation)?)
            (panel("Rotation, calibrated without the segment", "[mrad]", &segments, true, rotation)?)
        }
    })
}

/// One figure; `calibrated` selects the prediction in place of the nominal robot.
fn panel(
    title: &str,
    y: &str,
    segments: &[&HeldOutSegment],
    calibrated: bool,
    value: impl Fn(&PoseError) -> f64,
) -> Result<Markup, PlotError> {
    let time = TimeAxis::of(segments.iter().flat_map(|segment| segment.span_s()));
    let mut series = Vec::new();
    // Two series, of even and odd segments, so that neighbours have different colours.
    for parity in 0..2 {
        let samples = segments.iter().skip(parity).step_by(2).flat_map(|segment| shown(segment, calibrated));
        let points = samples.map(|one| (time.at(one.t_s), value(one))).collect();
        let colour = match (calibrated, parity) {
            (false, 0) => GREY,
            (false, _) => RGBColor(196, 202, 210),
            (true, 0) => BLUE,
            (true, _) => GREEN,
        };
        series.push(dots("", colour, points));
    }
    // A horizontal line over each segment at its RMS.
    let rms_lines = |errors: fn(&HeldOutSegment) -> &Vec<PoseError>| {
        let ends = segments.iter().flat_map(|segment| {
            let rms = crate::statistics::rms(errors(segment).iter().map(&value));
            segment.span_s().map(|t_s| (time.at(t_s), rms))
        });
        ends.collect::<Vec<(f64, f64)>>()
    };
    if calibrated {
        series.push(Series::new("", RED, Mark::Segments, rms_lines(|segment| &segment.fitted)));
        series.push(Series::new("", BLACK, Mark::Segments, rms_lines(|segment| &segment.predicted)));
    } else {
        series.push(Series::new("", BLACK, Mark::Segments, rms_lines(|segment| &segment.nominal)));
    }
    Panel::new(title, [&time.label(), y], HALF, series).with_zero().draw()
}

fn shown(segment: &HeldOutSegment, calibrated: bool) -> &[PoseError] {
    if calibrated { &segment.predicted } else { &segment.nominal }
}

fn table(page: &Page<'_>, held_out: &HeldOut) -> Markup {
    let several = page.evidence.runs.len() > 1;
    let spans = held_out.segments.iter().flat_map(|segment| segment.span_s());
    let time = TimeAxis::of(spans);
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
                @let figures = segment.rms();
                tr {
                    @if several { td { (segment.run + 1) } }
                    td { (format!("{from:.1}")) } td { (format!("{to:.1}")) } td { (segment.fitted.len()) }
                    @for rms in figures { td { (position(rms)) } }
                    @if page.evidence.rotations { @for rms in figures { td { (rotation(rms)) } } }
                }
            } }
        }
    }
}
