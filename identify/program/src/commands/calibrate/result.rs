//! Writes the files of a calibration as far as its verdict allows, and prints its tables and summary.

use std::path::{Path, PathBuf};

use shared::config::{BallBarConfig, RobotConfig};
use shared::output::{say, show};

use super::experiment::ExperimentFile;
use crate::calibrate::validation::deployment::Deployment;
use crate::logs::RobotLogMapping;
use crate::report::result::deployments::files;
use crate::report::result::earlier::Earlier;
use crate::report::result::file::{CalibrationFile, replace};
use crate::report::summary::wrapped;
use crate::report::verdict::Grade;

/// Writes what the verdict allows and returns the paths: nothing if the calibrated robot predicts held-out data worse than the
/// nominal one, and nothing that could be applied if it predicts them no better. An earlier calibration is set aside if one of
/// its files would stay beside the new ones.
pub(super) fn write_files(
    file: &CalibrationFile,
    residuals: &str,
    robot: &RobotConfig,
    bar: Option<&BallBarConfig>,
    experiment: &ExperimentFile,
    log_mapping: Option<&RobotLogMapping>,
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
        written.extend(file.write_robot(robot, bar, log_mapping, directory)?);
    }
    Ok(written)
}

fn is_red(file: &CalibrationFile) -> bool {
    file.verdict.as_ref().is_some_and(|verdict| verdict.grade == Grade::Red)
}

/// Sentences on all that limits a calibration beside what its verdict names.
pub(super) fn limited(file: &CalibrationFile) -> String {
    let others = file.other_limits();
    others.map(|limit| format!("{} {}\n", if limit.serious { '!' } else { '-' }, limit.sentence)).collect()
}

/// Prints the tables of --verbose and the summary; a red verdict is an error.
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
