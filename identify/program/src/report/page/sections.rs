//! Sections of the page that have no module of their own, in the order of the page: numbers, bar, parameters, uncertainty
//! budget, tried terms, residuals by joint, coverage, correlations, inputs. Also the formats of numbers on all pages.

use maud::{Markup, PreEscaped, Render, html};
use shared::config::BallBarConfig;
use shared::drawing::ball_bar;

use super::drawing::{correlations, figures};
use super::{Page, rows};
use crate::evaluate::{Evaluation, Expected};
use crate::model::{Owner, ParameterId};
use crate::report::result::file::{CalibrationFile, InputFile, ParameterEntry, ParameterStatus, ReadIn};
use crate::report::summary::not_separated;
use crate::report::table::about_links;
use crate::statistics::Sizes;

/// A length in mm, rounded to 1 um, or to 0.1 um if it is below 0.1 mm.
pub(super) fn mm(metres: f64) -> String {
    let mm = metres * 1e3;
    if mm.abs() < 0.1 { format!("{mm:.4}") } else { format!("{mm:.3}") }
}

/// A number with four digits after the point, or with an exponent if it is small or large.
pub(super) fn figure(value: f64) -> String {
    if (0.01..1e4).contains(&value) { format!("{value:.4}") } else { format!("{value:.3e}") }
}

/// A large number with its explanation.
pub(super) fn number(value: impl Render, label: impl Render) -> Markup {
    html! { div.number { b { (value) } span { (label) } } }
}

/// An expected error over the workspace as a large number, with its interval and quantile.
fn expected(label: &str, Expected { mean_m, interval_m, p95_m, .. }: &Expected) -> Markup {
    let ([low, high], p95) = (interval_m.map(mm), mm(*p95_m));
    let label = format!(
        "{label}, mean over the workspace; 95 % interval {low} to {high} mm; 95 % of all postures below {p95} mm"
    );
    number(mm(*mean_m) + " mm", label)
}

/// The limits of the calibration, then large numbers: expected errors over the workspace, distances between robot and bar,
/// and errors on held-out rows.
pub(super) fn numbers(page: &Page<'_>) -> Markup {
    let expected_errors = &page.evidence.workspace;
    let (before, after) = (&expected_errors.before, &expected_errors.after);
    let gap = |label: &str, gap: &Sizes| {
        let [median, p95, max] = [gap.median, gap.p95, gap.max].map(mm);
        let label = format!("robot against bar, {label}; median {median}, 95 % {p95}, largest {max} mm");
        number(mm(gap.mean) + " mm", label)
    };
    html! {
        h2 { "Before and after" }
        @if page.file.other_limits().next().is_some() {
            ul { @for limit in page.file.other_limits() { li { (limit.sentence) } } }
        }
        div.numbers {
            (expected("before", before))
            (expected("after", after))
            @if !page.evidence.runs.is_empty() {
                (gap("nominal", &page.evidence.gap_before_m))
                (gap("calibrated", &page.evidence.gap_after_m))
            }
            (rows::numbers(page))
        }
        p.note {
            "Before: nominal against identified geometry at the point where the bar is bolted on, or at the flange, over all postures "
            "within the joint limits, so also where nothing was measured. After: what the covariance of the parameters leaves there. "
            "Errors that do not depend on the geometry (gears, load, temperature) come on top; what was seen of them is in the other "
            "figures."
        }
    }
}

/// Drawing of the bar of the first run, with the length of the solution.
pub(super) fn bar(page: &Page<'_>) -> Markup {
    let identified = page.file.parameters.iter().find(|entry| entry.id() == Some(ParameterId::ROD));
    html! { @if let Some(bar) = page.bar {
        @let correction_m = identified.map_or(0.0, |entry| entry.correction);
        @let identified = BallBarConfig { length_m: bar.length_m + correction_m, ..bar.clone() };
        h2 { "Ball-bar" }
        figure.bar {
            (PreEscaped(ball_bar(&identified)))
            figcaption {
                (bar.name) @if page.evidence.runs.len() > 1 { " (first run)" } ". The length is that of the solution, "
                (format!("{:+.4}", correction_m * 1e3)) " mm from the configured one; the other lengths are configured. Arrows: "
                "positive directions of the joints."
            }
        }
    } }
}

