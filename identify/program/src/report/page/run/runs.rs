//! What each run shows by itself: residuals over time, alignment, preparation.

use std::path::Path;

use maud::{Markup, html};

use super::preparation;
use crate::report::page::Page;
use crate::report::page::drawing::figures;
use crate::report::page::drawing::plot::PlotError;
use crate::report::page::sections::svg;

/// Name of each run where there are several, with that of its file.
pub(in crate::report::page) fn names(page: &Page<'_>) -> Vec<Option<String>> {
    let count = page.evidence.runs.len();
    let files: Vec<&Path> = page
        .file
        .inputs
        .iter()
        .filter(|input| input.role == "recording")
        .map(|input| input.path.as_path())
        .collect();
    let name = |number: usize| {
        let run = format!("Run {} of {count}", number + 1);
        (count > 1)
            .then(|| files.get(number).map_or(run.clone(), |file| format!("{run}: {}", file.display())))
    };
    (0..count).map(name).collect()
}

/// Title of a section, with the run's name where there are several.
pub(in crate::report::page) fn title(what: &str, name: Option<&String>) -> Markup {
    html! { h2 { (what) @if let Some(name) = name { span.run { " · " (name) } } } }
}

/// Residuals over time of all runs.
pub(in crate::report::page) fn gaps(page: &Page<'_>) -> Result<Markup, PlotError> {
    let mut shown = Vec::new();
    for (run, name) in page.evidence.runs.iter().zip(names(page)) {
        let distances = figures::gap_over_time(run, page.evidence.by_encoders)?;
        let components = if page.evidence.by_encoders {
            figures::components_over_time(run, page.evidence.rotations)?
        } else {
            Vec::new()
        };
        shown.push((name, distances, components));
    }
    Ok(html! {
        h2 { "Residuals over time" }
        p.note { "Distance between the robot's end and the bar's at each sample that was used. Mind the scales." }
        @for (name, distances, components) in shown {
            figure {
                @if let Some(name) = name { p.run { (name) } }
                @for distance in distances { (svg(distance)) }
            }
            @if !components.is_empty() {
                figure {
                    div.panels { @for panel in components { (svg(panel)) } }
                    figcaption { "The same at the solution by component, in the robot's base frame." }
                }
            }
        }
    })
}

/// Alignment and preparation, run by run.
pub(in crate::report::page) fn alignments(page: &Page<'_>) -> Result<Markup, PlotError> {
    let mut all = Vec::new();
    for (number, name) in names(page).iter().enumerate() {
        all.push(alignment(page, number, name.as_ref())?);
        let Some((prepared, _)) = page.calibration.bar_runs().nth(number) else { continue };
        all.push(title("Preparation", name.as_ref()));
        all.push(preparation::section(prepared)?);
    }
    Ok(html! { @for one in all { (one) } })
}

fn alignment(page: &Page<'_>, number: usize, name: Option<&String>) -> Result<Markup, PlotError> {
    let Some((run, (prepared, _))) =
        page.evidence.runs.get(number).zip(page.calibration.bar_runs().nth(number))
    else {
        return Ok(html! {});
    };
    let wide = figures::shift("Gap against time shift", &run.shift_wide)?;
    let near = figures::shift("Near the minimum", &run.shift_near)?;
    let shifts = &prepared.local_shifts;
    let along = if shifts.is_empty() { None } else { Some(figures::local_shifts(shifts)?) };
    let alignment = &prepared.alignment;
    Ok(html! {
        (title("Alignment of the two logs", name))
        p {
            "The logs overlap for " (format!("{:.1}", alignment.overlap_s)) " s. Joint speeds correlate to "
            (format!("{:.4}", alignment.correlation)) " (next best shift " (format!("{:.3}", alignment.runner_up)) "). "
            @if let Some(clock) = page.file.clocks.iter().find(|clock| clock.data_set == number + 1) {
                "Clocks: " (clock.difference()) ". "
            }
            @if let Some(minimum_s) = run.shift_near.minimum_s {
                "The gap is smallest " (format!("{:+.1}", minimum_s * 1e6)) " us from the solution."
            }
        }
        figure {
            div.panels.three { (svg(wide)) (svg(near)) @if let Some(along) = along { (svg(along)) } }
            figcaption {
                "Everything but the time shift as in the solution. "
                @if !shifts.is_empty() {
                    "Right: the shift that each part of the run asks for by itself, from that of the whole run, as the "
                    "preparation saw it."
                }
            }
        }
    })
}
