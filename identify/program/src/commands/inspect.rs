//! `identify inspect` reads each file and prints its content and suspicious findings. The kind of a file follows from its
//! content and the options. With `--propose`, the command writes a mapping for a table instead.

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::config::{self, BallBarConfig, RobotConfig, Source};
use shared::output::{say, show};
use shared::recording::Recording;

use super::load_log_mapping;
use crate::inspect::{self, Inspection};
use crate::instrument::SocketTable;
use crate::logs::{
    self, BarLogMapping, ContactMapping, LogError, LogFormat, LogOptions, MeasuredLengthMapping,
    MeasuredLengths, MeasuredPoseMapping, MeasuredPoses, OtherBarLog, RobotLogMapping, TimedPoses,
    TouchMapping, Touches, joints_of_robot,
};
use crate::report::table;

#[derive(Debug, Args)]
pub struct InspectArguments {
    /// Recordings of the ball-bar, logs of the robot or tables of measurements, in any format that `calibrate` reads
    #[arg(required = true, value_name = "FILES")]
    files: Vec<PathBuf>,
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16;
    /// needed to read the robot's logs
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Configuration file of the bar, such as config/ball_bar.toml; converts the counters in
    /// recordings of other programs to angles
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    bar: Option<PathBuf>,
    /// Format of the robot's logs; default: detected from their content
    #[arg(long, help_heading = "Input", value_name = "KIND", requires = "robot")]
    log_format: Option<LogFormat>,
    /// Mapping file for the robot's logs (names their columns or joints), such as config/robot_log.toml
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "robot")]
    log_mapping: Option<PathBuf>,
    /// Mapping file for recordings of other programs (names their columns or joints), such as config/bar_log.toml
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "bar")]
    recording_mapping: Option<PathBuf>,
    /// Mapping file for tables of a tracker, wire or touch probe (names their columns), such as config/measured_pose.toml,
    /// config/measured_length.toml or config/touch.toml; all FILES are then read as such tables
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "robot", conflicts_with_all = ["log_mapping", "log_format", "bar", "recording_mapping", "sockets"])]
    mapping: Option<PathBuf>,
    /// File with the positions or distances of sockets, such as config/sockets.toml; all FILES are then read as
    /// tables of a ball seated in them
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "robot", requires = "contact_mapping",
          conflicts_with_all = ["log_mapping", "log_format", "bar", "recording_mapping"])]
    sockets: Option<PathBuf>,
    /// Mapping file for tables of a ball in sockets (names their columns), such as config/contact.toml
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "sockets")]
    contact_mapping: Option<PathBuf>,
    /// Propose a mapping for a table of joints, and write it to this file
    #[arg(long, help_heading = "Output", value_name = "FILE", requires = "robot", conflicts_with_all = ["log_mapping", "log_format", "bar", "recording_mapping", "sockets", "mapping"])]
    propose: Option<PathBuf>,
}

/// Content of the files that the options name.
struct InspectSettings {
    robot: Option<RobotConfig>,
    log_options: LogOptions,
    bar: Option<BallBarConfig>,
    recording_mapping: Option<BarLogMapping>,
    rows: Option<RowMapping>,
}

/// Mapping of rows, by instrument. For a ball in sockets, the table of the sockets is included.
enum RowMapping {
    Contacts(SocketTable, ContactMapping),
    Poses(MeasuredPoseMapping),
    Lengths(MeasuredLengthMapping),
    Touches(TouchMapping),
}

impl RowMapping {
    /// Reads a mapping. The instrument is recognised by the keys of the file: a wire has `length`, a touch probe `face`,
    /// a tracker neither of them.
    fn load(path: &Path) -> anyhow::Result<Self> {
        let table = Source::find(path).text()?.parse::<toml::Table>();
        let has = |key: &str| table.as_ref().is_ok_and(|table| table.contains_key(key));
        let has_measurement = ["length", "face", "position"].into_iter().any(has);
        anyhow::ensure!(
            has_measurement || !has("time") || config::load::<RobotLogMapping>(path).is_err(),
            "{}: this is the mapping of a robot's log; give it with --log-mapping",
            path.display()
        );
        Ok(match (has("length"), has("face")) {
            (true, _) => Self::Lengths(config::load(path)?),
            (_, true) => Self::Touches(config::load(path)?),
            _ => Self::Poses(config::load(path)?),
        })
    }

    /// Checks that the joints of the mapping, if it has any, are the axes of the robot. `path` is the path of the mapping.
    fn check_joints(&self, robot: &RobotConfig, path: &Path) -> Result<(), LogError> {
        let joints = match self {
            Self::Contacts(_, mapping) => &mapping.joints,
            Self::Lengths(mapping) => &mapping.joints,
            Self::Touches(mapping) => &mapping.joints,
            Self::Poses(mapping) if mapping.time.is_some() => return Ok(()),
            Self::Poses(mapping) => &mapping.joints,
        };
        joints_of_robot(joints, robot, path)
    }

