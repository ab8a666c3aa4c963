//! Map of the correlations of the free parameters.

use std::fmt::Write;

use maud::{Markup, PreEscaped};
use plotters::prelude::RGBColor;

use super::plot::{BLUE, FONT, ORANGE};
use crate::model::ParameterId;
use crate::report::result::knowledge::CovarianceEntry;

/// Correlations up to this absolute value are left white.
const LEAST: f64 = 0.1;
/// Number of shades for each sign.
const STEPS: i32 = 20;
/// Side of a cell \[px\].
const CELL: usize = 12;
/// Width of the margin with the names of parameters \[px\].
const NAMES: usize = 84;

/// Draws the correlation matrix of the robot's parameters and of the parameters of the first data set. Positive
/// correlations are blue, negative ones orange. Amplitudes of joint waves are left out, because they are many and correlate
/// with no other parameter.
pub(in crate::report::page) fn figure(covariance: &CovarianceEntry) -> Markup {
    let is_shown = |name: &String| name.parse().is_ok_and(|id| !matches!(id, ParameterId::JointWave { .. }));
    let shown = covariance.names.iter().enumerate().filter(|(_, name)| is_shown(name));
    let (columns, names): (Vec<usize>, Vec<&String>) = shown.unzip();
    let correlation = |a: usize, b: usize| {
        let variance = |a| covariance.between(a, a);
        Some(covariance.between(a, b)? / (variance(a)? * variance(b)?).sqrt())
    };
    let row = |a: &usize| columns.iter().map(|b| correlation(*a, *b).unwrap_or(0.0)).collect();
    let rows: Vec<Vec<f64>> = columns.iter().map(row).collect();
    let side = NAMES + names.len() * CELL;
    let mut svg = format!("<svg viewBox=\"0 0 {side} {side}\" role=\"img\" aria-label=\"correlations\">");
    let label = format!("font-size=\"9\" fill=\"#46505c\" font-family=\"{FONT}\"");
    let beside_cells = NAMES - 4;
    // Writing to a string cannot fail.
    for (row, name) in names.iter().enumerate() {
        let baseline = NAMES + row * CELL + 9;
        let name = maud::html! { (name) }.into_string();
        let _ = write!(
            svg,
            "<text x=\"{beside_cells}\" y=\"{baseline}\" text-anchor=\"end\" {label}>{name}</text>"
        );
        let _ = write!(
            svg,
            "<text transform=\"translate({baseline} {beside_cells}) rotate(-90)\" {label}>{name}</text>"
        );
    }
    // All cells of one shade are a single SVG path. Separate elements would take up a third of the page.
    for step in (-STEPS..=STEPS).filter(|step| *step != 0) {
        let path = cells(&rows, step);
        let RGBColor(r, g, b) = if step > 0 { BLUE } else { ORANGE };
        if !path.is_empty() {
            let opacity = f64::from(step.abs()) / f64::from(STEPS);
            let _ =
                write!(svg, "<path d=\"{path}\" fill=\"rgb({r},{g},{b})\" fill-opacity=\"{opacity:.2}\"/>");
        }
    }
    svg.push_str("</svg>");
    PreEscaped(svg)
}

/// SVG path of all cells of one shade.
fn cells(rows: &[Vec<f64>], step: i32) -> String {
    let has_shade = |value: &f64| value.abs() > LEAST && (value * f64::from(STEPS)).round() as i32 == step;
    let mut path = String::new();
    for (row, values) in rows.iter().enumerate() {
        for (column, _) in values.iter().enumerate().filter(|(_, value)| has_shade(value)) {
            let (x, y) = (NAMES + column * CELL, NAMES + row * CELL);
            // Writing to a string cannot fail.
            let _ = write!(path, "M{x} {y}h{CELL}v{CELL}h-{CELL}");
        }
    }
    path
}
