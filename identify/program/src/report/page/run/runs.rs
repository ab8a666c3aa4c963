//! Sections about each run: residuals over time, time alignment, and preparation.

use maud::{Markup, html};

use super::preparation;
use crate::evaluate::{Evidence, RunEvidence};
use crate::prepare::Prepared;
use crate::report::page::Page;
use crate::report::page::drawing::figures;

/// Name of each run or part of a run, with the path of its recording. `None` if there is only one.
pub(in crate::report::page) fn names(page: &Page<'_>) -> Vec<Option<String>> {
    let count = page.evidence.runs.len();
    let recordings = page.sources.iter().filter(|source| source.role == "recording");
    let mut files = recordings.map(|source| format!(": {}", source.path.display()));
    let mut name = |number| format!("Run {number} of {count}{}", files.next().unwrap_or_default());
    (1..=count).map(|number| (count > 1).then(|| name(number))).collect()
}

/// Title of a section, with the run's name if there is one.
pub(in crate::report::page) fn title(what: &str, name: Option<&String>) -> Markup {
    html! { h2 { (what) @if let Some(name) = name { span.run { " · " (name) } } } }
}

/// Figures of the residuals over time, for all runs.
pub(in crate::report::page) fn gaps(page: &Page<'_>) -> Markup {
    let Evidence { runs, by_encoders, rotations, .. } = page.evidence;
    html! {
        h2 { "Residuals over time" }
        p.note { "Distance between the robot's end and the bar's at each sample that was used. The scales differ." }
        @for (run, name) in runs.iter().zip(names(page)) {
            figure {
                @if let Some(name) = name { p.run { (name) } }
                @for distance in figures::gap_over_time(run, *by_encoders) { (distance) }
            }
            @if *by_encoders {
                figure {
                    div.panels { @for panel in figures::components_over_time(run, *rotations) { (panel) } }
                    figcaption { "The same at the solution by component, in the robot's base frame." }
                }
            }
        }
    }
}

/// Sections on time alignment and preparation of each run.
pub(in crate::report::page) fn alignments(page: &Page<'_>) -> Markup {
    let runs = page.evidence.runs.iter().zip(page.calibration.bar_runs()).zip(names(page));
    html! {
        @for (number, ((run, (prepared, _)), name)) in runs.enumerate() {
            (title("Alignment of the two logs", name.as_ref()))
            (alignment(page, number, run, prepared))
            (title("Preparation", name.as_ref()))
            (preparation::section(prepared))
        }
    }
}

/// Time alignment of the logs of a run: correlation, clocks, and figures of the residual over an additional time shift.
fn alignment(
    page: &Page<'_>,
    number: usize,
    run: &RunEvidence,
    Prepared { alignment, local_shifts, .. }: &Prepared,
) -> Markup {
    html! {
        p {
            "The logs overlap for " (format!("{:.1}", alignment.overlap_s)) " s. Joint speeds correlate to "
            (format!("{:.4}", alignment.correlation)) " (next best shift " (format!("{:.3}", alignment.runner_up)) "). "
            @if let Some(clock) = page.file.clocks.iter().find(|clock| clock.data_set == number + 1) {
                "Clocks: " (clock.difference()) ". "
            }
            @if let Some(minimum_s) = run.shift_near.minimum_s {
                "The gap is smallest at a shift " (format!("{:+.1}", minimum_s * 1e6)) " us from that of the solution."
            }
        }
        figure {
            div.panels.three {
                (figures::shift("Gap against time shift", &run.shift_wide))
                (figures::shift("Near the minimum", &run.shift_near))
                @if !local_shifts.is_empty() { (figures::local_shifts(local_shifts)) }
            }
            figcaption {
                "All other parameters as in the solution. "
                @if !local_shifts.is_empty() {
                    "Right: the shift of each part of the run alone, minus that of the whole run, as the preparation "
                    "estimated it."
                }
            }
        }
    }
}
