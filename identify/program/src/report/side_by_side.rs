//! Output of `identify compare`: a table of several calibrations of one robot, and a page that also shows the
//! parameters with their confidence intervals as figures. The figures correspond to figures 5.12 to 5.17 of the
//! thesis (Brand and Nilsson 2016).

use std::fmt::Write;

use maud::{Markup, html};

use super::consistency::P_MIN;
use super::page::document;
use super::page::drawing::plot::{COLOURS, Mark, Panel, Series};
use crate::model::Unit;
use crate::report::Consistency;
use crate::statistics::Sizes;

/// The comparison as a table for the terminal.
pub fn table(consistency: &Consistency, names: &[String]) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    for (index, name) in names.iter().enumerate() {
        let _ = writeln!(text, "  [{}] {name}", index + 1);
    }
    let _ = write!(text, "{:<10}", "parameter");
    (1..=names.len()).for_each(|index| {
        let _ = write!(text, "{:>24}", format!("[{index}]"));
    });
    let _ = writeln!(text, "{:>10}  unit", "p");
    for one in &consistency.parameters {
        let unit = one.id.unit();
        let _ = write!(text, "{:<10}", one.id.to_string());
        for value in &one.values {
            let _ = write!(text, "{:>24}", shown(*value, unit.display_factor()));
        }
        let _ = writeln!(text, "{:>10}  {}", probability(one.p), unit.display_symbol());
    }
    other_nominals(consistency).into_iter().for_each(|sentence| text += &format!("{sentence}\n"));
    let _ = writeln!(text, "{}", verdict(consistency));
    apart(consistency).into_iter().for_each(|sentence| text += &format!("{sentence}\n"));
    text
}

/// An identified value and its sigma, times `factor`.
fn shown(value: Option<(f64, f64)>, factor: f64) -> String {
    value.map_or_else(
        || "fixed".into(),
        |(value, sigma)| format!("{:.4} +- {:.4}", value * factor, sigma * factor),
    )
}

fn probability(p: Option<f64>) -> String {
    p.map_or_else(|| "-".into(), |p| if p < 1e-4 { "<0.0001".into() } else { format!("{p:.4}") })
}

/// A sentence if nominal values differ between the calibrations. Corrections relative to different
/// nominal values cannot be compared.
fn other_nominals(consistency: &Consistency) -> Option<String> {
    let names = &consistency.other_nominals;
    (!names.is_empty()).then(|| {
        format!(
            "the configuration of robot or bar was not the same: nominal values of {} differ; identified values are compared, not \
             corrections; those lengths of the last link are not compared, because they contain plate and tool",
            names.join(", ")
        )
    })
}

/// Returns a sentence for each calibration after the first: the distance between the corrections of the robot's end by this
/// calibration and by the first one.
fn apart(consistency: &Consistency) -> Vec<String> {
    let sentence = |(number, apart): (usize, &Option<Sizes>)| {
        let Some(apart) = apart else {
            return format!("the robot's end with [{number}] and with [1]: no joint ranges in common");
        };
        let [mean, p95, max] = [apart.mean, apart.p95, apart.max].map(|metres| metres * 1e3);
        format!(
            "the robot's end with [{number}] and with [1]: {mean:.3} mm apart in the mean, 95 % within {p95:.3} mm, {max:.3} mm at \
             most, where both measured the joints"
        )
    };
    (2..).zip(&consistency.apart).map(sentence).collect()
}

fn verdict(consistency: &Consistency) -> String {
    match consistency.p_corrected {
        None => "no parameter was identified twice: nothing to compare".into(),
        Some(p) if consistency.is_consistent() => {
            format!(
                "consistent: differences like these come by chance (p {p:.3}, at least {P_MIN}: the smallest p multiplied by the number \
                 of parameters)"
            )
        }
        Some(p) => format!(
            "not consistent: differences like these do not come by chance (p {}, below {P_MIN}: the smallest p multiplied by the \
             number of parameters); corrections were applied between the runs, something else that the model lacks differs, or \
             their sigmas are too small",
            probability(Some(p))
        ),
    }
}

/// The comparison as an HTML page. The page contains no scripts and loads no other files.
pub fn page(consistency: &Consistency, robot: &str, names: &[String]) -> Markup {
    let title = format!("Calibrations of {robot} side by side");
    let body = html! {
        h1 { (title) }
        div.verdict.doubt[!consistency.is_consistent()] { (verdict(consistency)) }
        @if let Some(sentence) = other_nominals(consistency) { p { (sentence) } }
        @for sentence in apart(consistency) { p { (sentence) } }
        ol { @for (index, name) in names.iter().enumerate() {
            @let colour = COLOURS[index % COLOURS.len()];
            li { span style=(format!("color: rgb({},{},{})", colour.0, colour.1, colour.2)) { "● " } (name) }
        } }
        figure {
            (intervals("Lengths", Unit::Metre, consistency, names.len()))
            (intervals("Angles", Unit::Radian, consistency, names.len()))
            figcaption {
                "How far each calibration is from their weighted mean, with 95 % intervals. Intervals that do not overlap "
                "are a difference."
            }
        }
        div.wide { (rows(consistency, names.len())) }
    };
    document(&title, &body)
}

/// Figure with the deviations of each calibration from the weighted means, and their confidence intervals. At each parameter,
/// the calibrations are drawn side by side.
fn intervals(title: &str, unit: Unit, consistency: &Consistency, files: usize) -> Markup {
    let parameters = || consistency.parameters.iter().filter(|one| one.id.unit() == unit);
    let factor = unit.display_factor();
    let mut series = Vec::new();
    for file in 0..files {
        let colour = COLOURS[file % COLOURS.len()];
        // Offset along the x axis from the position of the parameter. It is at most 0.3, so that intervals do
        // not hide each other.
        let aside = 0.6 * ((file as f64 + 0.5) / files as f64 - 0.5);
        let (mut values, mut ends) = (Vec::new(), Vec::new());
        for (number, one) in parameters().enumerate() {
            if let Some((value, sigma)) = one.values[file] {
                let half = consistency.sigmas_of_95[file] * sigma;
                let (x, y) = (number as f64 + aside, (value - one.mean) * factor);
                values.push((x, y));
                ends.extend([(x, y - half * factor), (x, y + half * factor)]);
            }
        }
        series.push(Series::new("", colour, Mark::Segments, ends));
        series.push(Series::new("", colour, Mark::Dots, values));
    }
    let names = parameters().map(|one| one.id.to_string()).collect();
    let y = format!("from the mean [{}]", unit.display_symbol());
    Panel::new(title, ["", &y], (920, 260), series).with_names(names).draw()
}

fn rows(consistency: &Consistency, files: usize) -> Markup {
    html! {
        table {
            thead { tr { th { "parameter" } @for index in 1..=files { th { (index) } } th { "p" } th.text { "unit" } } }
            tbody {
                @for one in &consistency.parameters {
                    tr {
                        td { (one.id) }
                        @for value in &one.values { td { (shown(*value, one.id.unit().display_factor())) } }
                        td { (probability(one.p)) }
                        td.text { (one.id.unit().display_symbol()) }
                    }
                }
            }
        }
    }
}
