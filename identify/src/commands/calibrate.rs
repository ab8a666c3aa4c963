//! `identify calibrate`.

mod force_logs;
mod measured_poses;
mod refused;
mod sources;

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::config::{self, BallBarConfig, RobotConfig};

use self::force_logs::force_logs;
use self::sources::sources;
use super::on_terminal::OnTerminal;
use crate::calibrate::ball_bar::{self, BallBarCalibration, RunInput};
use crate::calibrate::measured_length::{self, LengthOptions, LengthRow};
use crate::calibrate::measured_pose::{HoldOut, WAVES_PER_TURN_MAX};
use crate::calibrate::truth::Comparison;
use crate::calibrate::{CostName, IdentifyConfig, LossName, SelectionName};
use crate::kinematics::flange_chain;
use crate::logs::{
    self, BarLog, BarLogMapping, LogFormat, LogOptions, MeasuredLengthMapping, MeasuredLengths, RobotLog,
    RobotLogMapping,
};
use crate::model::{JointWaves, Model, ParameterId};
use crate::prepare::{Prepared, WiringChoice};
use crate::report::file::{CalibrationFile, ClockEntry, Input, ParameterEntry, SolveEntry};
use crate::report::force::ForceEntry;
use crate::report::page::Page;
use crate::report::table;
use crate::simulate::Truth;
use crate::study::evidence;

#[derive(Debug, Args)]
pub struct CalibrateArguments {
    /// Recording of the ball-bar (.mcap; or a CSV of counters, or a ROS 2 bag); several runs of one robot are solved together
    #[arg(long, value_name = "FILE", requires_all = ["robot_log", "bar"])]
    recording: Vec<PathBuf>,
    /// Which column or joint of recordings of other programs is what, such as config/bar_log.toml
    #[arg(long, value_name = "FILE", requires = "recording")]
    recording_mapping: Option<PathBuf>,
    /// The robot's own log (CSV, ROS 2 bag, UR RTDE, ABB EGM, KUKA RSI), one for each recording in the same order
    #[arg(long, value_name = "FILE", requires = "recording")]
    robot_log: Vec<PathBuf>,
    /// Kind of the robot's logs; default: told by their content
    #[arg(long, value_name = "KIND", requires = "robot_log")]
    log_format: Option<LogFormat>,
    /// Which column or joint of the robot's logs is what, such as config/robot_log.toml
    #[arg(long, value_name = "FILE", requires = "robot_log")]
    log_mapping: Option<PathBuf>,
    /// Force on the bar (.csv with t_s and force_N), one for each recording, on the robot's clock or the bar's; a force in the
    /// robot's log is then not read
    #[arg(long, value_name = "FILE", requires = "recording")]
    force_log: Vec<PathBuf>,
    /// Which column of the force logs is what, such as config/force_log.toml
    #[arg(long, value_name = "FILE", requires = "force_log")]
    force_mapping: Option<PathBuf>,
    /// Take the bar as rigid although the robot's log has a force
    #[arg(long, requires = "recording", conflicts_with = "force_log")]
    ignore_force: bool,
    /// Poses with one measured length each (.csv), instead of a recording
    #[arg(long, value_name = "FILE", requires = "mapping", conflicts_with = "recording")]
    measured_lengths: Option<PathBuf>,
    /// Poses measured by a tracker (.csv), instead of a recording; rows in the order of the robot's motion
    #[arg(long, value_name = "FILE", requires = "mapping", conflicts_with_all = ["recording", "measured_lengths"])]
    measured_poses: Option<PathBuf>,
    /// Which column of the measured lengths or poses is what, such as config/measured_pose.toml
    #[arg(long, value_name = "FILE", conflicts_with = "recording")]
    mapping: Option<PathBuf>,
    /// Other files of measured poses that judge the robot; tracker and probe may be elsewhere
    #[arg(long, value_name = "FILES", requires = "measured_poses", value_delimiter = ',')]
    validate: Vec<PathBuf>,
    /// Highest number of waves per turn that the errors of joints may have, with measured poses; 3 to 127
    #[arg(long, value_name = "N", requires = "measured_poses", default_value_t = WAVES_PER_TURN_MAX,
          value_parser = clap::value_parser!(u8).range(i64::from(JointWaves::FIRST)..=i64::from(JointWaves::LAST)))]
    joint_waves: u8,
    /// Which of the measured lengths or poses are held out together; default: rows of lengths, regions of poses
    #[arg(long, value_enum, requires = "mapping")]
    hold_out: Option<HoldOut>,
    /// Decides which of the measured lengths or poses are held out
    #[arg(long, default_value_t = LengthOptions::default().seed)]
    seed: u64,
    /// The robot's configuration, such as config/robots/irb2400_16.toml
    #[arg(long, value_name = "FILE")]
    robot: PathBuf,
    /// The bar's configuration, such as config/ball_bar.toml: one for all recordings, or one for each
    #[arg(long, value_name = "FILE")]
    bar: Vec<PathBuf>,
    /// Directory for calibration.toml
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What to minimise, what is free; default: see config/identify.toml
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Cost; default: the best that the encoders allow
    #[arg(long)]
    cost: Option<CostName>,
    /// How much samples count that do not fit; default: huber with pose, none with the others
    #[arg(long)]
    loss: Option<LossName>,
    /// Start from random subsets of the samples: where more than a fifth of them may be wrong
    #[arg(long)]
    ransac: bool,
    /// Free parameters
    #[arg(long)]
    selection: Option<SelectionName>,
    /// Also free these parameters
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    free: Vec<String>,
    /// Fix these parameters
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    fix: Vec<String>,
    /// Which encoder sits on which joint: find, recorded, or for each encoder of the recording its joint, negative where
    /// it counts the other way, such as 1,2,-3,5,4; default: find
    #[arg(long, value_name = "WIRING", allow_hyphen_values = true, requires = "recording")]
    encoders: Option<WiringChoice>,
    /// True parameters of a simulated experiment (the first one), to compare with
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
}

