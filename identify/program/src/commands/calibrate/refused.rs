//! What a refusal leaves: a page that shows what is known, and a message that says where it is.

use std::path::Path;

use anyhow::Context;
use shared::config::RobotConfig;
use shared::output::explained;

use super::bar::RunFiles;
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

/// The error of a calibration, as the terminal shows it; `runs` are those with the ball-bar, as far as they were read.
pub(super) fn refused(
    directory: &Path,
    robot: &RobotConfig,
    experiment: &Experiment,
    runs: &[RunFiles<'_>],
    error: CalibrateError,
) -> anyhow::Error {
    let files = &experiment.files();
    let of_one = match &error {
        CalibrateError::Prepare { run, .. } => runs.get(*run..=*run),
        _ => None,
    };
    let first_rows = experiment.rows().next();
    let names = match (of_one, first_rows) {
        (None, Some((_, rows))) => rows.file.display().to_string(),
        _ => {
            let name = |run: &RunFiles<'_>| {
                format!("{} with {}", run.recording_path.display(), run.log_path.display())
            };
            of_one.unwrap_or(runs).iter().map(name).collect::<Vec<_>>().join(", ")
        }
    };
    let bar = runs.first().map_or("", |run| run.bar.name.as_str());
    let attempt = Attempt {
        robot,
        instrument: first_rows.map_or(bar, |(kind, _)| kind.role()),
        measured: runs.iter().filter_map(RunFiles::measured).collect(),
        files,
        // Without its configuration a page is still of use.
        configuration: toml::to_string(experiment).unwrap_or_else(|error| error.to_string()),
        directory,
        read_from: experiment.read_from.as_deref(),
    };
    attempt.told(error, &names, || runs.iter().map(inspected).collect())
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
