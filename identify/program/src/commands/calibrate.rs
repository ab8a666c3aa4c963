//! `identify calibrate`. Each instrument has a subcommand with its own options, so that every accepted option has an effect.
//! Each subcommand converts its options to an [`ExperimentFile`], which [`driver::calibrate`] calibrates.

mod bar;
mod driver;
mod experiment;
mod refused;
mod result;
mod rows;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use shared::config;

use crate::calibrate::IdentifyConfig;
use crate::calibrate::rows::WAVES_PER_TURN_MAX;
use crate::model::ParameterId;
use crate::solver::LossName;
use experiment::ExperimentFile;
use rows::{ContactArguments, RowFile, TouchArguments, TrackerArguments};

const AFTER_HELP: &str = "Example: identify calibrate --recording runs/monday-1.mcap --robot-log monday-1.csv --robot irb2400_16 \
    --out monday-1\n\n\
    Without a command, `identify calibrate` has the options of `identify calibrate bar`.\n\
    `identify calibrate --experiment FILE --out DIR` calibrates from any mix of instruments;\n\
    config/experiment.toml explains FILE. The directory of every result contains an experiment.toml,\n\
    from which this command repeats the calibration.";

/// The instruments, each with its options.
#[derive(Debug, Args)]
#[command(after_help = AFTER_HELP)]
pub struct CalibrateArguments {
    #[command(subcommand)]
    command: CalibrateCommand,
}

#[derive(Debug, Subcommand)]
enum CalibrateCommand {
    /// Calibrate from recordings of the ball-bar and logs of the robot
    #[command(
        after_help = "Example: identify calibrate bar --recording runs/monday-1.mcap --robot-log monday-1.csv --robot irb2400_16 --out monday-1"
    )]
    Bar(Box<bar::BarArguments>),
    /// Calibrate from lengths that a draw-wire or a telescoping bar measured at poses of the robot
    #[command(
        after_help = "Example: identify calibrate wire lengths.csv --mapping measured_length --robot irb120_3 --out wire"
    )]
    Wire(RowArguments),
    /// Calibrate from positions or poses measured by a laser tracker
    #[command(
        after_help = "Example: identify calibrate tracker poses.csv --mapping measured_pose --robot ur10 --out tracker"
    )]
    Tracker(TrackerArguments),
    /// Calibrate from poses at which a ball on the flange is seated in sockets at known distances
    #[command(
        after_help = "Example: identify calibrate contact contacts.csv --sockets sockets.toml --mapping contact --robot irb120_3 --out contact"
    )]
    Contact(ContactArguments),
    /// Calibrate from poses at which a touch probe or dial gauge on the flange touches flat faces
    #[command(
        after_help = "Example: identify calibrate touch touches.csv --faces faces.toml --mapping touch --robot irb120_3 --out touch"
    )]
    Touch(TouchArguments),
    /// Calibrate from any mix of instruments; used by `identify calibrate --experiment`
    #[command(hide = true, after_help = "Example: identify calibrate --experiment cell3.toml --out cell3")]
    Experiment(experiment::ExperimentArguments),
}

/// Options of every calibration except that of an experiment's file.
#[derive(Debug, Args)]
pub struct CommonArguments {
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    robot: PathBuf,
    /// File with the settings of the calibration; default: the settings in config/identify.toml
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Robust loss, which reduces the weight of samples with large residuals; default: huber, but none for the
    /// ball-bar with another cost than pose
    #[arg(long, help_heading = "Estimation")]
    loss: Option<LossName>,
    /// Parameters to estimate in addition, such as ra6,rd6; separate them by commas, or repeat --free
    #[arg(long, help_heading = "Estimation", value_name = "NAMES", value_delimiter = ',')]
    free: Vec<ParameterId>,
    /// Parameters not to estimate, such as ra6,rd6; separate them by commas, or repeat --fix
    #[arg(long, help_heading = "Estimation", value_name = "NAMES", value_delimiter = ',')]
    fix: Vec<ParameterId>,
    #[command(flatten)]
    result: ResultArguments,
}

