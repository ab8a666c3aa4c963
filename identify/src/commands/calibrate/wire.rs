//! `identify calibrate wire`: poses with one measured length each.

use std::path::{Path, PathBuf};

use clap::Args;
use shared::config;
use shared::output::{say, show};

use super::{CommonArguments, RowArguments, inputs, refused};
use crate::calibrate::measured_length::{self, LengthOptions, LengthRow};
use crate::kinematics::flange_chain;
use crate::logs::{MeasuredLengthMapping, MeasuredLengths};
use crate::report::file::{CalibrationFile, ParameterEntry, SolveEntry};
use crate::report::table;

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

/// Reads, calibrates, writes and prints.
pub(super) fn run(arguments: &WireArguments) -> anyhow::Result<()> {
    let WireArguments { lengths, rows: RowArguments { mapping: mapping_path, hold_out, seed, fix }, common } =
        arguments;
    let robot = &common.robot()?;
    let mapping: MeasuredLengthMapping = config::load(mapping_path)?;
    let measured = MeasuredLengths::load(lengths, &mapping)?;
    let rows: Vec<LengthRow> = measured
        .rows
        .iter()
        .map(|row| LengthRow { joints_rad: row.q_rad, length_m: row.length_m, flange_m: row.flange_m })
        .collect();
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
    let sigma = |id| report.parameters.iter().find(|one| one.id == id).and_then(|one| one.sigma);
    let file = CalibrationFile::new(
        &robot.name,
        "measured lengths",
        SolveEntry::new("measured_length", &report.summary, &report.identifiability),
        None,
        inputs(&files)?,
        ParameterEntry::all(&report.model, sigma),
    );
    let written = file.write(&common.out)?;
    file.write_robot(robot, None, &common.out)?;
    show(table::calibration(&file))?;
    let lines: Vec<u64> = measured.rows.iter().map(|row| row.line).collect();
    show(format_args!("\n{}", table::lengths(&report, &lines)))?;
    say(format_args!("\n{}", written.display()))?;
    Ok(())
}
