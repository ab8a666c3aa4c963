//! `identify calibrate tracker`, `wire`, `contact` and `touch`. The measurements of these instruments are rows of a table.
//! Each row contains a pose of the robot and the quantity that was measured there. This module contains the options of these
//! commands, and reads such files to [`Rows`] for the `driver`. The joints are in the rows, or follow from the robot's log
//! after an alignment of the clocks. A [`ValidationFile`] is a file of `--validate`.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use serde::{Deserialize, Serialize};
use shared::config::{self, RobotConfig};
use shared::time::UtcNs;

use super::RowArguments;
use super::bar::load_log;
use crate::calibrate::rows::{Validated, validate};
use crate::calibrate::{CalibrateError, Calibration};
use crate::evaluate::Validity;
use crate::instrument::{Contact, FaceTable, HoldOut, Instrument, Rows, SocketTable, Touch, Tracker, Wire};
use crate::kinematics::flange_chain;
use crate::logs::{
    ContactMapping, JointColumn, LogFormat, LogOptions, LoggedJoints, MeasuredLengthMapping, MeasuredLengths,
    MeasuredPoseMapping, MeasuredPoses, PoseRow, RobotLogMapping, TimedPoses, TipRow, TouchMapping, Touches,
    drop_copies, is_simulated, joints_of_robot,
};
use crate::model::{JointState, Model, Waves, further};
use crate::prepare::{AlignedPoses, Alignment, PrepareOptions, align_poses};
use crate::report::result::clocks::ClockEntry;
use crate::report::result::validation::ValidationEntry;
use crate::report::rows as rows_report;

/// Options of a calibration with a tracker.
#[derive(Debug, Args)]
pub struct TrackerArguments {
    #[command(flatten)]
    pub(super) rows: RowArguments,
    /// Log of the robot (CSV, ROS 2 bag, UR RTDE, ABB EGM, KUKA RSI), if the rows have times of the tracker's clock instead
    /// of joints. The clocks are aligned by comparing the motions
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub(super) robot_log: Option<PathBuf>,
    /// Format of the robot's log; default: detected from its content
    #[arg(long, help_heading = "Input", value_name = "KIND", requires = "robot_log")]
    pub(super) log_format: Option<LogFormat>,
    /// Mapping file for the robot's log (names its columns or joints), such as config/robot_log.toml
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "robot_log")]
    pub(super) log_mapping: Option<PathBuf>,
}

/// Options of a calibration with a ball in sockets.
#[derive(Debug, Args)]
pub struct ContactArguments {
    #[command(flatten)]
    pub(super) rows: RowArguments,
    /// File with the positions of the sockets on their plate, or with their distances, such as config/sockets.toml
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub(super) sockets: PathBuf,
}

/// Options of a calibration with a touch probe or a dial gauge.
#[derive(Debug, Args)]
pub struct TouchArguments {
    #[command(flatten)]
    pub(super) rows: RowArguments,
    /// File with the known distances and angles of the faces, such as config/faces.toml; default: none are known
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub(super) faces: Option<PathBuf>,
}

/// A table of measurements with its options. They are options of a command, and keys of a block in an experiment's file.
#[derive(Debug, Clone, Default, PartialEq, Args, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RowFile {
    /// Table of measurements (.csv, .xlsx) with one row for each pose, in the order of the robot's motion
    pub file: PathBuf,
    /// Mapping file for the table (names its columns), such as config/measured_pose.toml for a tracker,
    /// config/measured_length.toml for a wire, config/contact.toml for a ball in sockets,
    /// config/touch.toml for a touch probe
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    pub mapping: PathBuf,
    /// The robot's own log, for a tracker whose rows have times in place of joints.
    #[arg(skip)]
    pub robot_log: Option<PathBuf>,
    /// Table of the sockets. It is required for a ball in sockets.
    #[arg(skip)]
    pub sockets: Option<PathBuf>,
    /// Known distances and angles of the faces, for a touch probe.
    #[arg(skip)]
    pub faces: Option<PathBuf>,
    /// How rows are grouped for cross-validation, where rows of one group are held out together. Default: regions for a
    /// tracker, but rows if it has several stations; rows for other instruments
    #[arg(long, help_heading = "Estimation", value_enum)]
    pub hold_out: Option<HoldOut>,
    /// Seed that selects the held-out groups; default: 1042
    #[arg(long, help_heading = "Estimation")]
    pub seed: Option<u64>,
    /// Highest order of periodic joint errors [waves per turn], 3 to 127; default: 64 for `calibrate tracker`, otherwise
    /// derived from the number of rows. The lowest value of all files applies
    #[arg(long, help_heading = "Estimation", value_name = "N",
          value_parser = clap::value_parser!(u8).range(i64::from(*Waves::OF_AXIS.start())..=i64::from(*Waves::OF_AXIS.end())))]
    pub joint_waves: Option<u8>,
    /// Tables of the same kind of instrument, possibly at another position, with which the calibrated robot is
    /// checked; separate them by commas
    #[arg(long, help_heading = "Input", value_name = "FILES", value_delimiter = ',')]
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub validate: Vec<PathBuf>,
    /// Mapping file for the tables of --validate; default: the file of --mapping. Rows of these tables need joints, even if
    /// the calibrated rows have times
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "validate")]
    pub validate_mapping: Option<PathBuf>,
}