impl CommonArguments {
    /// An experiment with these settings, but without data sets.
    fn experiment(&self) -> anyhow::Result<ExperimentFile> {
        let identify = self.identify_config()?;
        Ok(ExperimentFile { robot: self.robot.clone(), identify, ..ExperimentFile::default() })
    }

    /// Settings of the configuration file, overridden by the options.
    fn identify_config(&self) -> anyhow::Result<IdentifyConfig> {
        let Self { free, fix, .. } = self;
        let file = self.config.as_deref();
        let mut config: IdentifyConfig = file.map_or_else(|| Ok(IdentifyConfig::default()), config::load)?;
        config.loss = self.loss.or(config.loss);
        config.require_mm = self.result.require.or(config.require_mm);
        // A parameter in `--free` is removed from the file's list of fixed parameters, and a parameter in `--fix` from the
        // file's list of free parameters.
        if let Some(both) = fix.iter().find(|id| free.contains(id)) {
            anyhow::bail!("{both} is in --free and in --fix; leave it out of one");
        }
        config.fix.retain(|id| !free.contains(id));
        config.free.retain(|id| !fix.contains(id));
        config.free.extend_from_slice(free);
        config.fix.extend_from_slice(fix);
        Ok(config)
    }
}

/// Directory of the results, required accuracy, and how much is printed.
#[derive(Debug, Clone, Args)]
pub struct ResultArguments {
    /// Directory for all results: report.html, calibration.toml, corrections.csv and others
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: PathBuf,
    /// Also print every parameter with the source of its uncertainty, the error terms, the errors on
    /// held-out data, and all limitations
    #[arg(long, help_heading = "Output")]
    verbose: bool,
    /// Largest permitted position error of the calibrated robot, such as 0.2mm; the verdict reports whether the
    /// robot meets it. Default: no limit
    #[arg(long, help_heading = "Estimation", value_name = "MM", value_parser = millimetres)]
    require: Option<f64>,
}

/// Parses a length above zero, with or without its unit \[mm\].
fn millimetres(text: &str) -> Result<f64, String> {
    let number = text.strip_suffix("mm").unwrap_or(text).trim().parse::<f64>().ok();
    number
        .filter(|mm| mm.is_finite() && *mm > 0.0)
        .ok_or_else(|| format!("`{text}` is not a length above zero; give millimetres, such as 0.2mm"))
}

/// Options of every calibration from a table of measurements.
#[derive(Debug, Args)]
pub struct RowArguments {
    #[command(flatten)]
    file: RowFile,
    #[command(flatten)]
    common: CommonArguments,
}

pub fn run(arguments: &CalibrateArguments) -> anyhow::Result<()> {
    match &arguments.command {
        CalibrateCommand::Bar(arguments) => bar::run(arguments),
        CalibrateCommand::Wire(rows) => rows.calibrate(|experiment| experiment.wires.push(rows.file.clone())),
        CalibrateCommand::Tracker(TrackerArguments { rows, robot_log, log_format, log_mapping }) => rows
            .calibrate(|experiment| {
                (experiment.log_format, experiment.log_mapping) = (*log_format, log_mapping.clone());
                experiment.trackers.push(RowFile {
                    joint_waves: Some(rows.file.joint_waves.unwrap_or(WAVES_PER_TURN_MAX)),
                    robot_log: robot_log.clone(),
                    ..rows.file.clone()
                });
            }),
        CalibrateCommand::Contact(ContactArguments { rows, sockets }) => rows.calibrate(|experiment| {
            experiment.contacts.push(RowFile { sockets: Some(sockets.clone()), ..rows.file.clone() });
        }),
        CalibrateCommand::Touch(TouchArguments { rows, faces }) => rows.calibrate(|experiment| {
            experiment.touches.push(RowFile { faces: faces.clone(), ..rows.file.clone() });
        }),
        CalibrateCommand::Experiment(arguments) => experiment::run(arguments),
    }
}

impl RowArguments {
    /// Calibrates from files of rows. `add` adds these files to an experiment.
    fn calibrate(&self, add: impl FnOnce(&mut ExperimentFile)) -> anyhow::Result<()> {
        let mut experiment = self.common.experiment()?;
        add(&mut experiment);
        driver::calibrate(experiment, &self.common.result, None)
    }
}
