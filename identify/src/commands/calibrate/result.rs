//! What is written and printed of a calibration from rows or from a mix.

use std::path::{Path, PathBuf};

use anyhow::Context;
use shared::config::{BallBarConfig, RobotConfig};
use shared::output::{say, show};

use super::ResultArguments;
use super::experiment::{self, Experiment};
use crate::calibrate::change::Changed;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::{Limit, ScaleFrom, of_changes, scale_sentence, workspace_error};
use crate::kinematics::flange_chain;
use crate::model::Model;
use crate::report::page::{Measured, MeasuredPage};
use crate::report::result::deployments::files;
use crate::report::result::file::CalibrationFile;
use crate::report::summary::{summary, wrapped};
use crate::report::table;
use crate::report::verdict::Grade;
use crate::solver::Solution;

/// A calibration with everything that is reported of it.
pub(super) struct Told<'a> {
    pub(super) robot: &'a RobotConfig,
    pub(super) file: CalibrationFile,
    /// Of the first data set.
    pub(super) model: &'a Model,
    pub(super) solution: &'a Solution,
    /// Each run's bar, with the file that states it.
    pub(super) bars: Vec<(&'a BallBarConfig, &'a Path)>,
    /// What fixes the scale, data set by data set.
    pub(super) scales: Vec<ScaleFrom>,
    /// What limits it.
    pub(super) limits: Vec<Limit>,
    /// What did not stay while it was measured.
    pub(super) changed: &'a [Changed],
    pub(super) data_sets: Vec<(String, Measured<'a>)>,
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
            model,
            solution,
            bars,
            scales,
            mut limits,
            changed,
            data_sets,
            tables,
            asked,
            experiment,
        } = self;
        let (covariance, limits_of_joints) = (&solution.covariance, robot.joint_limits());
        let workspace = workspace_error(model, covariance, &limits_of_joints);
        let workspace = workspace.with_cube(model, covariance, &limits_of_joints);
        limits.extend(of_changes(changed, flange_chain(robot).reach_m(), workspace.budget.expanded_m));
        let mut file =
            file.with_verdict(&workspace, &limits, experiment.identify.require_mm.map(|mm| mm * 1e-3));
        file.scale = Some(scale_sentence(bars.iter().copied(), scales, &workspace.budget));
        let bar = bars.first().map(|(bar, _)| *bar);
        let written = write_files(&file, robot, bar, &experiment, directory)?;
        let page = MeasuredPage {
            file: &file,
            workspace: &workspace,
            data_sets: &data_sets,
            tables: &tables,
            configuration: &experiment.write(directory)?,
        };
        let page = page.write(directory).with_context(|| directory.display().to_string())?;
        show(wrapped(&asked))?;
        let all = result.verbose.then(|| table::calibration(&file) + "\n" + &tables + &limited(&file));
        conclude(&file, all.as_deref(), &summary(&file, &workspace, &written, &page), &page)
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