/// Instruments whose measurements are rows of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RowInstrument {
    Tracker,
    Wire,
    Contact,
    Touch,
}

impl RowInstrument {
    /// Name of the instrument's blocks in an experiment's file.
    pub(super) const fn key(self) -> &'static str {
        match self {
            Self::Tracker => "tracker",
            Self::Wire => "wire",
            Self::Contact => "contact",
            Self::Touch => "touch",
        }
    }

    /// Description of the instrument's rows, for display.
    pub(super) const fn role(self) -> &'static str {
        match self {
            Self::Tracker => "measured poses",
            Self::Wire => "measured lengths",
            Self::Contact => "seated balls",
            Self::Touch => "touched faces",
        }
    }
}

/// Content of a file in addition to its rows.
#[derive(Default)]
pub(super) struct Beside {
    /// Line number of each row.
    pub(super) lines: Vec<u64>,
    /// The joints as the file contains them or, if the rows have times, as the robot's log contains them.
    pub(super) logged: Option<LoggedJoints>,
    /// Names, as in the file, of the instrument's stations and of the targets on the flange. The key is the prefix of
    /// the parameters of these stations or targets: `tracker` has `tracker_x` for the first name, `tracker2_x` for the
    /// second and so on.
    pub(super) names: BTreeMap<String, Vec<String>>,
    /// Time alignment with the robot's log, if the rows have times.
    pub(super) aligned: Option<Aligned>,
    /// Whether the file is marked as simulated.
    pub(super) simulated: bool,
}

impl Beside {
    /// Lines that state which parameters belong to which station or target. A prefix with only one name has no line.
    pub(super) fn set_ups(&self) -> String {
        let line = |(prefix, names): (&String, &Vec<String>)| {
            let parameters = |(place, name): (usize, &String)| format!("{prefix}{}_* {name}", further(place));
            let parameters: Vec<String> = names.iter().enumerate().map(parameters).collect();
            (names.len() > 1).then(|| parameters.join(", ") + "\n")
        };
        self.names.iter().filter_map(line).collect()
    }
}

/// Result of the time alignment of a tracker with the robot.
pub(super) struct Aligned {
    alignment: Alignment,
    /// Reference time of the alignment, on the tracker's clock.
    t_ref: UtcNs,
    /// Whether the tracker's times contain a date.
    is_dated: bool,
    /// Whether the robot stood still at each row. If so, difference and rate of the clocks follow from the standstills, not
    /// from a solve.
    stood: bool,
    /// Number of rows that are not used. They are outside the robot's log, or were taken in motion although the other
    /// rows were taken at standstills.
    left_out: usize,
}

/// The robot, the format of its logs, and the options by which rows with times are aligned with a log.
pub(super) struct WithLogs<'a> {
    pub(super) robot: &'a RobotConfig,
    pub(super) logs: &'a LogOptions,
    pub(super) options: &'a PrepareOptions,
}

/// Reads the rows of a file with its mapping. `data_set` is the number of the data set in messages.
pub(super) fn read(
    kind: RowInstrument,
    options: &RowFile,
    data_set: usize,
    with: &WithLogs<'_>,
) -> anyhow::Result<(Rows, Beside)> {
    let RowFile { file, mapping, hold_out, seed, joint_waves, .. } = options;
    let (instrument, beside) = match &options.robot_log {
        Some(robot_log) => timed_poses(options, robot_log, data_set, with)?,
        None => rows_with_joints(kind, options, [file, mapping], data_set, with.robot)?,
    };
    let simulated = is_simulated(file)?;
    let rows = Rows { instrument, hold_out: *hold_out, seed: *seed, joint_waves: *joint_waves };
    Ok((rows, Beside { simulated, ..beside }))
}

