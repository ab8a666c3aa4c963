//! `report.html` of a refused calibration. The page states the problem, its location and the remedy, and then shows the
//! residuals of the encoders and the content of the input files.

mod figures;

use std::path::{Path, PathBuf};

use maud::{Markup, html};

use super::certificate::{identity, sheet, to_the_second};
use super::document;
use super::run::inputs::{InspectedLog, rows};
use super::sections::repeated_with;
use crate::calibrate::refusal::CalibrationRefusal;
use crate::inspect::JointLine;
use crate::report::result::earlier::Earlier;
use crate::report::result::file::{FileError, InputFile, MeasurementEntry, now, replace, software};

/// Sentence that explains the red line in a figure.
const MARKED: &str = " Red: time of the problem.";

/// Content of the page.
#[derive(Debug)]
pub struct RefusedPage<'a> {
    /// Name of the robot.
    pub robot: &'a str,
    /// Name of the instrument of the measurement.
    pub instrument: &'a str,
    /// Descriptions of the measurements, from their recordings.
    pub measured: &'a [MeasurementEntry],
    /// Message of the refusal, and location of the problem.
    pub refusal: &'a CalibrationRefusal<'a>,
    /// Recording and robot log of each run.
    pub runs: &'a [[InspectedLog; 2]],
    /// Files that were read.
    pub inputs: &'a [InputFile],
    /// The whole configuration that was used, as text.
    pub configuration: &'a str,
}

/// Paths of a written page.
#[derive(Debug)]
pub struct WrittenRefusal {
    /// Path of the page.
    pub page: PathBuf,
    /// Directory to which an earlier calibration was moved. `None` if the directory contained no earlier calibration.
    pub set_aside: Option<PathBuf>,
}

impl RefusedPage<'_> {
    /// Writes `report.html` into the directory, completely or not at all. An earlier calibration in the directory is moved to
    /// a folder of its own, because the page does not describe it.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write(&self, directory: &Path) -> Result<WrittenRefusal, FileError> {
        let earlier = Earlier::in_directory(directory);
        let text = self.render(earlier.as_ref().map(Earlier::destination)).into_string();
        let set_aside = earlier.map(Earlier::set_aside).transpose()?;
        Ok(WrittenRefusal { page: replace(directory, "report.html", &text)?, set_aside })
    }

    /// Renders the page. `set_aside` is the directory to which an earlier calibration is moved.
    pub fn render(&self, set_aside: Option<&Path>) -> Markup {
        let title = format!("Calibration of {}: refused", self.robot);
        let body = html! {
            main {
                (sheet(self.measured.iter().any(|one| one.simulated), &html! {
                    header {
                        h1 { (title) }
                        p.about { "Refusal · " (to_the_second(&now())) " · " (software()) }
                    }
                    (self.verdict(set_aside))
                    (identity(self.robot, self.instrument, self.measured, None, None))
                }))
                (self.deviations())
                @for (number, run) in self.runs.iter().enumerate() { (self.run(number, run)) }
                (repeated_with(self.inputs, &software(), self.configuration))
            }
        };
        document(&title, &body)
    }

    fn verdict(&self, set_aside: Option<&Path>) -> Markup {
        let (wrong, remedy) = parts(&self.refusal.message);
        let place = self.place();
        html! {
            div.verdict.refused {
                strong { "Not calibrated. " }
                dl {
                    dt { "What is wrong" } dd { (capitalised(wrong)) }
                    @if !place.is_empty() { dt { "Where" } dd { (place) } }
                    @if let Some(remedy) = remedy { dt { "What to do" } dd { (capitalised(remedy)) } }
                }
            }
            p.note {
                "These inputs were not calibrated: no file of parameters was written."
                @if !self.runs.is_empty() { " Below is the content of each input." }
                @if let Some(set_aside) = set_aside {
                    " An older calibration that was in this directory, of other inputs or settings, is now in "
                    code { (set_aside.display()) } "."
                }
            }
        }
    }

    /// Run, joint and time of the problem as text, as far as they are known.
    fn place(&self) -> String {
        let place = &self.refusal.place;
        let run = self.refusal.run.and_then(|run| self.runs.get(run).map(|found| (run, found)));
        let files = run.map(|(run, [recording, robot_log])| {
            let files = format!("{} with {}", recording.path.display(), robot_log.path.display());
            if self.runs.len() > 1 { format!("{}, {files}", self.number(run)) } else { files }
        });
        let instant = place.bar_s.map(|bar_s| {
            let in_robot_log = place
                .robot_s
                .map(|robot_s| format!(", {robot_s:.2} s after the first sample of the robot's log"));
            format!("{bar_s:.2} s after the recording's first sample{}", in_robot_log.unwrap_or_default())
        });
        let joint = place.joint.map(|joint| format!("joint {joint} of the bar"));
        [files, joint, instant].into_iter().flatten().collect::<Vec<_>>().join("; ")
    }

    fn number(&self, run: usize) -> String {
        format!("Run {} of {}", run + 1, self.runs.len())
    }

    /// Section on the residuals of the encoders from the geometry that fits best.
    fn deviations(&self) -> Markup {
        let Some(deviations) = self.refusal.deviations else { return html! {} };
        html! {
            h2 { "Encoders against the robot" }
            figure {
                div.panels.three {
                    @for panel in figures::deviations(deviations, self.refusal.place.bar_s) { (panel) }
                }
                figcaption {
                    "Measured minus predicted angle of each encoder, for the geometry that fits best, with less weight near singular "
                    "poses of the bar. Waves show errors of the geometry. A step of one encoder alone shows a slip. Steps of several "
                    "encoders, in proportion to their speeds, show a step of a clock"
                    @if !deviations.local_shifts.is_empty() {
                        "; the last figure is the time shift of the logs in each 5 s, relative to the whole run"
                    }
                    "." @if self.refusal.place.bar_s.is_some() { (MARKED) }
                }
            }
        }
    }

    fn run(&self, number: usize, [recording, robot_log]: &[InspectedLog; 2]) -> Markup {
        let place = (self.refusal.run == Some(number)).then_some(&self.refusal.place);
        let name = (self.runs.len() > 1).then(|| self.number(number));
        html! {
            (log("Recording of the bar", name.as_deref(), recording, place.and_then(|place| place.bar_s)))
            (log("Robot's log", name.as_deref(), robot_log, place.and_then(|place| place.robot_s)))
        }
    }
}

