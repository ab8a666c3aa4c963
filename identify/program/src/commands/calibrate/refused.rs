//! Writes the page of a refused calibration, and returns a message with the path of the page.

use std::path::Path;

use anyhow::Context;
use shared::config::{self, RobotConfig};
use shared::output::explained;

use super::bar::RunFiles;
use super::experiment::ExperimentFile;
use crate::calibrate::CalibrateError;
use crate::calibrate::refusal::CalibrationRefusal;
use crate::report::page::{RefusedPage, WrittenRefusal};

/// Writes the page of a refused calibration, and returns the error as the terminal shows it, with the path of the page. If
/// the data are not the cause of the error, or if the page cannot be written, the error has no path. `runs` are the runs with
/// the ball-bar that were read before the error.
pub(super) fn refused(
    directory: &Path,
    robot: &RobotConfig,
    experiment: &ExperimentFile,
    runs: &[RunFiles<'_>],
    error: CalibrateError,
) -> anyhow::Error {
    let refused_run = match &error {
        CalibrateError::Prepare { run, .. } => runs.get(*run..=*run),
        _ => None,
    };
    let refused_rows = match &error {
        CalibrateError::NoPlace { data_set }
        | CalibrateError::Align { data_set, .. }
        | CalibrateError::Rows { data_set, .. } => {
            // Data sets of rows are numbered after the runs. If a file of rows cannot be read, `runs` is still empty.
            let bars = runs.len().max(experiment.bars.len());
            data_set.checked_sub(bars + 1).and_then(|index| experiment.rows().nth(index))
        }
        _ => experiment.rows().next(),
    };
    let names = match (refused_run, refused_rows) {
        (None, Some((_, rows))) => rows.file.display().to_string(),
        _ => {
            let name = |run: &RunFiles<'_>| {
                format!("{} with {}", run.recording_path.display(), run.log_path.display())
            };
            refused_run.unwrap_or(runs).iter().map(name).collect::<Vec<_>>().join(", ")
        }
    };
    let written = error.refusal().and_then(|refusal| {
        let written = write_page(directory, robot, experiment, runs, &refusal);
        let written = written.inspect_err(|why| {
            tracing::warn!("the page of this refusal cannot be written: {}", explained(why.as_ref()));
        });
        written.ok()
    });
    let error = anyhow::Error::new(error).context(names);
    let Some(WrittenRefusal { page, set_aside }) = written else { return error };
    let older = set_aside.map(|place| {
        format!("; the older calibration in {} is now in {}", directory.display(), place.display())
    });
    let (error, page) = (explained(error.as_ref()), page.display());
    anyhow::anyhow!("{error}\nnot calibrated: {page} shows what was found{}", older.unwrap_or_default())
}

fn write_page(
    directory: &Path,
    robot: &RobotConfig,
    experiment: &ExperimentFile,
    runs: &[RunFiles<'_>],
    refusal: &CalibrationRefusal<'_>,
) -> anyhow::Result<WrittenRefusal> {
    let bar = runs.first().map_or("", |run| run.bar.name.as_str());
    let page = RefusedPage {
        robot: &robot.name,
        instrument: experiment.rows().next().map_or(bar, |(kind, _)| kind.role()),
        measured: &runs.iter().filter_map(RunFiles::measured).collect::<Vec<_>>(),
        refusal,
        runs: &runs.iter().map(|run| run.sources_with_curves(robot)).collect::<Vec<_>>(),
        inputs: &experiment.inputs()?,
        // A page without its configuration is still useful.
        configuration: &config::to_toml(experiment).unwrap_or_else(|error| error.to_string()),
    };
    let written = page.write(directory).with_context(|| directory.display().to_string())?;
    if let Some(place) = &written.set_aside {
        experiment.set_aside(directory, place)?;
    }
    Ok(written)
}
