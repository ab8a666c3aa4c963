//! Section on files of rows: errors row by row, their tables as on the terminal, and the clocks of trackers.

use maud::{Markup, html};

use super::Page;
use super::drawing::figures::{WIDE, dots};
use super::drawing::plot::{BLUE, GREY, ORANGE, Panel, PlotError};
use super::held_out::{POSITION_MM, ROTATION_MRAD, Value};
use super::sections::{mm, number};
use crate::calibrate::rows::RowErrors;
use crate::instrument::PoseError;
use crate::statistics::Sizes;

/// Errors on held-out rows, nominal and calibrated, as large numbers.
pub(super) fn numbers(page: &Page<'_>) -> Markup {
    let sizes = |Sizes { mean, p95, max, .. }: Sizes| {
        format!("mean {} mm, 95 % {} mm, largest {} mm", mm(mean), mm(p95), mm(max))
    };
    html! {
        @for (name, errors) in page.rows.iter().filter(|(_, errors)| !errors.held_out.is_empty()) {
            @let held_out = errors.of(&errors.held_out);
            @for (robot, figures) in [("nominal robot", held_out.nominal), ("calibrated", held_out.joints)] {
                @let label = format!("{name}, {} held-out rows, {robot}, RMS; {}", figures.rows, sizes(figures.position_m));
                (number(mm(figures.position_m.rms) + " mm", label))
            }
        }
    }
}

/// Figures and tables of each file.
pub(super) fn section(page: &Page<'_>) -> Result<Markup, PlotError> {
    if page.rows.is_empty() {
        return Ok(html! {});
    }
    Ok(html! {
        h2 { "Errors, row by row" }
        p.note { "Robot against measurement. The scales differ. Rejected rows are drawn, too." }
        @for (name, errors) in page.rows {
            @if !errors.stages[0].is_empty() { figure { p.run { (name) } (panels(errors)?) } }
        }
        pre.table { (page.tables) }
        @for clock in page.file.clocks.iter().filter(|clock| clock.data_set > page.evidence.runs.len()) {
            p { "Clocks of data set " (clock.data_set) ": " (clock.sentence()) "." }
        }
    })
}

/// The errors of a file, nominal and calibrated.
fn panels(errors: &RowErrors) -> Result<Markup, PlotError> {
    let [nominal, .., calibrated] = &errors.stages;
    let panel = |title: &str, y: &str, stage: &[PoseError], value: Value| {
        let points = |rows: &[usize]| {
            rows.iter().filter_map(|&row| Some((row as f64 + 1.0, value(stage.get(row)?)?))).collect()
        };
        let colour = if std::ptr::eq(stage, nominal.as_slice()) { GREY } else { BLUE };
        let series = vec![
            dots("fitted", colour, points(&errors.fitted)),
            dots("held out", ORANGE, points(&errors.held_out)),
        ];
        Panel::new(title, ["row", y], WIDE, series).with_zero().draw()
    };
    Ok(html! {
        (panel("Nominal robot", "[mm]", nominal, POSITION_MM)?)
        (panel("Calibrated robot", "[mm]", calibrated, POSITION_MM)?)
        @if calibrated.iter().any(|one| one.rotation_rad.is_some()) {
            (panel("Rotation, nominal", "[mrad]", nominal, ROTATION_MRAD)?)
            (panel("Rotation, calibrated", "[mrad]", calibrated, ROTATION_MRAD)?)
        }
    })
}
