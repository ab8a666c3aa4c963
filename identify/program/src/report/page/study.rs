//! `study.html`, for `identify study`: the answers of a study, claims of the thesis with the results of their check, and
//! figures. A figure shows the median error of each estimator over a condition.

use std::path::{Path, PathBuf};

use maud::{Markup, html};
use plotters::style::RGBColor;

use super::document;
use super::drawing::plot::{COLOURS, GREY, INK, Mark, Panel, Series};
use crate::report::result::file::{FileError, replace};
use crate::study::{
    CurvePoint, Definition, ErrorCurve, Figure, FigureKind, Measure, Reach, StatementAnswer, StudySummary,
    short,
};

/// Width and height of a panel \[px\].
const PANEL: (u32, u32) = (450, 330);
/// The right panel of a figure shows errors up to this multiple of the study's error limit (`limit_mm_mrad`).
const NEAR: f64 = 2.0;

/// Content of the page.
#[derive(Debug)]
pub struct StudyPage<'a> {
    /// Robot, bar, path and conditions.
    pub definition: &'a Definition,
    /// Curves, tables and answers.
    pub summary: &'a StudySummary,
}

impl StudyPage<'_> {
    /// Writes `summary.json` and `study.html` into the directory. Each file is written completely or not at all.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write(&self, directory: &Path) -> Result<[PathBuf; 2], FileError> {
        let summary = serde_json::to_string_pretty(self.summary).map_err(FileError::from)?;
        let page = self.render().into_string();
        Ok([replace(directory, "summary.json", &summary)?, replace(directory, "study.html", &page)?])
    }

    /// Renders the page as HTML.
    pub fn render(&self) -> Markup {
        let study = &self.definition.study;
        let (claims, answers): (Vec<&StatementAnswer>, Vec<&StatementAnswer>) =
            self.summary.findings.iter().partition(|finding| finding.holds.is_some());
        let body = html! {
            header {
                h1 { (study.title) }
                p.about {
                    (self.definition.robot.name) " · " (self.definition.bar.name) " · "
                    (study.seeds) @if study.seeds == 1 { " experiment" } @else { " experiments" } " a point · " (self.definition.software)
                }
            }
            main {
                p { (study.about) }
                (findings("Answers", ["question", "answer"], &answers))
                (findings("What the thesis found, checked", ["claim", "here"], &claims))
                @for figure in &study.figures { (self.figure(figure)) }
                (self.failures())
            }
        };
        document(&study.title, &body)
    }

    fn figure(&self, figure: &Figure) -> Markup {
        let shown = match figure.kind {
            FigureKind::Curves => self.drawn(figure),
            FigureKind::Levels | FigureKind::Affected | FigureKind::Errors | FigureKind::Largest => {
                self.tabled(figure)
            }
        };
        html! {
            h2 id=(figure.id) { (figure.id) ": " (figure.title) }
            @if !figure.thesis.is_empty() { p.note { "The thesis: " (figure.thesis) } }
            (shown)
        }
    }

    fn tabled(&self, figure: &Figure) -> Markup {
        let table = self.summary.tables.iter().find(|table| table.figure == figure.id);
        html! {
            @if let Some(table) = table {
                div.wide { table {
                    thead { tr { @for name in &table.head { th.text { (name) } } } }
                    tbody { @for row in &table.rows { tr { @for cell in row { td.text { (cell) } } } } }
                } }
            }
        }
    }

    fn drawn(&self, figure: &Figure) -> Markup {
        let curves = self.summary.curves.iter().filter(|curve| curve.figure == figure.id);
        let curves: Vec<&ErrorCurve> = curves.collect();
        let limit = self.definition.study.limit_mm_mrad;
        let mut estimators: Vec<(&str, &str)> = Vec::new();
        for curve in &curves {
            if !estimators.iter().any(|(name, _)| *name == curve.estimator) {
                estimators.push((&curve.estimator, &curve.label));
            }
        }
        let colour = |estimator: &str| {
            let at = estimators.iter().position(|(name, _)| *name == estimator).unwrap_or_default();
            COLOURS[at % COLOURS.len()]
        };
        let points = curves.iter().flat_map(|curve| medians(curve, figure.measure));
        let highest = points.fold(0.0, |most, (_, y)| y.max(most));
        let mut panels = Vec::new();
        for series in &figure.series {
            let curves_of_series = curves.iter().filter(|curve| curve.series == series.name);
            let lines = curves_of_series.map(|curve| {
                Series::new("", colour(&curve.estimator), Mark::Line, medians(curve, figure.measure))
            });
            // An additional point at the largest value of all series gives all panels the same scale.
            let highest_point =
                series.x.first().map(|x| Series::new("", GREY, Mark::Line, vec![(*x, highest)]));
            let title =
                if series.name.is_empty() { format!("Figure {}", figure.id) } else { series.name.clone() };
            panels.push(panel(figure, title, lines.chain(highest_point).collect()));
        }
        // If one curve reaches far above the limit, a second panel shows the part of all curves near the limit.
        let near = NEAR * limit;
        let zoomed = figure.series.len() == 1 && figure.measure != Measure::Position && highest > near;
        if zoomed {
            let lines = curves.iter().map(|curve| {
                let points = clipped(&medians(curve, figure.measure), near);
                Series::new("", colour(&curve.estimator), Mark::Line, points)
            });
            let all_x = x_values(&curves);
            let ends =
                all_x.first().zip(all_x.last()).map(|(first, last)| vec![(*first, limit), (*last, limit)]);
            let line = ends.map(|ends| Series::new("limit", INK, Mark::Segments, ends));
            panels.push(panel(figure, "Near the limit".into(), lines.chain(line).collect()));
        }
        html! {
            figure {
                div class=(if panels.len() == 3 { "panels three" } else { "panels" }) {
                    @for panel in panels { (panel) }
                }
                p.key { @for (name, label) in &estimators {
                    @let RGBColor(r, g, b) = colour(name);
                    span style=(format!("color: rgb({r},{g},{b})")) { "\u{25cf} " } (label) " \u{a0} "
                } }
                figcaption {
                    (figure.measure.label()) " over " (figure.x) ": median of all experiments."
                    @if zoomed { " Right: the same up to " (short(near)) ", with the limit of " (short(limit)) "." }
                }
            }
            (value_table(figure, &curves, limit))
        }
    }

    fn failures(&self) -> Markup {
        html! {
            @if !self.summary.failures.is_empty() {
                h2 { "Experiments without an estimate" }
                table {
                    thead { tr { th.text { "why" } th { "how often" } } }
                    tbody { @for (reason, count) in &self.summary.failures {
                        tr { td.text { (reason) } td { (count) } }
                    } }
                }
            }
        }
    }
}

