//! What the calibration predicts where no fit has been.

use maud::{Markup, html};
use plotters::prelude::RGBColor;

use super::figures::{HALF, TimeAxis, dots};
use super::plot::{BLUE, COLOURS, GREEN, GREY, Mark, Panel, PlotError, Series};
use super::sections::svg;
use super::{Page, runs};
use crate::evaluate::{Apart, ApartRms, HeldOut, HeldOutStretch};

const BLACK: RGBColor = RGBColor(30, 36, 44);
const RED: RGBColor = COLOURS[5];

pub(super) fn section(page: &Page<'_>) -> Result<Markup, PlotError> {
    let Some(held_out) = page.evidence.held_out.as_ref().filter(|held_out| !held_out.stretches.is_empty())
    else {
        return Ok(html! {});
    };
    let mut figures = Vec::new();
    for (number, name) in runs::names(page).iter().enumerate() {
        let stretches: Vec<&HeldOutStretch> =
            held_out.stretches.iter().filter(|stretch| stretch.run == number).collect();
        figures.push((name.clone(), panels(&stretches, page.evidence.rotations)?));
    }
    let [nominal, predicted, fitted] = held_out.rms();
    Ok(html! {
        h2 { "Held-out validation" }
        p {
            "Each of " (held_out.stretches.len()) " stretches of time was predicted from a fit to all others. Robot against bar "
            "there, RMS: " (position(nominal)) " mm with the nominal robot, " b { (position(predicted)) " mm" }
            " with the calibrated one (" (position(fitted)) " mm where the fit has seen the stretch)"
            @if page.evidence.rotations {
                "; in rotation " (rotation(nominal)) " mrad, " b { (rotation(predicted)) " mrad" } " (" (rotation(fitted)) " mrad)"
            }
            ". "
            @if held_out.undetermined > 0 {
                (held_out.undetermined) " more cannot be left out: without them the parameters are not determined."
            }
        }
        @for (name, panels) in figures {
            figure {
                @if let Some(name) = &name { p.run { (name) } }
                div.panels { @for panel in panels { (svg(panel)) } }
            }
        }
        p.note {
            "Dots are samples, lines the RMS of each stretch: black as predicted without it, red as fitted with it. Mind the "
            "scales: left the nominal robot, the bar's place and encoder zeros fitted to the other stretches; right the "
            "calibrated one. Which errors of the axes the model has was decided on the whole run."
        }
        (table(page, held_out))
    })
}

fn position(rms: ApartRms) -> String {
    format!("{:.4}", rms.position_m * 1e3)
}

fn rotation(rms: ApartRms) -> String {
    format!("{:.4}", rms.rotation_rad * 1e3)
}

/// Position and rotation, nominal and predicted, stretches in turns of colour.
fn panels(stretches: &[&HeldOutStretch], rotations: bool) -> Result<Vec<String>, PlotError> {
    let position = |one: &Apart| one.position_m * 1e3;
    let rotation = |one: &Apart| one.rotation_rad * 1e3;
    let mut panels = vec![
        panel("Position, nominal", "[mm]", stretches, false, position)?,
        panel("Position, calibrated without the stretch", "[mm]", stretches, true, position)?,
    ];
    if rotations {
        panels.push(panel("Rotation, nominal", "[mrad]", stretches, false, rotation)?);
        panels.push(panel("Rotation, calibrated without the stretch", "[mrad]", stretches, true, rotation)?);
    }
    Ok(panels)
}

fn panel(
    title: &str,
    y: &str,
    stretches: &[&HeldOutStretch],
    calibrated: bool,
    value: impl Fn(&Apart) -> f64,
) -> Result<String, PlotError> {
    let time = TimeAxis::of(stretches.iter().flat_map(|stretch| stretch.span_s()));
    let mut series = Vec::new();
    for turn in 0..2 {
        let samples = stretches.iter().skip(turn).step_by(2).flat_map(|stretch| shown(stretch, calibrated));
        let points = samples.map(|one| (time.at(one.t_s), value(one))).collect();
        let colour = match (calibrated, turn) {
            (false, 0) => GREY,
            (false, _) => RGBColor(196, 202, 210),
            (true, 0) => BLUE,
            (true, _) => GREEN,
        };
        series.push(dots("", colour, points));
    }
    let level = |of: fn(&HeldOutStretch) -> &Vec<Apart>| {
        let ends = stretches.iter().flat_map(|stretch| {
            let rms = crate::evaluate::rms(of(stretch).iter().map(&value));
            stretch.span_s().map(|t_s| (time.at(t_s), rms))
        });
        ends.collect::<Vec<(f64, f64)>>()
    };
    if calibrated {
        series.push(Series::new("", RED, Mark::Segments, level(|stretch| &stretch.fitted)));
        series.push(Series::new("", BLACK, Mark::Segments, level(|stretch| &stretch.predicted)));
    } else {
        series.push(Series::new("", BLACK, Mark::Segments, level(|stretch| &stretch.nominal)));
    }
    Panel { title: title.into(), x: time.label, y: y.into(), size: HALF, series, from_zero: true }.draw()
}

fn shown(stretch: &HeldOutStretch, calibrated: bool) -> &[Apart] {
    if calibrated { &stretch.predicted } else { &stretch.nominal }
}

fn table(page: &Page<'_>, held_out: &HeldOut) -> Markup {
    let several = page.evidence.runs.len() > 1;
    let spans = held_out.stretches.iter().flat_map(|stretch| stretch.span_s());
    let time = TimeAxis::of(spans);
    html! {
        table {
            caption { "RMS on each stretch: nominal, calibrated without it, fitted with it" }
            thead { tr {
                @if several { th { "run" } }
                th { "from [" (time.unit) "]" } th { "to" } th { "samples" }
                th { "position [mm]" } th { "without" } th { "with" }
                @if page.evidence.rotations { th { "rotation [mrad]" } th { "without" } th { "with" } }
            } }
            tbody { @for stretch in &held_out.stretches {
                @let [from, to] = stretch.span_s().map(|t_s| time.at(t_s));
                @let figures = stretch.rms();
                tr {
                    @if several { td { (stretch.run + 1) } }
                    td { (format!("{from:.1}")) } td { (format!("{to:.1}")) } td { (stretch.fitted.len()) }
                    @for rms in figures { td { (position(rms)) } }
                    @if page.evidence.rotations { @for rms in figures { td { (rotation(rms)) } } }
                }
            } }
        }
    }
}