/// Reads `file`, whose rows contain joints, with the mapping in `mapping_file`. `options` contains the path of the
/// table of sockets or faces.
fn rows_with_joints(
    kind: RowInstrument,
    options: &RowFile,
    [file, mapping_file]: [&Path; 2],
    data_set: usize,
    robot: &RobotConfig,
) -> anyhow::Result<(Instrument, Beside)> {
    let lines = |rows: &[TipRow]| rows.iter().map(|row| row.line).collect();
    let logged = |joints: Vec<JointColumn>| {
        LoggedJoints::of_mapping(&RobotLogMapping { joints, ..RobotLogMapping::default() }).map(Some)
    };
    Ok(match kind {
        RowInstrument::Tracker => {
            let mapping: MeasuredPoseMapping = config::load(mapping_file)?;
            anyhow::ensure!(
                mapping.time.is_none(),
                "{}: rows with [time] have their joints in the robot's own log; give it (--robot-log, or robot_log in the [[tracker]] \
                 block)",
                mapping_file.display()
            );
            joints_of_robot(&mapping.joints, robot, mapping_file)?;
            let mut read = MeasuredPoses::load(file, &mapping)?;
            warn_of(file, drop_copies(&mut read.rows, |row| &mut row.line));
            let lines = read.rows.iter().map(|row| row.line).collect();
            let names = names_by_prefix([("tracker", read.stations), ("probe", read.targets)]);
            let tracker = Tracker::new(&read.rows).with_scale_u_ppm(mapping.scale_u_ppm);
            (tracker.into(), Beside { lines, logged: logged(mapping.joints)?, names, ..Beside::default() })
        }
        RowInstrument::Wire => {
            let mapping: MeasuredLengthMapping = config::load(mapping_file)?;
            joints_of_robot(&mapping.joints, robot, mapping_file)?;
            let mut read = MeasuredLengths::load(file, &mapping)?;
            warn_of(file, drop_copies(&mut read.rows, |row| &mut row.line));
            let lines = read.rows.iter().map(|row| row.line).collect();
            let names = names_by_prefix([("anchor", read.anchors), ("attachment", read.attachments)]);
            let wire = Wire::new(&read.rows).with_scale_u_ppm(mapping.scale_u_ppm);
            (wire.into(), Beside { lines, logged: logged(mapping.joints)?, names, ..Beside::default() })
        }
        RowInstrument::Contact => {
            let sockets = options.sockets.as_deref().context("a table of sockets is missing")?;
            let table: SocketTable = config::load(sockets)?;
            let mapping: ContactMapping = config::load(mapping_file)?;
            joints_of_robot(&mapping.joints, robot, mapping_file)?;
            let mut rows = mapping.load(file, &table.names())?;
            warn_of(file, drop_copies(&mut rows, |row| &mut row.line));
            let contact =
                Contact::new(&rows, &table).map_err(|error| CalibrateError::Rows { data_set, error })?;
            (
                contact.into(),
                Beside { lines: lines(&rows), logged: logged(mapping.joints)?, ..Beside::default() },
            )
        }
        RowInstrument::Touch => {
            let table = options.faces.as_deref().map_or_else(|| Ok(FaceTable::default()), config::load)?;
            let mapping: TouchMapping = config::load(mapping_file)?;
            joints_of_robot(&mapping.joints, robot, mapping_file)?;
            let mut read = Touches::load(file, &mapping)?;
            warn_of(file, drop_copies(&mut read.rows, |row| &mut row.line));
            if let (Some(path), Some(face)) = (&options.faces, table.untouched(&read.faces).first()) {
                tracing::warn!(
                    "{}: no row of {} touches face `{face}`, so its known distances and angles have no effect; check its name in both files",
                    path.display(),
                    file.display()
                );
            }
            let touch = Touch::new(&read.rows, &read.faces, &table, &flange_chain(robot));
            (
                touch.into(),
                Beside { lines: lines(&read.rows), logged: logged(mapping.joints)?, ..Beside::default() },
            )
        }
    })
}

/// Logs remarks about a file as warnings.
pub(super) fn warn_of(file: &Path, remarks: impl IntoIterator<Item = impl Display>) {
    remarks.into_iter().for_each(|remark| tracing::warn!("{}: {remark}", file.display()));
}

fn names_by_prefix(prefixes: [(&str, Vec<String>); 2]) -> BTreeMap<String, Vec<String>> {
    let given = prefixes.into_iter().filter(|(_, names)| !names.is_empty());
    given.map(|(prefix, names)| (prefix.to_owned(), names)).collect()
}

