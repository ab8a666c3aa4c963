//! `identify calibrate --measured-poses`.

use std::path::Path;

use anyhow::Context;
use shared::config::{self, RobotConfig};

use super::{CalibrateArguments, inputs, refused};
use crate::calibrate::measured_pose::{self, PoseOptions, PoseReport, PoseRow};
use crate::kinematics::{Chain, flange_chain};
use crate::logs::{MeasuredPoseMapping, MeasuredPoses};
use crate::model::ParameterId;
use crate::report::file::{CalibrationFile, ParameterEntry, SolveEntry};
use crate::report::{poses, table};

fn rows(path: &Path, mapping: &MeasuredPoseMapping) -> anyhow::Result<Vec<PoseRow>> {
    let row = |row: &crate::logs::MeasuredPose| PoseRow {
        joints_rad: row.q_rad,
        position_m: row.position_m,
        rotation: row.rotation,
    };
    Ok(MeasuredPoses::load(path, mapping)?.rows.iter().map(row).collect())
}

fn is_wave(name: &str) -> bool {
    matches!(name.parse::<ParameterId>(), Ok(ParameterId::JointWave { .. }))
}

fn validations(
    arguments: &CalibrateArguments,
    mapping: &MeasuredPoseMapping,
    robot: &Chain,
    report: &PoseReport,
) -> anyhow::Result<Vec<poses::Validation>> {
    let one = |path: &std::path::PathBuf| {
        let figures = measured_pose::validate(&rows(path, mapping)?, robot, &report.model, arguments.seed)
            .with_context(|| path.display().to_string())?;
        Ok(poses::Validation { name: path.display().to_string(), figures })
    };
    arguments.validate.iter().map(one).collect()
}

pub(super) fn run(
    arguments: &CalibrateArguments,
    robot: &RobotConfig,
    poses_path: &Path,
    mapping_path: &Path,
) -> anyhow::Result<()> {
    let mapping: MeasuredPoseMapping = config::load(mapping_path)?;
    let rows = rows(poses_path, &mapping)?;
    let usual = PoseOptions::default();
    let options = PoseOptions {
        hold_out: arguments.hold_out.unwrap_or(usual.hold_out),
        seed: arguments.seed,
        waves_per_turn_max: arguments.joint_waves,
        loss: arguments.loss.unwrap_or(usual.loss),
        ..usual
    };
    let chain = flange_chain(robot);
    let files: [(&str, &Path); 3] =
        [("measured poses", poses_path), ("mapping", mapping_path), ("robot", &arguments.robot)];
    let report = measured_pose::calibrate(&rows, &chain, &options)
        .map_err(|error| refused::of_rows(arguments, robot, &files, &options, error))?;
    let validations = validations(arguments, &mapping, &chain, &report)?;
    let sigma = |id| report.sigmas.iter().find(|one| one.0 == id).map(|one| one.1);
    let mut solve = SolveEntry::new(report.cost, &report.summary, &report.identifiability);
    solve.parameters = report.model.columns().len();
    let file = CalibrationFile::new(
        &robot.name,
        "measured poses",
        solve,
        None,
        inputs(&files)?,
        ParameterEntry::all(&report.model, sigma),
    );
    let written = file.write(&arguments.out)?;
    file.write_robot(robot, None, &arguments.out)?;
    let mut without_waves = file;
    without_waves.parameters.retain(|entry| !is_wave(&entry.name));
    print!("{}", table::calibration(&without_waves));
    print!("\n{}", poses::table(&report, &validations));
    println!("\n{}", written.display());
    Ok(())
}
