//! `report.html`: one file for browsers and printers, without scripts or links to other files. [`Page`] is the content of the
//! page and orders its sections. Each submodule renders some of the sections from the result and its evidence. The pages of a
//! refused calibration, of plans and of a study are also in this module.

mod certificate;
pub(super) mod drawing;
mod held_out;
mod planned;
mod refused;
mod rows;
mod run;
mod sections;
mod study;

use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use sha2::{Digest, Sha256};
use shared::config::BallBarConfig;

use crate::calibrate::Calibration;
use crate::evaluate::Evidence;
use crate::report::result::file::{CalibrationFile, FileError, replace};

use self::run::{inputs, runs, sphere};

pub use drawing::arm::picture;
pub use planned::path::PathPage;
pub use planned::poses::PosesPage;
pub use refused::{RefusedPage, WrittenRefusal};
pub use run::inputs::InspectedLog;
pub use study::StudyPage;

/// Content of the page.
#[derive(Debug)]
pub struct Page<'a> {
    /// Content of `calibration.toml`.
    pub file: &'a CalibrationFile,
    /// Result of the solve, and the prepared data of the runs.
    pub calibration: &'a Calibration,
    /// Statistics of the result.
    pub evidence: &'a Evidence,
    /// Configuration of the bar of the first run.
    pub bar: Option<&'a BallBarConfig>,
    /// Name of each file of rows, in the order of the data sets.
    pub rows: &'a [String],
    /// Tables of the errors on rows, as on the command line.
    pub tables: &'a str,
    /// Recording and robot log of each run; may be empty.
    pub sources: &'a [InspectedLog],
    /// The whole configuration that was used, as text.
    pub configuration: &'a str,
}

impl Page<'_> {
    /// Writes `report.html` into the directory, completely or not at all.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write(&self, directory: &Path) -> Result<PathBuf, FileError> {
        replace(directory, "report.html", &self.render().into_string())
    }

    /// Renders the page as HTML.
    pub fn render(&self) -> Markup {
        let title = format!("Calibration of {}", self.file.robot);
        let has_bars = !self.evidence.runs.is_empty();
        let names_of_rows = self.rows.iter().cloned();
        // The section on parameters has one table for each data set. These are the captions of the tables.
        let (first_heading, other_headings): (_, Vec<String>) = match self.rows.first() {
            Some(first) if !has_bars => (first.as_str(), names_of_rows.skip(1).collect()),
            _ => {
                let names_of_runs = runs::names(self).into_iter().skip(1).flatten();
                ("Place of the bar, clocks", names_of_runs.chain(names_of_rows).collect())
            }
        };
        let body = html! {
            main {
                (certificate::certificate(self.file, &self.evidence.workspace))
                (sections::numbers(self))
                (held_out::section(self))
                (rows::section(self))
                @if has_bars { (runs::gaps(self)) (sphere::section(self)) }
                (sections::bar(self))
                (sections::parameters(self.file, first_heading, &other_headings))
                (sections::budget(self.file))
                (sections::candidates(self.file))
                @if has_bars { (sections::joints(self)) (sections::coverage(self)) (runs::alignments(self)) }
                (sections::dependence(self.file))
                (inputs::section(self.sources))
                (sections::repeated_with(&self.file.inputs, &self.file.software, self.configuration))
            }
        };
        document(&title, &body)
    }
}

/// Whether a text is the page of a calibration or of a refused calibration.
pub(super) fn is_page(text: &str) -> bool {
    text.contains("<div class=\"verdict")
}

/// A page whose content security policy forbids loading files and running scripts, in case a name in a log contains markup.
pub(super) fn document(title: &str, body: &Markup) -> Markup {
    document_with(title, &[], body)
}

/// As [`document`], with scripts at the end of the body. The policy allows these scripts by their hashes.
fn document_with(title: &str, scripts: &[&str], body: &Markup) -> Markup {
    let hash = |script: &&str| format!(" 'sha256-{}'", STANDARD.encode(Sha256::digest(script)));
    let hashes: String = scripts.iter().map(hash).collect();
    let scripts_from = if scripts.is_empty() { String::new() } else { format!("; script-src{hashes}") };
    let policy = format!("default-src 'none'; style-src 'unsafe-inline'; img-src data:{scripts_from}");
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta http-equiv="Content-Security-Policy" content=(policy);
                title { (title) }
                style { (PreEscaped(include_str!("style.css"))) }
            }
            body { (body) @for script in scripts { script { (PreEscaped(script)) } } }
        }
    }
}