/// Reads rows of a tracker that have times in place of joints. Aligns the clocks, and then takes the joints of the rows
/// from the robot's own log.
fn timed_poses(
    options: &RowFile,
    robot_log: &Path,
    data_set: usize,
    with: &WithLogs<'_>,
) -> anyhow::Result<(Instrument, Beside)> {
    let mapping: MeasuredPoseMapping = config::load(&options.mapping)?;
    anyhow::ensure!(
        mapping.time.is_some(),
        "{}: beside a robot's log rows need times; name their column under [time] and take the [[joints]] out, or leave the robot's \
         log out",
        options.mapping.display()
    );
    let read = TimedPoses::load(&options.file, &mapping)?;
    warn_of(&options.file, &read.remarks);
    let log = load_log(robot_log, with.robot, with.logs)?;
    let AlignedPoses { rows, states, moving, alignment, t_ref, left_out } =
        align_poses(&read, &log, &flange_chain(with.robot), with.options)
            .map_err(|error| CalibrateError::Align { data_set, error: Box::new(error) })?;
    let with_joints =
        |(&row, state): (&usize, &JointState)| PoseRow { joints_rad: state.q, ..read.rows[row] };
    let poses: Vec<PoseRow> = rows.iter().zip(&states).map(with_joints).collect();
    let lines = poses.iter().map(|row| row.line).collect();
    let stood = moving.is_none();
    let tracker = match moving {
        Some(moving) => Tracker::of_moving(&poses, moving),
        None => Tracker::new(&poses),
    };
    let tracker = tracker.with_scale_u_ppm(mapping.scale_u_ppm);
    let is_dated = mapping.time.is_some_and(|time| time.unit.is_dated());
    let names = names_by_prefix([("tracker", read.stations), ("probe", read.targets)]);
    let aligned = Some(Aligned { alignment, t_ref, is_dated, stood, left_out });
    Ok((tracker.into(), Beside { lines, names, aligned, logged: log.logged, ..Beside::default() }))
}

impl Aligned {
    /// Entry about the clocks at the solution; `run` is the tracker's data set, from 0. If all rows were measured at
    /// standstills, the solve does not estimate the skew, so the entry contains the skew of the alignment.
    pub(super) fn clock(&self, run: usize, calibration: &Calibration) -> Option<ClockEntry> {
        let solved = ClockEntry::solved(calibration, run, (self.t_ref, self.is_dated), &self.alignment)?;
        let skew_ppm = if self.stood { self.alignment.skew * 1e6 } else { solved.skew_ppm };
        Some(ClockEntry { skew_ppm, ..solved })
    }

    /// A line with the number of rows that are not used.
    pub(super) fn line(&self) -> String {
        format!("{} rows left out: outside the robot's log, or not at its standstills\n", self.left_out)
    }
}

/// A file of `--validate`: rows of the same instrument that the calibration does not use.
pub(super) struct ValidationFile<'a> {
    path: &'a Path,
    instrument: Instrument,
    /// Line number of each row.
    lines: Vec<u64>,
}

impl<'a> ValidationFile<'a> {
    /// Reads all validation files of a data set. This is done before the fit, so that a missing file is reported immediately.
    pub(super) fn read_all(
        kind: RowInstrument,
        options: &'a RowFile,
        data_set: usize,
        robot: &RobotConfig,
    ) -> anyhow::Result<Vec<Self>> {
        let mapping_file = options.validate_mapping.as_ref().unwrap_or(&options.mapping);
        if kind == RowInstrument::Tracker && !options.validate.is_empty() {
            let mapping: MeasuredPoseMapping = config::load(mapping_file)?;
            anyhow::ensure!(
                mapping.time.is_none(),
                "{}: rows of --validate need the robot's joints, and the mapping has [time] instead; export them with the robot's \
                 joints in each row, and name their columns in a mapping of their own (--validate-mapping, or validate_mapping in \
                 the [[tracker]] block)",
                mapping_file.display()
            );
        }
        let read_file = |path: &'a PathBuf| {
            let (instrument, beside) =
                rows_with_joints(kind, options, [path, mapping_file], data_set, robot)?;
            Ok(Self { path, instrument, lines: beside.lines })
        };
        options.validate.iter().map(read_file).collect()
    }

    /// Errors of the nominal and the calibrated robot on the file. `data_set` is the number (from 1) of the data set with the
    /// same instrument, and `seed` selects the held-out rows of the file.
    pub(super) fn validate(
        &self,
        seed: u64,
        data_set: usize,
        robot: &RobotConfig,
        validity: &Validity,
        model: &Model,
    ) -> anyhow::Result<rows_report::Validation> {
        let Self { path, instrument, lines } = self;
        let name = path.display().to_string();
        let Validated { figures: [nominal, calibrated], gross } =
            validate(instrument, data_set, robot, model, seed).with_context(|| name.clone())?;
        let joints = instrument.joints();
        let outside = joints.iter().zip(lines).map(|(q, line)| (*line, validity.outside(q)));
        let outside: Vec<_> = outside.filter(|(_, joints)| !joints.is_empty()).collect();
        let (unsupported, left_out) = (outside.len(), gross.len());
        let entry = ValidationEntry { name, data_set, nominal, calibrated, unsupported, left_out };
        let gross = gross.iter().filter_map(|row| lines.get(*row)).copied().collect();
        Ok(rows_report::Validation { entry, gross, outside })
    }
}