pub fn run(arguments: &CalibrateArguments) -> anyhow::Result<()> {
    let robot: RobotConfig = config::load(&arguments.robot)?;
    if !arguments.recording.is_empty() {
        return from_ball_bar(arguments, &robot);
    }
    match (&arguments.measured_lengths, &arguments.measured_poses, &arguments.mapping) {
        (Some(lengths), _, Some(mapping)) => from_measured_lengths(arguments, &robot, lengths, mapping),
        (_, Some(poses), Some(mapping)) => measured_poses::run(arguments, &robot, poses, mapping),
        _ => anyhow::bail!(
            "nothing to calibrate from; give --recording with --robot-log and --bar, or --measured-lengths or \
             --measured-poses with --mapping"
        ),
    }
}

/// The configuration file with what was typed on top of it.
fn identify_config(arguments: &CalibrateArguments) -> anyhow::Result<IdentifyConfig> {
    let file = arguments.config.as_deref();
    let mut config: IdentifyConfig = file.map_or_else(|| Ok(IdentifyConfig::default()), config::load)?;
    config.cost = arguments.cost.or(config.cost);
    config.loss = arguments.loss.or(config.loss);
    config.ransac |= arguments.ransac;
    config.selection = arguments.selection.unwrap_or(config.selection);
    config.free.extend_from_slice(&arguments.free);
    config.fix.extend_from_slice(&arguments.fix);
    if let Some(encoders) = &arguments.encoders {
        config.prepare.encoders.clone_from(encoders);
    }
    Ok(config)
}

/// One run as it was read.
struct RunFiles<'a> {
    recording_path: &'a Path,
    log_path: &'a Path,
    bar_path: &'a Path,
    recording: BarLog,
    log: RobotLog,
    bar: BallBarConfig,
}

fn runs<'a>(arguments: &'a CalibrateArguments, robot: &RobotConfig) -> anyhow::Result<Vec<RunFiles<'a>>> {
    let log_mapping: Option<RobotLogMapping> =
        arguments.log_mapping.as_deref().map(config::load).transpose()?;
    let log_options = LogOptions { format: arguments.log_format, mapping: log_mapping };
    let bar_mapping: Option<BarLogMapping> =
        arguments.recording_mapping.as_deref().map(config::load).transpose()?;
    let CalibrateArguments { recording, robot_log, bar, .. } = arguments;
    anyhow::ensure!(
        recording.len() == robot_log.len(),
        "{} recordings and {} robot logs; give one --robot-log for each --recording, in the same order",
        recording.len(),
        robot_log.len()
    );
    anyhow::ensure!(
        bar.len() == 1 || bar.len() == recording.len(),
        "{} recordings and {} bars; give one --bar for all, or one for each --recording",
        recording.len(),
        bar.len()
    );
    let forces = force_logs(arguments, robot)?;
    let bars = bar.iter().cycle();
    let read =
        |(((recording_path, log_path), bar_path), force): (((&'a PathBuf, &'a PathBuf), &'a PathBuf), _)| {
            let bar: BallBarConfig = config::load(bar_path)?;
            let mut log = load_log(log_path, robot, &log_options)?;
            log.force = if arguments.ignore_force { None } else { Option::or(force, log.force) };
            Ok(RunFiles {
                recording: load_recording(recording_path, &bar, bar_mapping.as_ref())?,
                log,
                bar,
                recording_path,
                log_path,
                bar_path,
            })
        };
    recording.iter().zip(robot_log).zip(bars).zip(forces).map(read).collect()
}

