//! Files of rows, each a pose of the robot and what was measured there: `identify calibrate tracker`, `wire` and `contact`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::config::{self, RobotConfig};
use shared::time::UtcNs;

use super::bar::load_log;
use super::driver::calibrate;
use super::experiment::Experiment;
use super::{CommonArguments, RowArguments};
use crate::calibrate::rows::{WAVES_PER_TURN_MAX, tracker};
use crate::calibrate::{CalibrateError, Calibration};
use crate::evaluate::Validity;
use crate::instrument::HoldOut;
use crate::instrument::{ContactRow, LengthRow, PoseRow, SocketTable};
use crate::instrument::{Measured, Rows};
use crate::kinematics::flange_chain;
use crate::logs::{
    ContactMapping, Contacts, LogFormat, LogOptions, MeasuredLengthMapping, MeasuredLengths,
    MeasuredPoseMapping, MeasuredPoses, TimedPoses, is_simulated, joints_of_robot,
};
use crate::model::{JointState, Model, Waves, further};
use crate::prepare::{AlignedPoses, Alignment, PrepareOptions, align_poses};
use crate::report::result::clocks::{ClockEntry, SolvedClock};
use crate::report::rows as of_rows;
use serde::{Deserialize, Serialize};

/// Options of a calibration with a tracker.
#[derive(Debug, Args)]
pub struct TrackerArguments {
    /// Poses measured by a tracker (.csv), rows in the order of the robot's motion
    #[arg(value_name = "FILE")]
    poses: PathBuf,
    #[command(flatten)]
    rows: RowArguments,
    /// The robot's own log (CSV, ROS 2 bag, UR RTDE, ABB EGM, KUKA RSI), where the rows have times on the tracker's clock in place
    /// of joints: the clocks are brought together by the motion
    #[arg(long, value_name = "FILE")]
    robot_log: Option<PathBuf>,
    /// Kind of the robot's log; default: recognised by its content
    #[arg(long, value_name = "KIND", requires = "robot_log")]
    log_format: Option<LogFormat>,
    /// Which column or joint of the robot's log is what, such as config/robot_log.toml
    #[arg(long, value_name = "FILE", requires = "robot_log")]
    log_mapping: Option<PathBuf>,
    /// Other files of measured poses that judge the robot; tracker and probe may be elsewhere
    #[arg(long, value_name = "FILES", value_delimiter = ',')]
    validate: Vec<PathBuf>,
    /// Which column of these is what; default: as --mapping says. Their rows have joints, also where the others have times
    #[arg(long, value_name = "FILE", requires = "validate")]
    validate_mapping: Option<PathBuf>,
    /// Highest number of waves per turn that the errors of joints may have; 3 to 127
    #[arg(long, value_name = "N", default_value_t = WAVES_PER_TURN_MAX,
          value_parser = clap::value_parser!(u8).range(i64::from(*Waves::OF_AXIS.start())..=i64::from(*Waves::OF_AXIS.end())))]
    joint_waves: u8,
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
    /// Of a tracker whose rows have times in place of joints: the robot's own log.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot_log: Option<PathBuf>,
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
    /// Which of their columns is what; absent: as `mapping` says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validate_mapping: Option<PathBuf>,
}

impl RowFile {
    fn new(file: &Path, rows: &RowArguments) -> Self {
        Self {
            file: file.to_owned(),
            mapping: rows.mapping.clone(),
            robot_log: None,
            sockets: None,
            hold_out: rows.hold_out,
            seed: Some(rows.seed),
            joint_waves: None,
            validate: Vec::new(),
            validate_mapping: None,
        }
    }
}

pub(super) fn run_tracker(arguments: &TrackerArguments) -> anyhow::Result<()> {
    let TrackerArguments { poses, rows, robot_log, validate, validate_mapping, .. } = arguments;
    let TrackerArguments { joint_waves, common, .. } = arguments;
    let mut experiment = Experiment::new(&common.robot, common.identify_config()?);
    (experiment.log_format, experiment.log_mapping) = (arguments.log_format, arguments.log_mapping.clone());
    experiment.trackers.push(RowFile {
        joint_waves: Some(*joint_waves),
        validate: validate.clone(),
        validate_mapping: validate_mapping.clone(),
        robot_log: robot_log.clone(),
        ..RowFile::new(poses, rows)
    });
    calibrate(experiment, &common.result, None)
}

pub(super) fn run_wire(WireArguments { lengths, rows, common }: &WireArguments) -> anyhow::Result<()> {
    let mut experiment = Experiment::new(&common.robot, common.identify_config()?);
    experiment.wires.push(RowFile::new(lengths, rows));
    calibrate(experiment, &common.result, None)
}