/// Section on the content of one log of a run. The time `at_s` is marked in the figures.
fn log(what: &str, run: Option<&str>, log: &InspectedLog, at_s: Option<f64>) -> Markup {
    let panels = figures::joints(&log.curves, at_s);
    let found = &log.inspection;
    html! {
        h2 {
            (what)
            @if let Some(run) = run { span.run { " · " (run) } }
            span.run { " · " (log.path.display()) }
        }
        @if found.suspicious.is_empty() { p.note { "Nothing suspicious." } }
        @else { ul.suspicious { @for sentence in &found.suspicious { li { (sentence) } } } }
        @if !panels.is_empty() {
            figure {
                div.panels.three { @for panel in panels { (panel) } }
                figcaption {
                    "Joints by this log alone, on its own clock."
                    @if at_s.is_some() { (MARKED) }
                }
            }
        }
        div.columns {
            table {
                caption { "What is in it" }
                tbody { (rows(&found.facts)) }
            }
            @for group in found.joints_by_unit() { (joints(group)) }
        }
    }
}

/// Table of joints that have the same unit.
fn joints(group: &[JointLine]) -> Markup {
    let unit = group.first().map_or("", |joint| joint.kind.display_symbol());
    html! {
        table {
            caption { "Its joints" }
            thead { tr {
                th { "joint" } th { "from [" (unit) "]" } th { "to [" (unit) "]" } th { "fastest [" (unit) "/s]" }
            } }
            tbody { @for joint in group { tr {
                td { (joint.name) }
                td { (format!("{:.2}", joint.range[0])) }
                td { (format!("{:.2}", joint.range[1])) }
                td { (format!("{:.2}", joint.speed_max)) }
            } } }
        }
    }
}

/// Splits a message into problem and remedy. Messages of this program end with the remedy, which begins after the last
/// semicolon, full stop or line break.
fn parts(message: &str) -> (&str, Option<&str>) {
    let separators = ["; ", ". ", "\n"];
    let last = separators.iter().filter_map(|mark| Some((message.rfind(mark)?, mark.len()))).max();
    match last {
        Some((at, length)) => (message[..at].trim_end(), Some(message[at + length..].trim())),
        None => (message, None),
    }
}

/// The text as a sentence, with a capital and a full stop.
fn capitalised(text: &str) -> String {
    let mut letters = text.chars();
    let first = letters.next().map(char::to_uppercase);
    let sentence: String = first.into_iter().flatten().chain(letters).collect();
    if sentence.ends_with(['.', '?', '!']) { sentence } else { sentence + "." }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::CalibrateError;
    use crate::prepare::{ComparedLog, PrepareError};
    use crate::solver::Unidentifiable;

    #[test]
    fn a_message_falls_apart_into_what_is_wrong_and_what_to_do() {
        let fits = "\n  --encoders 1,2 for one; and. so\n  --encoders 2,1 for another".to_owned();
        let what = "dependent rd2|rd3 (fix 1); dependent ra1|ox (fix 1)".to_owned();
        let messages = [
            (PrepareError::LittleMotion.to_string(), "insufficient excitation", "move the bar"),
            (PrepareError::AmbiguousEncoderMap { fits }.to_string(), "--encoders 2,1", "Check on the bar"),
            (
                PrepareError::NoMatch {
                    other: ComparedLog::Recording,
                    correlation: 0.3,
                    overlap_s: 20.0,
                    needed: 0.9,
                }
                .to_string(),
                "0.30",
                "give the log of this run",
            ),
            (
                CalibrateError::from(Unidentifiable { rank: 1, columns: 3, what, fix: "rd2,ra1".into() })
                    .to_string(),
                "ra1|ox (fix 1)",
                "Fix some",
            ),
        ];
        for (message, wrong, remedy) in messages {
            let found = parts(&message);
            assert!(found.0.contains(wrong) && found.1.unwrap().starts_with(remedy), "{found:?}");
        }
        assert_eq!(parts("nothing more"), ("nothing more", None));
    }

    #[test]
    fn sentences_begin_and_end_as_such() {
        assert_eq!(capitalised("a clock jumps"), "A clock jumps.");
        assert_eq!(capitalised("is it of this run?"), "Is it of this run?");
    }
}