/// Tables of all parameters. Each table of parameters that belong to one data set has a caption: `first_heading` for the
/// first data set, and `other_headings` for the other data sets.
pub(super) fn parameters(file: &CalibrationFile, first_heading: &str, other_headings: &[String]) -> Markup {
    let applied = file.applied();
    let (entries, waves) = applied.reported();
    let [exact, uncertain] = ParameterEntry::fixed(entries.iter().copied());
    // If a parameter belongs to a later run only, its name contains the number of the run, such as `ox@2`.
    let is_of_run = |entry: &ParameterEntry, run: usize| match entry.name.split_once('@') {
        Some((_, number)) => number.parse() == Ok(run + 1),
        None => run == 0,
    };
    let select = |wanted: &dyn Fn(&ParameterEntry) -> bool| -> Vec<&ParameterEntry> {
        entries
            .iter()
            .copied()
            .filter(|entry| entry.status != ParameterStatus::Fixed && wanted(entry))
            .collect()
    };
    let owner = |entry: &ParameterEntry| entry.id().map(ParameterId::owner);
    // Names of the bar's links, joints and encoders begin with `b`. Names of parameters of the bar's base and clock do not.
    let is_bar = |entry: &ParameterEntry| entry.name.starts_with('b') && owner(entry) == Some(Owner::BallBar);
    let is_place_or_clock = |entry: &ParameterEntry| owner(entry) != Some(Owner::Robot) && !is_bar(entry);
    html! {
        h2 { "Parameters" }
        div.columns {
            (table("Robot", &select(&|entry| owner(entry) == Some(Owner::Robot))))
            (table("Ball-bar and encoders", &select(&|entry| is_bar(entry) && is_of_run(entry, 0))))
            (table(first_heading, &select(&|entry| is_place_or_clock(entry) && is_of_run(entry, 0))))
            @for (run, name) in other_headings.iter().enumerate() {
                (table(name, &select(&|entry| is_of_run(entry, run + 1))))
            }
        }
        p.note {
            (about_links(file)) " "
            @if waves > 0 { (waves) " amplitudes of waves of the axes are in calibration.toml. " }
            "sigma: one standard deviation. (p): data and prior. Fixed at nominal: " (exact.join(", ")) "."
            @if !uncertain.is_empty() {
                " Fixed at nominal, with an uncertainty that is part of all sigmas: " (uncertain.join(", ")) "."
            }
        }
    }
}

/// The contributions to the uncertainty of positions.
pub(super) fn budget(file: &CalibrationFile) -> Markup {
    // Types of evaluation by the GUM.
    let evaluation = |evaluation: Evaluation| match evaluation {
        Evaluation::Statistical => "A",
        Evaluation::Stated => "B",
    };
    html! { @if let Some(budget) = file.budget.as_ref().filter(|budget| budget.u_m > 0.0) {
        h2 { "Uncertainty budget" }
        table {
            thead { tr {
                th.text { "contribution" } th { "type" } th { "u [mm]" } th { "part of the variance" }
            } }
            tbody {
                @for one in &budget.contributions { tr {
                    td.text { (one.source) }
                    td { (evaluation(one.evaluation)) }
                    td { (mm(one.u_m)) }
                    td { (format!("{:.1} %", 100.0 * budget.part(one))) }
                } }
                tr { td.text { b { "combined" } } td { "" } td { b { (mm(budget.u_m)) } } td { "" } }
                tr {
                    td.text { b { "expanded, k = " (budget.coverage_factor) } }
                    td { "" } td { b { (mm(budget.expanded_m)) } } td { "" }
                }
            }
        }
        p.note {
            "Standard uncertainty u of positions of the calibrated robot, root mean square over the workspace (GUM, JCGM 100). "
            "Type A: from the scatter of samples; type B: from stated uncertainties."
            @if let Some(freedom) = budget.freedom {
                " Effective degrees of freedom: " (format!("{freedom:.0}")) "."
            }
        }
    } }
}

/// Groups of terms of robot and instruments that were tried, with the result on held-out groups of samples.
pub(super) fn candidates(file: &CalibrationFile) -> Markup {
    let candidates = &file.candidates;
    html! { @if !candidates.is_empty() {
        h2 { "Errors of axes and instruments: what held-out samples support" }
        table {
            thead { tr {
                th { "kind" } th { "parameters" } th { "RMS residual without" } th { "with" } th.text { "" }
            } }
            tbody { @for one in candidates { tr {
                td { (one.name()) }
                td { (one.parameters) }
                td { (figure(one.held_out_before)) }
                td { (figure(one.held_out_after)) }
                td.unit { @if one.accepted { "used" } @else { "left out" } }
            } } }
        }
        p.note { "Each of eight groups of samples was predicted from a fit to the others. Residuals are weighted." }
    } }
}

