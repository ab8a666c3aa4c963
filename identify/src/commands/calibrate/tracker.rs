//! `identify calibrate tracker`: positions or poses measured by a tracker.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::config::{self, RobotConfig};

use super::experiment::{Experiment, RowFile};
use super::result::Told;
use super::{CommonArguments, RowArguments, inputs, refused};
use crate::calibrate::IdentifyConfig;
use crate::calibrate::measured_pose::{self, PoseOptions, PoseReport, WAVES_PER_TURN_MAX};
use crate::instrument::PoseRow;
use crate::kinematics::{Chain, flange_chain};
use crate::logs::{MeasuredPoseMapping, MeasuredPoses, joints_of_robot};
use crate::model::JointWaves;
use crate::report::file::{CalibrationFile, ParameterEntry, SolveEntry};
use crate::report::page::Measured;
use crate::report::rows as of_rows;
use crate::report::validation::RowsEntry;
use crate::solver::LossName;

/// What a calibration with a tracker is told.
#[derive(Debug, Args)]
pub struct TrackerArguments {
    /// Poses measured by a tracker (.csv), rows in the order of the robot's motion
    #[arg(value_name = "FILE")]
    poses: PathBuf,
    #[command(flatten)]
    rows: RowArguments,
    /// Other files of measured poses that judge the robot; tracker and probe may be elsewhere
    #[arg(long, value_name = "FILES", value_delimiter = ',')]
    validate: Vec<PathBuf>,
    /// Highest number of waves per turn that the errors of joints may have; 3 to 127
    #[arg(long, value_name = "N", default_value_t = WAVES_PER_TURN_MAX,
          value_parser = clap::value_parser!(u8).range(i64::from(JointWaves::FIRST)..=i64::from(JointWaves::LAST)))]
    joint_waves: u8,
    /// How much rows count that do not fit; default: huber
    #[arg(long)]
    loss: Option<LossName>,
    #[command(flatten)]
    common: CommonArguments,
}

/// The rows of a file, read as the file of its mapping says.
pub(super) fn rows(path: &Path, mapping: &Path, robot: &RobotConfig) -> anyhow::Result<Vec<PoseRow>> {
    let of_file: MeasuredPoseMapping = config::load(mapping)?;
    joints_of_robot(&of_file.joints, robot, mapping)?;
    Ok(MeasuredPoses::load(path, &of_file)?.rows.iter().map(PoseRow::from).collect())
}

impl TrackerArguments {
    /// As an experiment's file says.
    pub(super) fn of(
        of: &RowFile,
        rows: RowArguments,
        config: &IdentifyConfig,
        common: CommonArguments,
    ) -> Self {
        Self {
            poses: of.file.clone(),
            rows,
            validate: of.validate.clone(),
            joint_waves: of.joint_waves.unwrap_or(WAVES_PER_TURN_MAX),
            loss: config.loss,
            common,
        }
    }

    fn experiment(&self) -> Experiment {
        let (mut experiment, rows) = Experiment::of_rows(&self.common, &self.rows, &self.poses);
        experiment.identify.loss = self.loss;
        let (joint_waves, validate) = (Some(self.joint_waves), self.validate.clone());
        experiment.trackers.push(RowFile { joint_waves, validate, ..rows });
        experiment
    }
}

/// The calibrated robot on rows of other files.
fn validations(
    others: &[(&PathBuf, Vec<PoseRow>)],
    robot: &Chain,
    report: &PoseReport,
    seed: u64,
) -> anyhow::Result<Vec<of_rows::Validation>> {
    let one = |(path, rows): &(&PathBuf, Vec<PoseRow>)| {
        let figures = measured_pose::validate(rows, robot, &report.model, seed)
            .with_context(|| path.display().to_string())?;
        Ok(of_rows::Validation { name: path.display().to_string(), figures })
    };
    others.iter().map(one).collect()
}

/// Reads, calibrates, writes and prints.
pub(super) fn run(arguments: &TrackerArguments) -> anyhow::Result<()> {
    let TrackerArguments { poses: path, validate, joint_waves, loss, common, .. } = arguments;
    let RowArguments { mapping: mapping_path, hold_out, seed, fix } = &arguments.rows;
    let robot = &common.robot()?;
    let measured = rows(path, mapping_path, robot)?;
    // Read before the fit: a file that is missing is said at once.
    let others = validate.iter().map(|path| Ok((path, rows(path, mapping_path, robot)?)));
    let others = others.collect::<anyhow::Result<Vec<_>>>()?;
    let usual = PoseOptions::default();
    let options = PoseOptions {
        hold_out: hold_out.unwrap_or(usual.hold_out),
        seed: *seed,
        waves_per_turn_max: *joint_waves,
        loss: loss.unwrap_or(usual.loss),
        fix: fix.clone(),
        ..usual
    };
    let chain = flange_chain(robot);
    let files: [(&str, &Path); 3] =
        [("measured poses", path), ("mapping", mapping_path), ("robot", &common.robot)];
    let report = measured_pose::calibrate(&measured, &chain, &options)
        .map_err(|error| refused::of_rows(common, robot, &files, &options, error))?;
    let validations = validations(&others, &chain, &report, *seed)?;
    let solution = &report.solution;
    let mut file = CalibrationFile::new(
        &robot.name,
        "measured poses",
        SolveEntry::new(report.cost, &solution.summary, &solution.identifiability),
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
        held_out: report.held_out,
    }];
    let told = Told {
        robot,
        bar: None,
        file,
        model: &report.model,
        solution,
        limits: Vec::new(),
        data_sets: vec![("tracker".into(), Measured::Rows(&report.errors))],
        tables: of_rows::poses(&report, &validations),
        experiment: arguments.experiment(),
    };
    told.write(&common.out)
}
