//! What is written and printed of a calibration from rows or from a mix.

use anyhow::Context;
use shared::config::{BallBarConfig, RobotConfig};
use shared::output::{say, show};

use super::experiment::Experiment;
use crate::model::Model;
use crate::report::file::CalibrationFile;
use crate::report::page::{Measured, MeasuredPage};
use crate::report::table;
use crate::solver::Solution;
use crate::study::workspace_error;

/// A calibration with everything that is told of it.
pub(super) struct Told<'a> {
    pub(super) robot: &'a RobotConfig,
    /// That of the first run, where there is one.
    pub(super) bar: Option<&'a BallBarConfig>,
    pub(super) file: CalibrationFile,
    /// Of the first data set.
    pub(super) model: &'a Model,
    pub(super) solution: &'a Solution,
    pub(super) data_sets: Vec<(String, Measured<'a>)>,
    /// For the terminal.
    pub(super) tables: String,
    /// That repeats it.
    pub(super) experiment: Experiment,
}

impl Told<'_> {
    /// Writes all files and the page into the directory and prints what a person needs at once.
    pub(super) fn write(self, directory: &std::path::Path) -> anyhow::Result<()> {
        let Self { robot, bar, file, model, solution, data_sets, tables, experiment } = self;
        let written = file.write(directory)?;
        file.write_robot(robot, bar, directory)?;
        let page = MeasuredPage {
            file: &file,
            workspace: &workspace_error(model, &solution.covariance, &robot.joint_limits()),
            data_sets: &data_sets,
            tables: &tables,
            configuration: &experiment.write(directory)?,
        };
        let page = page.write(directory).with_context(|| directory.display().to_string())?;
        show(table::calibration(&file))?;
        show(format_args!("\n{tables}"))?;
        say(format_args!("\n{}\n{}", written.display(), page.display()))?;
        Ok(())
    }
}