    fn inspected(&self, path: &Path, robot: &RobotConfig) -> anyhow::Result<Inspection> {
        Ok(match self {
            Self::Contacts(table, mapping) => {
                inspect::contacts(&mapping.load(path, &table.names())?, table, robot)
            }
            Self::Lengths(mapping) => inspect::lengths(&MeasuredLengths::load(path, mapping)?, robot),
            Self::Touches(mapping) => inspect::touches(&Touches::load(path, mapping)?, robot),
            Self::Poses(mapping) if mapping.time.is_some() => {
                inspect::timed_poses(&TimedPoses::load(path, mapping)?)
            }
            Self::Poses(mapping) => inspect::poses(&MeasuredPoses::load(path, mapping)?, robot),
        })
    }
}

pub fn run(arguments: &InspectArguments) -> anyhow::Result<()> {
    let rows = match (&arguments.sockets, &arguments.contact_mapping) {
        (Some(sockets), Some(mapping)) => {
            Some(RowMapping::Contacts(config::load(sockets)?, config::load(mapping)?))
        }
        _ => arguments.mapping.as_deref().map(RowMapping::load).transpose()?,
    };
    let robot: Option<RobotConfig> = arguments.robot.as_deref().map(config::load).transpose()?;
    let row_mapping = arguments.contact_mapping.as_ref().or(arguments.mapping.as_ref());
    if let (Some(rows), Some(robot), Some(path)) = (&rows, &robot, row_mapping) {
        rows.check_joints(robot, path)?;
    }
    let log_mapping = arguments.log_mapping.as_deref().zip(robot.as_ref());
    let settings = InspectSettings {
        rows,
        log_options: LogOptions {
            format: arguments.log_format,
            mapping: log_mapping.map(|(path, robot)| load_log_mapping(path, robot)).transpose()?,
        },
        robot,
        bar: arguments.bar.as_deref().map(config::load).transpose()?,
        recording_mapping: arguments.recording_mapping.as_deref().map(config::load).transpose()?,
    };
    if let (Some(out), Some(robot)) = (&arguments.propose, &settings.robot) {
        let [path] = arguments.files.as_slice() else {
            anyhow::bail!("a mapping is proposed for one table at a time");
        };
        return propose(path, robot, out);
    }
    for path in &arguments.files {
        say(path.display())?;
        let inspections = settings.inspected(path);
        for inspection in inspections.with_context(|| format!("cannot inspect {}", path.display()))? {
            say(table::inspection(&inspection))?;
        }
    }
    Ok(())
}

/// Writes a mapping for a table and prints its reasons.
fn propose(path: &Path, robot: &RobotConfig, out: &Path) -> anyhow::Result<()> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let text = inspect::propose(&bytes, path, robot)?.to_toml()?;
    let mut file = File::create_new(out).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => anyhow::anyhow!(
            "{} exists and may have been edited; give another name with --propose",
            out.display()
        ),
        _ => anyhow::Error::new(error).context(format!("cannot create {}", out.display())),
    })?;
    file.write_all(text.as_bytes()).with_context(|| format!("cannot write {}", out.display()))?;
    let comments = text.lines().take_while(|line| line.starts_with('#'));
    show(comments.map(|line| format!("{line}\n")).collect::<String>())?;
    Ok(say(out.display())?)
}

impl InspectSettings {
    /// Inspections of a file. A bag may contain both the robot and the bar.
    fn inspected(&self, path: &Path) -> anyhow::Result<Vec<Inspection>> {
        if let (Some(mapping), Some(robot)) = (&self.rows, &self.robot) {
            return Ok(vec![mapping.inspected(path, robot)?]);
        }
        if logs::is_recording(path)? {
            return Ok(vec![inspect::recording(&Recording::open(path)?)]);
        }
        let bytes = std::fs::read(path)?;
        let begins = |with: &str| {
            let text = bytes.trim_ascii_start();
            text.get(..with.len()).is_some_and(|text| text.eq_ignore_ascii_case(with.as_bytes()))
        };
        anyhow::ensure!(
            !begins("<!doctype html") && !begins("<html"),
            "it is a web page, not a log or recording; open it in a browser"
        );
        // The file is read as a log of the bar and as a log of the robot, as far as the options contain the configurations
        // of bar and robot.
        let has_bar_columns = OtherBarLog::is_usual_table(&bytes);
        let as_bar_log = self.bar.as_ref().map(|bar| {
            let log = OtherBarLog::read(&bytes, path, bar, self.recording_mapping.as_ref());
            log.map(|log| inspect::bar_log(&log)).map_err(|error| format!("as the bar's: {error}"))
        });
        let as_robot_log = self.robot.as_ref().filter(|_| !has_bar_columns).map(|robot| {
            let log = logs::read_with(&bytes, path, robot, &self.log_options);
            log.map(|log| inspect::robot_log(&log, robot)).map_err(|error| format!("as the robot's: {error}"))
        });
        let (mut found, mut refusals) = (Vec::new(), Vec::new());
        for result in [as_bar_log, as_robot_log].into_iter().flatten() {
            match result {
                Ok(inspection) => found.push(inspection),
                Err(refusal) => refusals.push(refusal),
            }
        }
        match (found.is_empty(), refusals.is_empty()) {
            (false, _) => Ok(found),
            (true, false) => anyhow::bail!(
                "{}; for a table of another layout --propose FILE writes a mapping",
                refusals.join("; ").trim_end_matches('.')
            ),
            _ if has_bar_columns => anyhow::bail!("it has counters of the bar; give its bar with --bar"),
            _ => anyhow::bail!(
                "it is not a recording; if it is a log, give its robot with --robot, or its bar with --bar"
            ),
        }
    }
}
