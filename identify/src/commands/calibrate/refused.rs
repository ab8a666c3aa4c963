//! What a refusal leaves: a page that shows what is known, and a message that says where it is.

use std::path::Path;

use anyhow::Context;
use serde::Serialize;
use shared::config::RobotConfig;
use shared::output::explained;

use super::bar::{BarArguments, RunFiles, input_files};
use super::experiment::{self, Experiment};
use super::{inputs, sources};
use crate::calibrate::CalibrateError;
use crate::calibrate::refusal::Refusal;
use crate::inspect::{self, curves};
use crate::report::page::{InspectedLog, InspectedRun, RefusedPage, WrittenRefusal};
use crate::report::result::file::MeasurementEntry;

/// What was to be calibrated, and from what.
struct Attempt<'a> {
    robot: &'a RobotConfig,
    instrument: &'a str,
    /// What each recording says of its measurement.
    measured: Vec<MeasurementEntry>,
    /// Every file that was read, with what it is.
    files: &'a [(&'static str, &'a Path)],
    configuration: String,
    /// `--out`.
    directory: &'a Path,
    /// File that says all of this, where there is one.
    read_from: Option<&'a Path>,
}

/// The error of a calibration from measured rows, as the terminal shows it; `files` begin with that of the rows.
pub(super) fn of_rows(
    directory: &Path,
    robot: &RobotConfig,
    files: &[(&'static str, &Path)],
    experiment: &Experiment,
    error: CalibrateError,
) -> anyhow::Error {
    let (instrument, path) = files.first().copied().unwrap_or(("", Path::new("")));
    let attempt = Attempt {
        robot,
        instrument,
        measured: Vec::new(),
        files,
        configuration: configuration(experiment),
        directory,
        read_from: experiment.read_from.as_deref(),
    };
    attempt.told(error, &path.display().to_string(), Vec::new)
}

/// The error of a calibration from runs with the ball-bar, as the terminal shows it.
pub(super) fn of_runs(
    arguments: &BarArguments,
    robot: &RobotConfig,
    runs: &[RunFiles<'_>],
    experiment: &Experiment,
    error: CalibrateError,
) -> anyhow::Error {
    let attempt = Attempt {
        robot,
        instrument: runs.first().map_or("", |run| run.bar.name.as_str()),
        measured: runs.iter().filter_map(RunFiles::measured).collect(),
        files: &input_files(arguments),
        configuration: configuration(&experiment.identify),
        directory: &arguments.common.result.out,
        read_from: experiment.read_from.as_deref(),
    };
    let of_one = match &error {
        CalibrateError::Prepare { run, .. } => runs.get(*run..=*run),
        _ => None,
    };
    let names = of_one.unwrap_or(runs).iter();
    let names = names.map(|run| format!("{} with {}", run.recording_path.display(), run.log_path.display()));
    let names = names.collect::<Vec<_>>().join(", ");
    attempt.told(error, &names, || runs.iter().map(inspected).collect())
}

/// Without its configuration a page is still of use.
fn configuration(config: &impl Serialize) -> String {
    toml::to_string(config).unwrap_or_else(|error| error.to_string())
}

impl Attempt<'_> {
    /// The error with the place of its page. Without a page, because the data are not to blame or because it cannot be made,
    /// it is the bare error. `names` says of what it is, `runs` looks at the inputs.
    fn told<'r>(
        &self,
        error: CalibrateError,
        names: &str,
        runs: impl FnOnce() -> Vec<InspectedRun<'r>>,
    ) -> anyhow::Error {
        let page = error.refusal().map(|refusal| self.page(&refusal, &runs()));
        let page = page.and_then(|page| {
            page.inspect_err(|why| {
                tracing::warn!("there is no page of this refusal: {}", explained(why.as_ref()))
            })
            .ok()
        });
        let refused = anyhow::Error::new(error).context(names.to_owned());
        match page {
            Some(page) => anyhow::anyhow!("{}\n{}", explained(refused.as_ref()), self.whereabouts(&page)),
            None => refused,
        }
    }

    fn page(&self, refusal: &Refusal<'_>, runs: &[InspectedRun<'_>]) -> anyhow::Result<WrittenRefusal> {
        let page = RefusedPage {
            robot: &self.robot.name,
            instrument: self.instrument,
            measured: &self.measured,
            refusal,
            runs,
            inputs: &inputs(self.files)?,
            configuration: &self.configuration,
        };
        let written = page.write(self.directory).with_context(|| self.directory.display().to_string())?;
        if let Some(place) = &written.set_aside {
            experiment::set_aside(self.directory, place, self.read_from)?;
        }
        Ok(written)
    }

    /// Where the page is, and what became of an older calibration.
    fn whereabouts(&self, written: &WrittenRefusal) -> String {
        let page = format!("not calibrated: {} shows what was found", written.page.display());
        match &written.set_aside {
            Some(place) => format!(
                "{page}; the older calibration in {} is now in {}",
                self.directory.display(),
                place.display()
            ),
            None => page,
        }
    }
}

fn inspected<'a>(run: &'a RunFiles<'_>) -> InspectedRun<'a> {
    let (cycles, encoders) = (run.cycles(), run.recording.encoders());
    InspectedRun {
        recording: InspectedLog {
            path: run.recording_path,
            inspection: sources::recording(&run.recording),
            curves: curves::of_bar(cycles, encoders),
        },
        robot_log: InspectedLog {
            path: run.log_path,
            inspection: inspect::robot_log(&run.log),
            curves: curves::of_robot(&run.log),
        },
    }
}
