//! Writes the files of a calibration that the verdict allows, and prints the tables and the summary.

use std::path::{Path, PathBuf};

use shared::config::{BallBarConfig, RobotConfig};
use shared::output::{say, show};

use super::experiment::ExperimentFile;
use crate::calibrate::validation::deployment::Deployment;
use crate::logs::LoggedJoints;
use crate::report::result::deployments::files;
use crate::report::result::earlier::Earlier;
use crate::report::result::file::{CalibrationFile, replace};
use crate::report::summary::wrapped;
use crate::report::verdict::Grade;

/// Writes the files that the verdict allows and returns their paths. If the calibrated robot predicts held-out data
/// significantly worse than the nominal robot, no file is written. If it does not predict all held-out data better, the
/// files for controllers are not written. An earlier calibration is moved to another directory if one of its files would
/// remain beside the new files.
pub(super) fn write_files(
    file: &CalibrationFile,
    residuals: &str,
    robot: &RobotConfig,
    bar: Option<&BallBarConfig>,
    experiment: &ExperimentFile,
    logged: Option<&LoggedJoints>,
    directory: &Path,
) -> anyhow::Result<Vec<PathBuf>> {
    let has_stale_files = |deployment: Deployment| {
        !file.serves(deployment) && files(deployment).iter().any(|name| directory.join(name).exists())
    };
    if (is_red(file) || Deployment::PARTIAL.into_iter().any(has_stale_files))
        && let Some(place) = Earlier::in_directory(directory).map(Earlier::set_aside).transpose()?
    {
        experiment.set_aside(directory, &place)?;
    }
    if is_red(file) {
        return Ok(Vec::new());
    }
    let mut written = vec![file.write(directory)?, replace(directory, "residuals.csv", residuals)?];
    if file.may_be_applied() {
        written.extend(file.write_robot(robot, bar, logged, directory)?);
    }
    Ok(written)
}

fn is_red(file: &CalibrationFile) -> bool {
    file.verdict.as_ref().is_some_and(|verdict| verdict.grade == Grade::Red)
}

/// Sentences about all limits of a calibration that the verdict does not name.
pub(super) fn limited(file: &CalibrationFile) -> String {
    let others = file.other_limits();
    others.map(|limit| format!("{} {}\n", if limit.serious { '!' } else { '-' }, limit.sentence)).collect()
}

/// Prints the tables of `--verbose` and the summary. A red verdict is returned as an error.
pub(super) fn conclude(
    file: &CalibrationFile,
    verbose: Option<&str>,
    summary: &str,
    page: &Path,
) -> anyhow::Result<()> {
    if let Some(tables) = verbose {
        say(wrapped(tables))?;
    }
    anyhow::ensure!(
        !is_red(file),
        "{}\nnot calibrated: {} shows what was found",
        file.verdict_sentence(),
        page.display()
    );
    Ok(show(summary)?)
}
