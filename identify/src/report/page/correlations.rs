//! Correlations of the free parameters as a picture.

use std::fmt::Write;

use plotters::prelude::RGBColor;

use super::plot::{BLUE, FONT, ORANGE};
use crate::study::Evidence;

/// Weaker ones are left white.
const LEAST: f64 = 0.1;
/// Side of a cell, and room for names.
const CELL: usize = 12;
const NAMES: usize = 84;

/// Blue together, orange against each other.
pub(super) fn figure(evidence: &Evidence) -> String {
    let (names, rows) = &evidence.correlations;
    let side = NAMES + names.len() * CELL;
    let mut svg = format!("<svg viewBox=\"0 0 {side} {side}\" role=\"img\" aria-label=\"correlations\">");
    let label = format!("font-size=\"9\" fill=\"#46505c\" font-family=\"{FONT}\"");
    // Writing to a string cannot fail.
    for (row, values) in rows.iter().enumerate() {
        let y = NAMES + row * CELL;
        let name = maud::html! { (names.get(row).map_or("", String::as_str)) }.into_string();
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"end\" {label}>{name}</text>",
            NAMES - 4,
            y + 9
        );
        let _ = write!(
            svg,
            "<text transform=\"translate({} {}) rotate(-90)\" {label}>{name}</text>",
            NAMES + row * CELL + 9,
            NAMES - 4
        );
        for (column, value) in values.iter().enumerate().filter(|(_, value)| value.abs() > LEAST) {
            let RGBColor(r, g, b) = if *value > 0.0 { BLUE } else { ORANGE };
            let x = NAMES + column * CELL;
            let _ = write!(
                svg,
                "<rect x=\"{x}\" y=\"{y}\" width=\"{CELL}\" height=\"{CELL}\" fill=\"rgb({r},{g},{b})\" fill-opacity=\"{:.2}\"/>",
                value.abs()
            );
        }
    }
    svg.push_str("</svg>");
    svg
}