fn table(caption: &str, entries: &[&ParameterEntry]) -> Markup {
    html! { @if !entries.is_empty() {
        table {
            caption { (caption) }
            thead { tr { th { "name" } th { "nominal" } th { "correction" } th { "sigma" } th.text { "" } } }
            tbody {
                @for entry in entries {
                    @let ReadIn { factor, unit, decimals } = entry.read_in();
                    tr {
                        td { (entry.name) @if entry.status == ParameterStatus::IdentifiedWithPrior { " (p)" } }
                        td { (format!("{:.3}", entry.nominal * factor)) }
                        td { (format!("{:+.decimals$}", entry.correction * factor)) }
                        td { @if let Some(sigma) = entry.sigma { (format!("{:.decimals$}", sigma * factor)) } @else { "–" } }
                        td.unit { (unit) }
                    }
                }
            }
        }
    } }
}

/// Figures of the residuals by joint. Empty if no joint of the bar has an encoder.
pub(super) fn joints(page: &Page<'_>) -> Markup {
    if !page.evidence.by_encoders {
        return html! {};
    }
    html! {
        h2 { "Residuals by joint and direction" }
        figure {
            div.panels.three {
                @for panel in figures::by_joint(page.evidence, page.calibration.model().robot()) { (panel) }
            }
            figcaption {
                "Further motion of each joint alone that would bring the robot's end nearest to the bar's. A wave over the "
                "angle points at the gear, two branches by direction at backlash, a slope at the gear's ratio."
            }
        }
    }
}

pub(super) fn coverage(page: &Page<'_>) -> Markup {
    html! {
        h2 { "Where the bar was" }
        figure {
            div.panels { (figures::coverage(page.evidence)) (figures::margin(page.evidence)) }
            figcaption { "Left: equal areas of the sphere are equal areas of the figure. Empty regions were not measured." }
        }
    }
}

/// Statistics of the solve, the strongest correlations (above 0.9, at most twelve), and a map of all correlations.
pub(super) fn dependence(file: &CalibrationFile) -> Markup {
    let named = file.knowledge.iter().flat_map(|knowledge| &knowledge.correlations);
    let strongest: Vec<_> = named.filter(|one| one.correlation.abs() > 0.9).take(12).collect();
    let solve = &file.solve;
    html! {
        h2 { "How well the parameters are separated" }
        p {
            "Cost " code { (solve.cost) } ": " (solve.ended) " after " (solve.iterations) " iterations, " (solve.samples)
            " samples, " (solve.parameters) " parameters, all identified; condition " (format!("{:.0}", solve.condition))
            "; residual RMS "
            (figure(solve.residual_rms_start)) " to " (figure(solve.residual_rms)) "."
            @for noise in &file.noise { " Estimated from the residuals: " (noise.sentence()) "." }
            @if let Some(groups) = not_separated(file) { " Beyond that: " (groups) "." }
        }
        @if !strongest.is_empty() {
            p {
                "Strongly correlated: "
                @for (index, one) in strongest.iter().enumerate() {
                    @if index > 0 { ", " }
                    (one.first) "–" (one.second) " " (format!("{:+.3}", one.correlation))
                }
                "."
            }
        }
        @if let Some(covariance) = &file.covariance {
            figure {
                (correlations::figure(covariance))
                figcaption { "Correlations above 0.1: blue together, orange against each other." }
            }
        }
    }
}

/// Everything that is needed to repeat the calibration: input files with their checksums, program version, and configuration.
pub(super) fn repeated_with(inputs: &[InputFile], software: &str, configuration: &str) -> Markup {
    html! {
        h2 { "To repeat it" }
        table {
            thead { tr { th { "input" } th.text { "file" } th.text { "SHA-256" } } }
            tbody {
                @for input in inputs {
                    tr { td { (input.role) } td.text { (input.path.display()) } td.text { code { (input.sha256) } } }
                }
            }
        }
        p.note { "Made with " (software) ". Configuration in full:" }
        pre { (configuration) }
    }
}