/// Reads the bar's side of a run and says what is odd about it, and what its file cannot say.
fn load_recording(
    path: &Path,
    bar: &BallBarConfig,
    mapping: Option<&BarLogMapping>,
) -> anyhow::Result<BarLog> {
    let log = BarLog::load(path, bar, mapping)?;
    if let BarLog::Other(other) = &log {
        tracing::info!("{}: {}; it does not say {}", path.display(), other.kind, other.unknown.join(", "));
        for remark in &other.quality.remarks {
            tracing::warn!("{}: {remark}", path.display());
        }
    }
    Ok(log)
}

/// Reads a robot's log and says what is odd about it.
fn load_log(path: &Path, robot: &RobotConfig, options: &LogOptions) -> anyhow::Result<RobotLog> {
    let log = logs::load_with(path, robot, options)?;
    for remark in &log.quality.remarks {
        tracing::warn!("{}: {remark}", path.display());
    }
    Ok(log)
}

fn from_ball_bar(arguments: &CalibrateArguments, robot: &RobotConfig) -> anyhow::Result<()> {
    let config = identify_config(arguments)?;
    let truth = arguments.truth.as_deref().map(load_truth).transpose()?;
    let runs = runs(arguments, robot)?;
    let inputs: Vec<RunInput<'_>> = runs
        .iter()
        .map(|run| RunInput {
            cycles: run.recording.cycles(),
            encoders: run.recording.encoders(),
            unwrapped: run.recording.unwrapped(),
            log: &run.log,
            bar: &run.bar,
        })
        .collect();
    let on_terminal = OnTerminal::new();
    let calibration = ball_bar::calibrate_runs(&inputs, robot, &config, Some(&on_terminal));
    let limits_deg = &robot.joint_limits_deg;
    let studied = calibration.and_then(|calibration| {
        let evidence = evidence(&calibration, limits_deg);
        let evidence = evidence.with_validation(&calibration, &config, limits_deg, Some(&on_terminal))?;
        Ok((calibration, evidence))
    });
    on_terminal.finish();
    let (calibration, evidence) =
        studied.map_err(|error| refused::of_runs(arguments, robot, &runs, &config, error))?;
    let mut file = calibration_file(arguments, robot, &runs, &calibration)?.with_validation(&evidence);
    let mut forces = ForceEntry::all(&evidence.spheres).into_iter();
    (file.force, file.other_forces) = (forces.next(), forces.collect());
    let written = file.write(&arguments.out)?;
    file.write_robot(robot, runs.first().map(|run| &run.bar), &arguments.out)?;
    let page = Page {
        file: &file,
        calibration: &calibration,
        evidence: &evidence,
        sources: &sources(&runs),
        configuration: &toml::to_string(&config)?,
    };
    let page = page.write(&arguments.out)?;
    print!("{}", table::calibration(&file));
    for limit in evidence.limits.iter().filter(|limit| limit.serious) {
        println!("! {}", limit.sentence);
    }
    if let Some(truth) = &truth {
        print!("\n{}", table::comparison(&Comparison::new(&calibration, truth)));
    }
    println!("\n{}\n{}", written.display(), page.display());
    Ok(())
}

/// Every file that was read, with what it is.
fn input_files<'a>(
    arguments: &'a CalibrateArguments,
    runs: &'a [RunFiles<'_>],
) -> Vec<(&'static str, &'a Path)> {
    let mut files = vec![("robot", arguments.robot.as_path())];
    for run in runs {
        files.extend([("recording", run.recording_path), ("robot log", run.log_path), ("bar", run.bar_path)]);
    }
    let mappings = [
        ("recording mapping", &arguments.recording_mapping),
        ("robot log mapping", &arguments.log_mapping),
        ("force log mapping", &arguments.force_mapping),
    ];
    for (role, path) in mappings {
        files.extend(path.as_deref().map(|path| (role, path)));
    }
    files.extend(arguments.force_log.iter().map(|path| ("force log", path.as_path())));
    files
}

