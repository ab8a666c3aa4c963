//! Files of rows, each a pose of the robot and what was measured there: `identify calibrate tracker`, `wire` and `contact`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::config::{self, RobotConfig};

use super::experiment::{self, Experiment};
use super::{CommonArguments, RowArguments};
use crate::calibrate::HoldOut;
use crate::calibrate::mix::{Measured, Rows};
use crate::calibrate::rows::{WAVES_PER_TURN_MAX, tracker};
use crate::evaluate::Validity;
use crate::instrument::{ContactRow, LengthRow, PoseRow, SocketTable};
use crate::logs::{
    ContactMapping, Contacts, MeasuredLength, MeasuredLengthMapping, MeasuredLengths, MeasuredPoseMapping,
    MeasuredPoses, joints_of_robot,
};
use crate::model::{JointWaves, Model};
use crate::report::rows as of_rows;
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
    /// Decides which; absent: that of the command line.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// Highest number of waves per turn that the errors of joints may have; the lowest of all files counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint_waves: Option<u8>,
    /// Of a tracker: other files that judge the robot.
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
    Ok(Read {
        rows: Rows { measured, hold_out: of.hold_out, seed: of.seed, joint_waves: of.joint_waves },
        lines,
    })
}

/// Rows of a file, and the line of each.
type Lines = (Vec<PoseRow>, Vec<u64>);

fn poses(path: &Path, mapping: &Path, robot: &RobotConfig) -> anyhow::Result<Lines> {
    let of_file: MeasuredPoseMapping = config::load(mapping)?;
    joints_of_robot(&of_file.joints, robot, mapping)?;
    let read = MeasuredPoses::load(path, &of_file)?;
    Ok(read.rows.iter().map(|row| (PoseRow::from(row), row.line)).unzip())
}

/// A calibrated robot on the rows of other files, each read by the mapping of the file that it was calibrated from.
pub(super) struct Others<'a> {
    seed: u64,
    files: Vec<(&'a PathBuf, Lines)>,
}

impl<'a> Others<'a> {
    /// Read before the fit: a file that is missing is said at once.
    pub(super) fn read(of: &'a RowFile, seed: u64, robot: &RobotConfig) -> anyhow::Result<Self> {
        let files = of.validate.iter().map(|path| Ok((path, poses(path, &of.mapping, robot)?)));
        Ok(Self { seed, files: files.collect::<anyhow::Result<_>>()? })
    }

    pub(super) fn judge(
        &self,
        robot: &RobotConfig,
        validity: &Validity,
        model: &Model,
    ) -> anyhow::Result<Vec<of_rows::Validation>> {
        let one = |(path, (rows, lines)): &(&PathBuf, Lines)| {
            let name = path.display().to_string();
            let figures = tracker::validate(rows, robot, model, self.seed).with_context(|| name.clone())?;
            let joints = rows.iter().map(|row| row.joints_rad);
            Ok(of_rows::Validation { name, figures, outside: of_rows::outside(validity, joints, lines) })
        };
        self.files.iter().map(one).collect()
    }
}