pub(super) fn run_contact(arguments: &ContactArguments) -> anyhow::Result<()> {
    let ContactArguments { contacts, sockets, rows, common } = arguments;
    let mut experiment = Experiment::new(&common.robot, common.identify_config()?);
    experiment.contacts.push(RowFile { sockets: Some(sockets.clone()), ..RowFile::new(contacts, rows) });
    calibrate(experiment, &common.result, None)
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

/// What a file says beside its rows.
#[derive(Default)]
pub(super) struct Beside {
    /// Of each row in its file.
    pub(super) lines: Vec<u64>,
    /// What it calls the places of an instrument and those on the flange, each after the parameters that are theirs: `tracker` has
    /// `tracker_x`, `tracker2_x` and so on.
    pub(super) names: BTreeMap<String, Vec<String>>,
    /// How its clock and the robot's were brought together, where rows have times.
    pub(super) aligned: Option<Aligned>,
    /// It says that it was simulated.
    pub(super) simulated: bool,
}

impl Beside {
    /// Which parameters are whose, where there are several.
    pub(super) fn set_ups(&self) -> String {
        let line = |(parameter, names): (&String, &Vec<String>)| {
            let whose = |(place, name): (usize, &String)| format!("{parameter}{}_* {name}", further(place));
            let whose: Vec<String> = names.iter().enumerate().map(whose).collect();
            (names.len() > 1).then(|| whose.join(", ") + "\n")
        };
        self.names.iter().filter_map(line).collect()
    }
}

/// Clocks of a tracker and the robot.
pub(super) struct Aligned {
    alignment: Alignment,
    /// Its reference time on the tracker's clock.
    t_ref: UtcNs,
    /// The tracker's times have a date.
    is_dated: bool,
    /// The robot stood still at each row: standstills have said what the clocks are, no solve.
    stood: bool,
    /// Rows outside the robot's log, or taken while a robot moved that otherwise stood.
    left_out: usize,
}

/// What the robot's logs are, and what aligns others with them.
pub(super) struct WithLogs<'a> {
    pub(super) robot: &'a RobotConfig,
    pub(super) logs: LogOptions,
    pub(super) options: &'a PrepareOptions,
}

/// The rows of a file, read as the file of its mapping says; `data_set` is its number.
pub(super) fn read(
    kind: Kind,
    of: &RowFile,
    data_set: usize,
    with: &WithLogs<'_>,
) -> anyhow::Result<(Rows, Beside)> {
    let robot = with.robot;
    let (measured, mut beside) = match (kind, &of.robot_log) {
        (Kind::Tracker, Some(robot_log)) => timed_poses(of, robot_log, data_set, with)?,
        (Kind::Tracker, None) => {
            let read = poses(&of.file, &of.mapping, robot)?;
            let (rows, lines) = with_lines(&read);
            let names = of_set_ups([("tracker", read.stations), ("probe", read.targets)]);
            (Measured::Poses(rows), Beside { lines, names, ..Beside::default() })
        }
        (Kind::Wire, _) => {
            let mapping: MeasuredLengthMapping = config::load(&of.mapping)?;
            joints_of_robot(&mapping.joints, robot, &of.mapping)?;
            let read = MeasuredLengths::load(&of.file, &mapping)?;
            let (rows, lines) = read.rows.iter().map(|row| (LengthRow::from(row), row.line)).unzip();
            let names = of_set_ups([("anchor", read.anchors), ("attachment", read.attachments)]);
            (Measured::Lengths(rows), Beside { lines, names, ..Beside::default() })
        }
        (Kind::Contact, _) => {
            let sockets = of.sockets.as_deref().context("a table of sockets is missing")?;
            let table: SocketTable = config::load(sockets)?;
            let mapping: ContactMapping = config::load(&of.mapping)?;
            joints_of_robot(&mapping.joints, robot, &of.mapping)?;
            let read = Contacts::load(&of.file, &mapping, &table.names())?;
            let (rows, lines) = read.rows.iter().map(|row| (ContactRow::from(row), row.line)).unzip();
            (Measured::Contacts(rows, table), Beside { lines, ..Beside::default() })
        }
    };
    beside.simulated = is_simulated(&of.file)?;
    let rows = Rows { measured, hold_out: of.hold_out, seed: of.seed, joint_waves: of.joint_waves };
    Ok((rows, beside))
}

fn of_set_ups(names: [(&str, Vec<String>); 2]) -> BTreeMap<String, Vec<String>> {
    let given = names.into_iter().filter(|(_, names)| !names.is_empty());
    given.map(|(parameter, names)| (parameter.to_owned(), names)).collect()
}

