//! Section on files of rows: figures of the errors of all rows, the tables as on the terminal, and the clocks of trackers.

use maud::{Markup, html};

use super::Page;
use super::drawing::figures::{WIDE, dots};
use super::drawing::plot::{BLUE, GREY, ORANGE, Panel};
use super::held_out::{POSITION_MM, ROTATION_MRAD, Value};
use super::sections::{mm, number};
use crate::calibrate::rows::{RowSet, Stages};
use crate::instrument::PoseError;
use crate::statistics::Sizes;

fn names_and_sets<'a>(page: &Page<'a>) -> impl Iterator<Item = (&'a String, &'a RowSet)> {
    page.rows.iter().zip(&page.calibration.rows)
}

/// Errors on held-out rows with the nominal and the calibrated robot, as large numbers.
pub(super) fn numbers(page: &Page<'_>) -> Markup {
    let sizes = |Sizes { mean, p95, max, .. }: Sizes| {
        format!("mean {} mm, 95 % {} mm, largest {} mm", mm(mean), mm(p95), mm(max))
    };
    html! {
        @for (name, set) in names_and_sets(page).filter(|(_, set)| !set.held_out_rows.is_empty()) {
            @let held_out = set.held_out_with_rejected();
            @for (robot, figures) in [("nominal robot", held_out.nominal), ("calibrated", held_out.joints)] {
                @let label = format!("{name}, {} held-out rows, {robot}, RMS; {}", figures.rows, sizes(figures.position_m));
                (number(mm(figures.position_m.rms) + " mm", label))
            }
        }
    }
}

/// Figures and tables of each file, and its clocks. Data sets of files of rows are numbered after the runs with a bar.
pub(super) fn section(page: &Page<'_>) -> Markup {
    if page.rows.is_empty() {
        return html! {};
    }
    html! {
        h2 { "Errors, row by row" }
        p.note { "Robot against measurement. The scales differ. Rejected rows are drawn, too." }
        @for (name, set) in names_and_sets(page) { figure { p.run { (name) } (panels(set)) } }
        pre.table { (page.tables) }
        @for clock in page.file.clocks.iter().filter(|clock| clock.data_set > page.evidence.runs.len()) {
            p { "Clocks of data set " (clock.data_set) ": " (clock.sentence()) "." }
        }
    }
}

/// Figures of the errors on a file, with the nominal and the calibrated robot.
fn panels(set: &RowSet) -> Markup {
    // The last stage, which includes joint errors, is the calibrated robot.
    let Stages { nominal, joints: calibrated, .. } = &set.errors;
    let panel = |title: &str, y: &str, colour, stage: &[PoseError], value: Value| {
        let points = |rows: &[usize]| {
            rows.iter().filter_map(|&row| Some((row as f64 + 1.0, value(stage.get(row)?)?))).collect()
        };
        let series = vec![
            dots("fitted", colour, points(&set.fitted_rows)),
            dots("held out", ORANGE, points(&set.held_out_rows)),
        ];
        Panel::new(title, ["row", y], WIDE, series).with_zero().draw()
    };
    html! {
        (panel("Nominal robot", "[mm]", GREY, nominal, POSITION_MM))
        (panel("Calibrated robot", "[mm]", BLUE, calibrated, POSITION_MM))
        @if calibrated.iter().any(|error| error.rotation_rad.is_some()) {
            (panel("Rotation, nominal", "[mrad]", GREY, nominal, ROTATION_MRAD))
            (panel("Rotation, calibrated", "[mrad]", BLUE, calibrated, ROTATION_MRAD))
        }
    }
}
