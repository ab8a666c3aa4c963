//! The cost functions side by side.

use maud::{Markup, html};
use plotters::prelude::RGBColor;
use shared::output::named;

use super::Page;
use super::drawing::intervals::Intervals;
use super::drawing::plot::{COLOURS, PlotError};
use super::sections::{figure, svg};
use crate::evaluate::{CostComparison, CostEntry, CostFigures};
use crate::model::Unit;

/// So many names of parameters fit into a cell.
const NAMES_MAX: usize = 8;

pub(super) fn section(page: &Page<'_>) -> Result<Markup, PlotError> {
    let Some(costs) = page.evidence.costs.as_ref().filter(|costs| costs.entries.len() > 1) else {
        return Ok(html! {});
    };
    let [lengths, angles] = [(Unit::Metre, "Lengths"), (Unit::Radian, "Angles")]
        .map(|(unit, title)| intervals(costs, unit, title).draw());
    Ok(html! {
        h2 { "Cost functions side by side" }
        p {
            "The same samples, selection and terms of the axes, each cost from nominal links; "
            code { (page.calibration.cost.name()) } " is the calibration of this page."
        }
        div.wide { (table(costs)) }
        figure {
            p.key { @for (index, entry) in costs.entries.iter().enumerate() {
                @let RGBColor(r, g, b) = COLOURS[index % COLOURS.len()];
                span style=(format!("color: rgb({r},{g},{b})")) { "● " } (entry.cost.name()) " "
            } }
            (svg(lengths?)) (svg(angles?))
            figcaption {
                "The robot's parameters, from their values in the calibration, with 95 % intervals. All costs saw the same "
                "samples, so they differ by less than these where they agree. A cost that is off by more than its interval "
                "says is misled by an error that it cannot separate from the geometry."
            }
        }
    })
}

fn table(costs: &CostComparison) -> Markup {
    html! {
        table {
            thead { tr {
                th { "cost" } th { "free" } th { "rank" } th { "condition" } th { "RMS residual" }
                th { "sigma [mm|mrad]" } th { "difference" } th { "robot moved [mm]" } th { "expected error [mm]" }
            } }
            tbody { @for entry in &costs.entries { (rows(entry)) } }
        }
        p.note {
            "Rank: directions that the samples determine without priors. Residuals in each cost's own unit. Sigma and "
            "difference: Euclidean, over the robot's parameters that the cost identifies, millimetres and milliradians as "
            "equals; the difference is to the calibration. Robot moved: mean distance between the positions of the two "
            "robots over the workspace. Expected error: mean over the workspace, from the cost's own covariance."
        }
    }
}

fn rows(entry: &CostEntry) -> Markup {
    html! {
        @match &entry.figures {
            Ok(figures) => { (figures_row(entry.cost.name(), figures)) }
            Err(reason) => { tr { td { (entry.cost.name()) } td.text colspan="8" { "no result: " (reason) } } }
        }
    }
}

fn figures_row(name: &str, figures: &CostFigures) -> Markup {
    html! {
        tr {
            td { (name) }
            td { (figures.parameters) }
            td { (figures.rank_of_samples) }
            td { (format!("{:.0}", figures.condition)) }
            td { (figure(figures.summary.residual_rms)) }
            td { (format!("{:.4}", figures.sigma_mm_mrad)) }
            td { (format!("{:.4}", figures.difference_mm_mrad)) }
            td { (format!("{:.4}", figures.from_calibrated_m * 1e3)) }
            td { (format!("{:.4}", figures.expected.mean_m * 1e3)) }
        }
        @if !figures.not_determined.is_empty() {
            tr.aside { td {} td.text colspan="8" { "does not determine " (named(&figures.not_determined, NAMES_MAX)) } }
        }
    }
}

fn intervals(costs: &CostComparison, unit: Unit, title: &str) -> Intervals {
    let factor = unit.display_factor();
    let of_unit: Vec<usize> = (0..costs.names.len()).filter(|&at| costs.names[at].1 == unit).collect();
    let own = costs.entries.first().and_then(|entry| entry.figures.as_ref().ok());
    let set = |entry: &CostEntry| {
        let of = |&at: &usize| {
            let figures = entry.figures.as_ref().ok()?;
            let (correction, sigma) = (*figures.robot.get(at)?)?;
            let reference = own.and_then(|own| *own.robot.get(at)?).map_or(0.0, |(correction, _)| correction);
            Some(((correction - reference) * factor, figures.sigmas_of_95 * sigma * factor))
        };
        of_unit.iter().map(of).collect()
    };
    Intervals {
        title: title.into(),
        y: format!("from the calibration [{}]", unit.display_symbol()),
        names: of_unit.iter().map(|&at| costs.names[at].0.clone()).collect(),
        sets: costs.entries.iter().map(set).collect(),
    }
}