/// Rows of a file, and the line of each.
type Lines = (Vec<PoseRow>, Vec<u64>);

fn with_lines(read: &MeasuredPoses) -> Lines {
    read.rows.iter().map(|row| (PoseRow::from(row), row.line)).unzip()
}

fn poses(path: &Path, mapping: &Path, robot: &RobotConfig) -> anyhow::Result<MeasuredPoses> {
    let of_file: MeasuredPoseMapping = config::load(mapping)?;
    anyhow::ensure!(
        of_file.time.is_none(),
        "{}: rows with [time] have their joints in the robot's own log; give it (--robot-log, or robot_log in the [[tracker]] block)",
        mapping.display()
    );
    joints_of_robot(&of_file.joints, robot, mapping)?;
    Ok(MeasuredPoses::load(path, &of_file)?)
}

/// Rows with times in place of joints, brought together with the robot's own log.
fn timed_poses(
    of: &RowFile,
    robot_log: &Path,
    data_set: usize,
    with: &WithLogs<'_>,
) -> anyhow::Result<(Measured, Beside)> {
    let mapping: MeasuredPoseMapping = config::load(&of.mapping)?;
    anyhow::ensure!(
        mapping.time.is_some(),
        "{}: beside a robot's log rows need times; name their column under [time] and take the [[joints]] out, or leave the robot's \
         log out",
        of.mapping.display()
    );
    let read = TimedPoses::load(&of.file, &mapping)?;
    for remark in &read.remarks {
        tracing::warn!("{}: {remark}", of.file.display());
    }
    let log = load_log(robot_log, with.robot, &with.logs)?;
    let AlignedPoses { rows, states, moving, alignment, t_ref, left_out } =
        align_poses(&read, &log, &flange_chain(with.robot), with.options)
            .map_err(|error| CalibrateError::Align { data_set, error: Box::new(error) })?;
    let row = |(&row, state): (&usize, &JointState)| {
        let seen = read.rows[row];
        (PoseRow::from(&seen.with_joints(state.q)), seen.line)
    };
    let (poses, lines) = rows.iter().zip(&states).map(row).unzip();
    let stood = moving.is_none();
    let measured = match moving {
        Some(moving) => Measured::Path(poses, moving),
        None => Measured::Poses(poses),
    };
    let is_dated = mapping.time.is_some_and(|time| time.unit.is_dated());
    let names = of_set_ups([("tracker", read.stations), ("probe", read.targets)]);
    let aligned = Some(Aligned { alignment, t_ref, is_dated, stood, left_out });
    Ok((measured, Beside { lines, names, aligned, ..Beside::default() }))
}

impl Aligned {
    /// The clocks at the solution of all data sets, of which the tracker's is number `run` from 0: as the solve found them, or as
    /// far as standstills say.
    pub(super) fn clock(&self, run: usize, found: &Calibration) -> Option<ClockEntry> {
        let solved = ClockEntry::from(SolvedClock {
            run,
            instrument: Kind::Tracker.key(),
            reference: self.t_ref,
            is_dated: self.is_dated,
            alignment: &self.alignment,
            model: &found.runs.get(run)?.model,
            columns: &found.solved.columns,
            covariance: &found.solved.solution.covariance,
        });
        let skew_ppm = if self.stood { self.alignment.skew * 1e6 } else { solved.skew_ppm };
        Some(ClockEntry { skew_ppm, ..solved })
    }

    /// For a person.
    pub(super) fn line(&self) -> String {
        format!("{} rows left out: outside the robot's log, or not at its standstills\n", self.left_out)
    }
}

/// A calibrated robot on the rows of other files, each read by the mapping of the file that it was calibrated from, or by their own.
pub(super) struct Others<'a> {
    seed: u64,
    files: Vec<(&'a PathBuf, Lines)>,
}

impl<'a> Others<'a> {
    /// Read before the fit: a file that is missing is said at once.
    pub(super) fn read(of: &'a RowFile, seed: u64, robot: &RobotConfig) -> anyhow::Result<Self> {
        let mapping = of.validate_mapping.as_ref().unwrap_or(&of.mapping);
        if !of.validate.is_empty() {
            let read: MeasuredPoseMapping = config::load(mapping)?;
            anyhow::ensure!(
                read.time.is_none(),
                "{}: rows that judge the robot need its joints, and [time] says that these have none; export them with the robot's \
                 joints in each row, and name their columns in a mapping of their own (--validate-mapping, or validate_mapping in \
                 the [[tracker]] block)",
                mapping.display()
            );
        }
        let files = of.validate.iter().map(|path| Ok((path, with_lines(&poses(path, mapping, robot)?))));
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
