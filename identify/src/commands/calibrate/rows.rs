//! Files of rows, each a pose of the robot and what was measured there: `identify calibrate tracker`, `wire` and `contact`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::config::{self, RobotConfig};

use super::experiment::{self, Experiment};
use super::result::Told;
use super::{CommonArguments, ResultArguments, RowArguments, inputs, refused, usual_seed};
use crate::calibrate::HoldOut;
use crate::calibrate::mix::{Measured, Rows};
use crate::calibrate::rows::{RowCalibration, RowOptions, WAVES_PER_TURN_MAX, tracker, wire};
use crate::evaluate::{ScaleFrom, Validity, of_lengths};
use crate::instrument::{ContactRow, LengthRow, PoseRow, SocketTable};
use crate::kinematics::flange_chain;
use crate::logs::{
    ContactMapping, Contacts, MeasuredLength, MeasuredLengthMapping, MeasuredLengths, MeasuredPoseMapping,
    MeasuredPoses, joints_of_robot,
};
use crate::model::{JointWaves, ParameterId};
use crate::report::deployments::DeploymentEntry;
use crate::report::file::{CalibrationFile, ParameterEntry, SolveEntry};
use crate::report::page;
use crate::report::rows as of_rows;
use crate::report::validation::RowsEntry;
use crate::solver::LossName;
use serde::{Deserialize, Serialize};

/// Options of a calibration with a tracker.
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

/// Options of a calibration with a draw-wire or a telescoping bar.
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

/// Options of a calibration with a ball in sockets.
#[derive(Debug, Args)]
pub struct ContactArguments {
    /// Poses at which the ball is seated, and in which socket (.csv), rows in the order of the robot's motion
    #[arg(value_name = "FILE")]
    contacts: PathBuf,
    /// Where the sockets are on their plate, or their distances, such as config/sockets.toml
    #[arg(long, value_name = "FILE")]
    sockets: PathBuf,
    #[command(flatten)]
    rows: RowArguments,
    /// How much rows count that do not fit; default: huber
    #[arg(long)]
    loss: Option<LossName>,
    #[command(flatten)]
    common: CommonArguments,
}

/// A file of rows as an experiment has it: the keys of a block in an experiment's file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RowFile {
    /// The rows.
    pub file: PathBuf,
    /// Which of its columns is what.
    pub mapping: PathBuf,
    /// Of a ball in sockets, which needs it: the table of these.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sockets: Option<PathBuf>,
    /// Which rows are held out together; absent: regions of poses, rows of lengths and contacts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hold_out: Option<HoldOut>,
    /// Decides which; absent: the instrument's usual one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// Of a tracker alone: highest number of waves per turn that the errors of joints may have.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint_waves: Option<u8>,
    /// Of a tracker alone: other files that judge the robot.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub validate: Vec<PathBuf>,
}

impl RowFile {
    fn new(file: &Path, rows: &RowArguments) -> Self {
        Self {
            file: file.to_owned(),
            mapping: rows.mapping.clone(),
            sockets: None,
            hold_out: rows.hold_out,
            seed: Some(rows.seed),
            joint_waves: None,
            validate: Vec::new(),
        }
    }
}

pub(super) fn run_tracker(arguments: &TrackerArguments) -> anyhow::Result<()> {
    let TrackerArguments { poses, rows, validate, joint_waves, loss, common } = arguments;
    let mut experiment = Experiment::of_rows(common, &rows.fix, *loss);
    let (joint_waves, validate) = (Some(*joint_waves), validate.clone());
    experiment.trackers.push(RowFile { joint_waves, validate, ..RowFile::new(poses, rows) });
    experiment::calibrate(experiment, &common.result)
}

pub(super) fn run_wire(WireArguments { lengths, rows, common }: &WireArguments) -> anyhow::Result<()> {
    let mut experiment = Experiment::of_rows(common, &rows.fix, None);
    experiment.wires.push(RowFile::new(lengths, rows));
    experiment::calibrate(experiment, &common.result)
}

pub(super) fn run_contact(arguments: &ContactArguments) -> anyhow::Result<()> {
    let ContactArguments { contacts, sockets, rows, loss, common } = arguments;
    let mut experiment = Experiment::of_rows(common, &rows.fix, *loss);
    experiment.contacts.push(RowFile { sockets: Some(sockets.clone()), ..RowFile::new(contacts, rows) });
    experiment::calibrate(experiment, &common.result)
}

/// The instruments whose measurements are rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Tracker,
    Wire,
    Contact,
}

impl Kind {
    /// The name of its blocks in an experiment's file.
    pub(super) const fn key(self) -> &'static str {
        match self {
            Self::Tracker => "tracker",
            Self::Wire => "wire",
            Self::Contact => "contact",
        }
    }

    /// What its rows are, for a person.
    pub(super) const fn role(self) -> &'static str {
        match self {
            Self::Tracker => "measured poses",
            Self::Wire => "measured lengths",
            Self::Contact => "seated balls",
        }
    }
}

/// A file of rows as it was read.
pub(super) struct Read {
    pub(super) rows: Rows,
    /// Of each row in its file.
    pub(super) lines: Vec<u64>,
}

