//! What is written and printed of a calibration from rows or from a mix.

use std::path::{Path, PathBuf};

use anyhow::Context;
use shared::config::{BallBarConfig, RobotConfig};
use shared::output::{say, show};

use super::ResultArguments;
use super::experiment::{self, Experiment};
use crate::calibrate::Calibration;
use crate::calibrate::rows::RowErrors;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::{Evidence, Limit, ScaleFrom, scale_sentence};
use crate::report::page::{Page, Source};
use crate::report::result::deployments::files;
use crate::report::result::file::CalibrationFile;
use crate::report::summary::{summary, wrapped};
use crate::report::table;
use crate::report::verdict::Grade;

/// A calibration with everything that is reported of it.
pub(super) struct Told<'a> {
    pub(super) robot: &'a RobotConfig,
    pub(super) file: CalibrationFile,
    pub(super) calibration: &'a Calibration,
    pub(super) evidence: &'a Evidence,
    /// What the logs of each run with a ball-bar say of themselves.
    pub(super) sources: &'a [Source],
    /// Each run's bar, with the file that states it.
    pub(super) bars: Vec<(&'a BallBarConfig, &'a Path)>,
    /// What fixes the scale, data set by data set.
    pub(super) scales: Vec<ScaleFrom>,
    /// What is wrong with files of rows.
    pub(super) rows_limits: Vec<Limit>,
    /// Each file of rows with its name.
    pub(super) rows: Vec<(String, &'a RowErrors)>,
    /// For the page, and for the terminal where all is printed.
    pub(super) tables: String,
    /// What a person asked for by an option, as lines of a terminal.
    pub(super) asked: String,
    /// That repeats it.
    pub(super) experiment: Experiment,
}

impl Told<'_> {
    /// Writes all files and the page into the directory and prints what a person needs at once.
    pub(super) fn write(self, result: &ResultArguments) -> anyhow::Result<()> {
        let directory = &result.out;
        let Self {
            robot,
            file,
            calibration,
            evidence,
            sources,
            bars,
            scales,
            rows_limits: mut all_limits,
            rows,
            tables,
            asked,
            experiment,
        } = self;
        let workspace = &evidence.workspace;
        all_limits.extend_from_slice(&evidence.limits);
        let mut file =
            file.with_verdict(workspace, &all_limits, experiment.identify.require_mm.map(|mm| mm * 1e-3));
        file.scale = Some(scale_sentence(bars.iter().copied(), scales, &workspace.budget));
        let bar = bars.first().map(|(bar, _)| *bar);
        let written = write_files(&file, robot, bar, &experiment, directory)?;
        let page = Page {
            file: &file,
            calibration,
            evidence,
            rows: &rows,
            tables: &tables,
            sources,
            configuration: &experiment.write(directory)?,
        };
        let page = page.write(directory).with_context(|| directory.display().to_string())?;
        show(wrapped(&asked))?;
        let all = result.verbose.then(|| table::calibration(&file) + "\n" + &tables + &limited(&file));
        conclude(&file, all.as_deref(), &summary(&file, workspace, &written, &page), &page)
    }
}

/// Writes what the verdict allows and returns the paths: nothing where held-out data are predicted worse than by the nominal
/// robot, and nothing that could be applied where they are predicted no better. An earlier calibration is set aside where one
/// of its files would stay beside the new ones.
pub(super) fn write_files(
    file: &CalibrationFile,
    robot: &RobotConfig,
    bar: Option<&BallBarConfig>,
    experiment: &Experiment,
    directory: &Path,
) -> anyhow::Result<Vec<PathBuf>> {
    let would_stay =
        |part: Deployment| !file.serves(part) && files(part).iter().any(|name| directory.join(name).exists());
    if (is_red(file) || Deployment::PARTIAL.into_iter().any(would_stay))
        && let Some(place) = file.set_earlier_aside(directory)?
    {
        experiment::set_aside(directory, &place, experiment.read_from.as_deref())?;
    }
    if is_red(file) {
        return Ok(Vec::new());
    }
    let mut written = vec![file.write(directory)?];
    if file.may_be_applied() {
        written.extend(file.write_robot(robot, bar, directory)?);
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

/// Prints what a person asked for and the last lines.
pub(super) fn conclude(
    file: &CalibrationFile,
    all: Option<&str>,
    summary: &str,
    page: &Path,
) -> anyhow::Result<()> {
    if let Some(all) = all {
        say(wrapped(all))?;
    }
    anyhow::ensure!(
        !is_red(file),
        "{}\nnot calibrated: {} shows what was found",
        file.verdict_sentence(),
        page.display()
    );
    Ok(show(summary)?)
}