fn calibration_file(
    arguments: &CalibrateArguments,
    robot: &RobotConfig,
    runs: &[RunFiles<'_>],
    calibration: &BallBarCalibration,
) -> anyhow::Result<CalibrationFile> {
    let solution = &calibration.solution;
    let bar = runs.first().map_or("", |run| run.bar.name.as_str());
    let mut clocks = (runs.iter().zip(calibration.runs()))
        .map(|(run, (prepared, model))| clock_entry(&run.recording, prepared, model));
    let mut file = CalibrationFile::new(
        &robot.name,
        bar,
        SolveEntry::new(calibration.cost.name(), &solution.summary, &solution.identifiability),
        clocks.next(),
        inputs(&input_files(arguments, runs))?,
        ParameterEntry::of_runs(calibration),
    )
    .with_knowledge(&calibration.model, solution);
    file.other_clocks = clocks.collect();
    file.candidates.clone_from(&calibration.candidates);
    Ok(file)
}

/// The files of a calibration with their checksums.
fn inputs(files: &[(&str, &Path)]) -> anyhow::Result<Vec<Input>> {
    let input = |&(role, path): &(&str, &Path)| {
        Input::of(role, path).with_context(|| format!("cannot read {}", path.display()))
    };
    files.iter().map(input).collect()
}

fn from_measured_lengths(
    arguments: &CalibrateArguments,
    robot: &RobotConfig,
    lengths_path: &Path,
    mapping_path: &Path,
) -> anyhow::Result<()> {
    let mapping: MeasuredLengthMapping = config::load(mapping_path)?;
    let measured = MeasuredLengths::load(lengths_path, &mapping)?;
    let rows: Vec<LengthRow> = measured
        .rows
        .iter()
        .map(|row| LengthRow { joints_rad: row.q_rad, length_m: row.length_m, flange_m: row.flange_m })
        .collect();
    let usual = LengthOptions::default();
    let options = LengthOptions {
        seed: arguments.seed,
        hold_out: arguments.hold_out.unwrap_or(usual.hold_out),
        ..usual
    };
    let files: [(&str, &Path); 3] =
        [("measured lengths", lengths_path), ("mapping", mapping_path), ("robot", &arguments.robot)];
    let report = measured_length::calibrate(&rows, &flange_chain(robot), &options)
        .map_err(|error| refused::of_rows(arguments, robot, &files, &options, error))?;
    let sigma = |id| report.parameters.iter().find(|one| one.id == id).and_then(|one| one.sigma);
    let file = CalibrationFile::new(
        &robot.name,
        "measured lengths",
        SolveEntry::new("measured_length", &report.summary, &report.identifiability),
        None,
        inputs(&files)?,
        ParameterEntry::all(&report.model, sigma),
    );
    let written = file.write(&arguments.out)?;
    file.write_robot(robot, None, &arguments.out)?;
    print!("{}", table::calibration(&file));
    let lines: Vec<u64> = measured.rows.iter().map(|row| row.line).collect();
    print!("\n{}", table::lengths(&report, &lines));
    println!("\n{}", written.display());
    Ok(())
}

/// `recording` is the one whose clock it is.
fn clock_entry(recording: &BarLog, prepared: &Prepared, model: &Model) -> ClockEntry {
    let has_date = !matches!(recording, BarLog::Other(other) if !other.is_dated);
    let value = |id| model.parameter(id).map_or(0.0, |parameter| parameter.value);
    ClockEntry {
        reference_utc: if has_date {
            prepared.t_ref.to_string()
        } else {
            format!("{:.3} s (the recording's clock, zero unknown)", prepared.t_ref.0 as f64 * 1e-9)
        },
        robot_minus_bar_ns: prepared.clock_difference_ns(value(ParameterId::ClockShift)),
        skew_ppm: value(ParameterId::ClockSkew) * 1e6,
        correlation: prepared.alignment.correlation,
        overlap_s: prepared.alignment.overlap_s,
    }
}

fn load_truth(path: &Path) -> anyhow::Result<Truth> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    toml::from_str(&text)
        .with_context(|| format!("{} is no truth.toml of `identify simulate`", path.display()))
}