/// The rows of a file, read as the file of its mapping says.
pub(super) fn read(kind: Kind, of: &RowFile, robot: &RobotConfig) -> anyhow::Result<Read> {
    let (measured, lines) = match kind {
        Kind::Tracker => {
            let (rows, lines) = poses(&of.file, &of.mapping, robot)?;
            (Measured::Poses(rows), lines)
        }
        Kind::Wire => {
            let mapping: MeasuredLengthMapping = config::load(&of.mapping)?;
            joints_of_robot(&mapping.joints, robot, &of.mapping)?;
            let row = |row: &MeasuredLength| {
                (
                    LengthRow { joints_rad: row.q_rad, length_m: row.length_m, flange_m: row.flange_m },
                    row.line,
                )
            };
            let (rows, lines) = MeasuredLengths::load(&of.file, &mapping)?.rows.iter().map(row).unzip();
            (Measured::Lengths(rows), lines)
        }
        Kind::Contact => {
            let sockets = of.sockets.as_deref().context("a table of sockets is missing")?;
            let table: SocketTable = config::load(sockets)?;
            let mapping: ContactMapping = config::load(&of.mapping)?;
            joints_of_robot(&mapping.joints, robot, &of.mapping)?;
            let read = Contacts::load(&of.file, &mapping, &table.names())?;
            let (rows, lines) = read.rows.iter().map(|row| (ContactRow::from(row), row.line)).unzip();
            (Measured::Contacts(rows, table), lines)
        }
    };
    Ok(Read { rows: Rows { measured, hold_out: of.hold_out, seed: of.seed }, lines })
}

/// Rows of a file, and the line of each.
type Lines = (Vec<PoseRow>, Vec<u64>);

fn poses(path: &Path, mapping: &Path, robot: &RobotConfig) -> anyhow::Result<Lines> {
    let of_file: MeasuredPoseMapping = config::load(mapping)?;
    joints_of_robot(&of_file.joints, robot, mapping)?;
    let read = MeasuredPoses::load(path, &of_file)?;
    Ok(read.rows.iter().map(|row| (PoseRow::from(row), row.line)).unzip())
}

/// The calibrated robot on rows of other files.
fn validations(
    others: &[(&PathBuf, Lines)],
    robot: &RobotConfig,
    validity: &Validity,
    found: &RowCalibration,
    seed: u64,
) -> anyhow::Result<Vec<of_rows::Validation>> {
    let one = |(path, (rows, lines)): &(&PathBuf, Lines)| {
        let name = path.display().to_string();
        let figures = tracker::validate(rows, robot, &found.model, seed).with_context(|| name.clone())?;
        let joints = rows.iter().map(|row| row.joints_rad);
        Ok(of_rows::Validation { name, figures, outside: of_rows::outside(validity, joints, lines) })
    };
    others.iter().map(one).collect()
}

/// Calibrates from one file with nothing beside it, writes and prints.
pub(super) fn alone(
    experiment: Experiment,
    kind: Kind,
    robot: &RobotConfig,
    read: Read,
    result: &ResultArguments,
) -> anyhow::Result<()> {
    let Some(of) = experiment.rows().next().map(|(_, of)| of) else { anyhow::bail!("there are no rows") };
    // Read before the fit: a file that is missing is said at once.
    let others = of.validate.iter().map(|path| Ok((path, poses(path, &of.mapping, robot)?)));
    let others = others.collect::<anyhow::Result<Vec<_>>>()?;
    let usual = if kind == Kind::Wire { RowOptions::wire() } else { RowOptions::tracker() };
    let fix = experiment.identify.fix.iter().map(|name| name.parse());
    let options = RowOptions {
        hold_out: of.hold_out.unwrap_or(usual.hold_out),
        seed: of.seed.unwrap_or_else(usual_seed),
        loss: experiment.identify.loss.unwrap_or(usual.loss),
        waves_per_turn_max: of.joint_waves.unwrap_or(usual.waves_per_turn_max),
        fix: fix.collect::<Result<Vec<ParameterId>, _>>()?,
        ..usual
    };
    let found = match &read.rows.measured {
        Measured::Poses(rows) => tracker::calibrate(rows, robot, &options),
        Measured::Lengths(rows) => wire::calibrate(rows, robot, &options),
        Measured::Contacts(..) => return experiment::mixed(experiment, robot, vec![read], result),
    };
    let bar = experiment.bar_arguments(result);
    let files = experiment.files(&bar, &[]);
    let found = found.map_err(|error| refused::of_rows(&result.out, robot, &files, &options, error))?;
    let validity = Validity::of(read.rows.joints().into_iter(), &flange_chain(robot));
    let validations = validations(&others, robot, &validity, &found, options.seed)?;
    let solution = &found.solution;
    let scale = if kind == Kind::Wire { ScaleFrom::Wire } else { ScaleFrom::Tracker };
    let mut file = CalibrationFile::new(
        &robot.name,
        kind.role(),
        SolveEntry::new(found.cost, &solution.summary, &solution.identifiability),
        None,
        inputs(&files)?,
        ParameterEntry::all(&found.model, |id| found.sigma(id)),
    )
    .with_knowledge(solution);
    file.candidates.clone_from(&found.terms);
    file.validity = Some(validity);
    file.deployments = found.deployed.iter().map(DeploymentEntry::from).collect();
    file.rows = vec![RowsEntry {
        data_set: 1,
        hold_out: options.hold_out,
        seed: options.seed,
        fitted: found.fitted(),
        held_out: found.held_out_with_rejected(),
    }];
    let tables = match kind {
        Kind::Wire => of_rows::lengths(&found, &read.lines),
        _ => of_rows::poses(&found, &validations),
    };
    let told = Told {
        robot,
        bar: None,
        file,
        model: &found.model,
        solution,
        limits: of_lengths(&found.model, solution, std::iter::once(scale)),
        changed: &found.changed,
        data_sets: vec![(kind.key().into(), page::Measured::Rows(&found.errors))],
        tables,
        asked: validations.iter().map(of_rows::Validation::line).collect(),
        experiment: experiment.clone(),
    };
    told.write(result)
}
