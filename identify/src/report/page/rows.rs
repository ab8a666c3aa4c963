//! The page of a calibration from rows that trackers and wires measured, and of any mix of instruments.

use std::path::{Path, PathBuf};

use maud::{Markup, html};

use super::certificate::certificate;
use super::drawing::figures::{WIDE, dots, gap_over_time};
use super::drawing::plot::{BLUE, GREY, ORANGE, Panel, PlotError};
use super::sections::{budget, candidates, dependence, expected, limits, mm, parameters, repeated_with, svg};
use super::{PageError, document};
use crate::calibrate::rows::{PoseFigures, RowErrors, Sizes};
use crate::evaluate::{RunEvidence, WorkspaceError};
use crate::instrument::PoseError;
use crate::report::result::file::{CalibrationFile, replace};

/// Everything that the page shows.
#[derive(Debug)]
pub struct MeasuredPage<'a> {
    /// Results as they are written.
    pub file: &'a CalibrationFile,
    /// Expected error over the workspace.
    pub workspace: &'a WorkspaceError,
    /// Each data set with its name, in their order.
    pub data_sets: &'a [(String, Measured<'a>)],
    /// What the terminal says of them.
    pub tables: &'a str,
    /// The whole experiment, as text.
    pub configuration: &'a str,
}

/// What a data set shows.
#[derive(Debug)]
pub enum Measured<'a> {
    /// A run with the ball-bar.
    Bar {
        /// Its samples.
        evidence: Box<RunEvidence>,
        /// It has encoders: without any only the distance from the sphere means something.
        by_encoders: bool,
    },
    /// Rows of a tracker or a wire.
    Rows(&'a RowErrors),
}

impl MeasuredPage<'_> {
    /// Writes `report.html` into the directory, whole or not at all.
    ///
    /// # Errors
    /// [`PageError`].
    pub fn write(&self, directory: &Path) -> Result<PathBuf, PageError> {
        let text = self.render()?.into_string();
        Ok(replace(directory, "report.html", &text)?)
    }

    /// The page.
    ///
    /// # Errors
    /// [`PlotError`].
    pub fn render(&self) -> Result<Markup, PlotError> {
        let title = format!("Calibration of {}", self.file.robot);
        let others: Vec<String> = self.data_sets.iter().skip(1).map(|(name, _)| name.clone()).collect();
        let place = self.data_sets.first().map_or("", |(name, _)| name);
        let mut shown = Vec::new();
        for (name, measured) in self.data_sets {
            shown.push((name, panels(measured)?));
        }
        Ok(document(
            &title,
            &html! {
                main {
                    (certificate(self.file, self.workspace)?)
                    (self.numbers())
                    h2 { "Errors, row by row" }
                    p.note { "Robot against what was measured. Mind the scales. Rows that take no part are drawn as well." }
                    @for (name, panels) in shown {
                        @if !panels.is_empty() {
                            figure {
                                p.run { (name) }
                                @for panel in panels { (svg(panel)) }
                            }
                        }
                    }
                    pre.table { (self.tables) }
                    @for clock in self.file.clocks() {
                        p { "Clocks of data set " (clock.data_set) ": " (clock.sentence()) "." }
                    }
                    (parameters(self.file, place, &others))
                    (budget(self.file))
                    (candidates(self.file))
                    (dependence(self.file))
                    (repeated_with(&self.file.inputs, &self.file.software, self.configuration))
                }
            },
        ))
    }

    fn numbers(&self) -> Markup {
        let WorkspaceError { before, after, .. } = self.workspace;
        let held_out = |(name, measured): &(String, Measured<'_>)| match measured {
            Measured::Rows(errors) if !errors.held_out.is_empty() => {
                let stages = errors.of(&errors.held_out);
                Some((name.clone(), stages.nominal, stages.joints))
            }
            _ => None,
        };
        let held_out: Vec<(String, PoseFigures, PoseFigures)> =
            self.data_sets.iter().filter_map(held_out).collect();
        let sizes = |Sizes { mean, p95, max, .. }: Sizes| {
            format!("mean {} mm, 95 % {} mm, largest {} mm", mm(mean), mm(p95), mm(max))
        };
        html! {
            h2 { "Before and after" }
            (limits(self.file))
            div.numbers {
                (expected("before", before))
                (expected("after", after))
                @for (name, nominal, calibrated) in &held_out {
                    div.number {
                        b { (mm(nominal.position_m.rms)) " mm" }
                        span { (name) ", " (nominal.rows) " held-out rows, nominal robot, RMS; " (sizes(nominal.position_m)) }
                    }
                    div.number {
                        b { (mm(calibrated.position_m.rms)) " mm" }
                        span { (name) ", " (calibrated.rows) " held-out rows, calibrated, RMS; " (sizes(calibrated.position_m)) }
                    }
                }
            }
            p.note {
                "Before: nominal against identified geometry at the flange, over all postures within the joint limits, so also "
                "where nothing was measured. After: what the covariance of the parameters leaves there. Errors that do not depend "
                "on the geometry (gears, load, temperature) come on top; held-out rows have them."
            }
        }
    }
}

/// The errors of a data set, nominal and calibrated.
fn panels(measured: &Measured<'_>) -> Result<Vec<String>, PlotError> {
    let errors = match measured {
        Measured::Bar { evidence, by_encoders } => return Ok(gap_over_time(evidence, *by_encoders)?.into()),
        Measured::Rows(errors) if errors.stages[0].is_empty() => return Ok(Vec::new()),
        Measured::Rows(errors) => errors,
    };
    let [nominal, .., calibrated] = &errors.stages;
    let position = |one: &PoseError| Some(one.position_m * 1e3);
    let rotation = |one: &PoseError| Some(one.rotation_rad? * 1e3);
    let panel = |title: &str, y: &str, stage: &[PoseError], value: &dyn Fn(&PoseError) -> Option<f64>| {
        let of = |rows: &[usize]| {
            rows.iter().filter_map(|&row| Some((row as f64 + 1.0, value(stage.get(row)?)?))).collect()
        };
        let seen = if std::ptr::eq(stage, nominal.as_slice()) { GREY } else { BLUE };
        let series =
            vec![dots("fitted", seen, of(&errors.fitted)), dots("held out", ORANGE, of(&errors.held_out))];
        let (title, y) = (title.into(), y.into());
        Panel { title, x: "row", y, size: WIDE, series, from_zero: true }.draw()
    };
    let mut panels = vec![
        panel("Nominal robot", "[mm]", nominal, &position)?,
        panel("Calibrated robot", "[mm]", calibrated, &position)?,
    ];
    if calibrated.iter().any(|one| one.rotation_rad.is_some()) {
        panels.push(panel("Rotation, nominal", "[mrad]", nominal, &rotation)?);
        panels.push(panel("Rotation, calibrated", "[mrad]", calibrated, &rotation)?);
    }
    Ok(panels)
}
