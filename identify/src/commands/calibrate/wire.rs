//! `identify calibrate wire`: poses with one measured length each.

use std::path::{Path, PathBuf};

use clap::Args;
use shared::config::{self, RobotConfig};

use super::experiment::{Experiment, RowFile};
use super::result::Told;
use super::{CommonArguments, RowArguments, inputs, refused};
use crate::calibrate::measured_length::{self, LengthOptions};
use crate::instrument::LengthRow;
use crate::kinematics::flange_chain;
use crate::logs::{MeasuredLength, MeasuredLengthMapping, MeasuredLengths, joints_of_robot};
use crate::report::file::{CalibrationFile, ParameterEntry, SolveEntry};
use crate::report::page::Measured;
use crate::report::rows as of_rows;
use crate::report::validation::RowsEntry;

/// What a calibration with a draw-wire or a telescoping bar is told.
#[derive(Debug, Args)]
pub struct WireArguments {
    /// Poses with one measured length each (.csv)
    #[arg(value_name = "FILE")]
    lengths: PathBuf,
    #[command(flatten)]
    rows: RowArguments,
    #[command(flatten)]
    common: CommonArguments,
}

impl WireArguments {
    /// As an experiment's file says.
    pub(super) fn of(of: &RowFile, rows: RowArguments, common: CommonArguments) -> Self {
        Self { lengths: of.file.clone(), rows, common }
    }
}

/// The rows of a file, read as the file of its mapping says, and the line of each.
pub(super) fn rows(
    path: &Path,
    mapping: &Path,
    robot: &RobotConfig,
) -> anyhow::Result<(Vec<LengthRow>, Vec<u64>)> {
    let of_file: MeasuredLengthMapping = config::load(mapping)?;
    joints_of_robot(&of_file.joints, robot, mapping)?;
    let row = |row: &MeasuredLength| {
        (LengthRow { joints_rad: row.q_rad, length_m: row.length_m, flange_m: row.flange_m }, row.line)
    };
    Ok(MeasuredLengths::load(path, &of_file)?.rows.iter().map(row).unzip())
}

/// Reads, calibrates, writes and prints.
pub(super) fn run(arguments: &WireArguments) -> anyhow::Result<()> {
    let WireArguments { lengths, rows: RowArguments { mapping: mapping_path, hold_out, seed, fix }, common } =
        arguments;
    let robot = &common.robot()?;
    let (rows, lines) = rows(lengths, mapping_path, robot)?;
    let usual = LengthOptions::default();
    let options = LengthOptions {
        seed: *seed,
        hold_out: hold_out.unwrap_or(usual.hold_out),
        fix: fix.clone(),
        ..usual
    };
    let files: [(&str, &Path); 3] =
        [("measured lengths", lengths), ("mapping", mapping_path), ("robot", &common.robot)];
    let report = measured_length::calibrate(&rows, &flange_chain(robot), &options)
        .map_err(|error| refused::of_rows(common, robot, &files, &options, error))?;
    let solution = &report.solution;
    let mut file = CalibrationFile::new(
        &robot.name,
        "measured lengths",
        SolveEntry::new("measured_length", &solution.summary, &solution.identifiability),
        None,
        inputs(&files)?,
        ParameterEntry::all(&report.model, |id| report.sigma(id)),
    )
    .with_knowledge(solution);
    file.candidates.clone_from(&report.terms);
    file.rows = vec![RowsEntry {
        data_set: 1,
        hold_out: options.hold_out,
        seed: options.seed,
        fitted: report.fitted,
        held_out: report.held_out_with_rejected,
    }];
    let (mut experiment, row_file) = Experiment::of_rows(common, &arguments.rows, lengths);
    experiment.wires.push(row_file);
    let told = Told {
        robot,
        bar: None,
        file,
        model: &report.model,
        solution,
        limits: Vec::new(),
        data_sets: vec![("wire".into(), Measured::Rows(&report.errors))],
        tables: of_rows::lengths(&report, &lines),
        experiment,
    };
    told.write(&common.out)
}