/// Table of answers to questions, or of claims of the thesis with the result of their check.
fn findings(title: &str, [asked, found]: [&str; 2], findings: &[&StatementAnswer]) -> Markup {
    html! {
        @if let Some(first) = findings.first() {
            h2 { (title) }
            table {
                thead { tr {
                    th.text { (asked) } th.text { (found) } @if first.holds.is_some() { th.text { "" } }
                } }
                tbody { @for one in findings { tr {
                    td.text { (one.text) @if !one.why.is_empty() { br; span.about { (one.why) } } }
                    td.text { (one.answer) }
                    @match one.holds {
                        Some(true) => { td.text { "holds" } }
                        Some(false) => { td.text { b { "does not hold" } } }
                        None => {}
                    }
                } } }
            }
        }
    }
}

/// Table of median errors with one row for each curve. For the Euclidean error, the last column is the value of the condition
/// at which the median error reaches the limit.
fn value_table(figure: &Figure, curves: &[&ErrorCurve], limit: f64) -> Markup {
    html! { div.wide { table {
        thead { tr {
            th.text { (figure.x) }
            @for x in x_values(curves) { th { (x) } }
            @if figure.measure == Measure::Euclidean { th { "reaches " (short(limit)) " at" } }
        } }
        tbody { @for curve in curves { tr {
            td.text { (curve.label) @if !curve.series.is_empty() { ", " (curve.series) } }
            @for x in x_values(curves) { (cell(curve, x, figure.measure)) }
            @if figure.measure == Measure::Euclidean { td { (reached(curve.limit_at)) } }
        } } }
    } } }
}

/// The values of the condition at which at least one curve has a point, in ascending order.
fn x_values(curves: &[&ErrorCurve]) -> Vec<f64> {
    let mut all_x: Vec<f64> =
        curves.iter().flat_map(|curve| curve.points.iter().map(|point| point.x)).collect();
    all_x.sort_by(f64::total_cmp);
    all_x.dedup();
    all_x
}

fn cell(curve: &ErrorCurve, x: f64, measure: Measure) -> Markup {
    let point = curve.points.iter().find(|point| point.x == x);
    let error = point.and_then(|point| Some(short(point.errors.get(&measure)?.median)));
    let failed = point.map_or(0, |point| point.failed);
    html! { td { (error.unwrap_or_default()) @if failed > 0 { " (" (failed) " failed)" } } }
}

/// Value of the condition at which the median error reaches the limit, as text.
fn reached(limit_at: Reach) -> String {
    match limit_at {
        Reach::At(x) => short(x),
        Reach::BetterUpTo(_) => "never".into(),
        Reach::WorseDownTo(_) => "always worse".into(),
        Reach::Unknown => String::new(),
    }
}

fn medians(curve: &ErrorCurve, measure: Measure) -> Vec<(f64, f64)> {
    let median = |point: &CurvePoint| Some((point.x, point.errors.get(&measure)?.median));
    let mut points: Vec<(f64, f64)> = curve.points.iter().filter_map(median).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    points
}

fn panel(figure: &Figure, title: String, series: Vec<Series>) -> Markup {
    Panel::new(title, [&figure.x, figure.measure.label()], PANEL, series).with_zero().draw()
}

/// The part of a curve below the upper edge `most` of the panel. This part ends at the point where the
/// curve crosses the edge.
fn clipped(points: &[(f64, f64)], most: f64) -> Vec<(f64, f64)> {
    let mut clipped: Vec<(f64, f64)> = Vec::new();
    for (index, &(x, y)) in points.iter().enumerate() {
        if y <= most {
            clipped.push((x, y));
        } else if let Some(&(x0, y0)) = index.checked_sub(1).and_then(|before| points.get(before))
            && y0 <= most
        {
            // Point at which the straight line to this point crosses the upper edge.
            clipped.push((x0 + (most - y0) / (y - y0) * (x - x0), most));
        }
    }
    clipped
}
