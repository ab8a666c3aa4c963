//! The command line. [`IdentifyArguments::from_words`] parses it, and [`run`] calls the module of the command. Each of these
//! modules reads files, calls `identify-core`, and prints and writes the result with [`crate::report`].

mod calibrate;
mod compare;
mod examine;
mod inspect;
mod on_terminal;
mod plan;
mod robot;
mod simulate;
mod study;

pub use on_terminal::{allow_commands, interrupt};

use std::ffi::OsString;
use std::fs::File;
use std::path::Path;

use anyhow::Context;
use clap::{CommandFactory, Parser, Subcommand};
use generate::GenerateArguments;

use shared::config::{self, RobotConfig};
use shared::version::version;

use crate::logs::{RobotLogMapping, joints_of_robot};

const AFTER_HELP: &str = "Example: identify calibrate --recording runs/monday-1.mcap --robot-log monday-1.csv --robot irb2400_16 \
    --out monday-1\n\n\
    Exit codes:\n  \
    0    success\n  \
    1    failure, or: calibrate refuses the data or its verdict is red; plan check finds\n       \
         a violated constraint; plan poses finds a blocked move; study is interrupted,\n       \
         or all its estimates fail\n  \
    2    usage error: an unknown option or invalid value\n  \
    130  ended by Ctrl-C";

/// Calibrates a robot with a double ball-bar, a laser tracker, a draw-wire, a ball in sockets (contact), a touch probe or dial gauge
/// (touch), or any mix of them.
#[derive(Debug, Parser)]
#[command(name = "identify", version = version(), about, after_help = AFTER_HELP)]
pub struct IdentifyArguments {
    #[command(subcommand)]
    command: IdentifyCommand,
}

#[derive(Debug, Subcommand)]
enum IdentifyCommand {
    /// Identify the robot's geometry from measurements: bar, tracker, wire, contact, touch.
    Calibrate(Box<calibrate::CalibrateArguments>),
    /// List which parameters each cost function can identify for a robot and a bar; needs no measurements.
    #[command(after_help = "Example: identify examine --robot irb2400_16 --cost pose")]
    Examine(examine::ExamineArguments),
    /// Describe recordings, robot logs and tables, and list suspicious content.
    #[command(after_help = "Example: identify inspect runs/monday-1.mcap monday-1.csv --robot irb2400_16")]
    Inspect(inspect::InspectArguments),
    /// Compare calibrations of one robot: do they agree within their uncertainty?
    #[command(after_help = "Example: identify compare monday-1 tuesday-1 --out days.html")]
    Compare(compare::CompareArguments),
    /// Import a robot's configuration from a URDF, list the known configurations, or check and draw one.
    #[command(after_help = "Example: identify robot check irb2400_16")]
    Robot(robot::RobotArguments),
    /// Plan a path or poses for an accurate calibration, or check a path.
    #[command(after_help = "Example: identify plan --robot irb2400_16 --base 1.0,0.05,0.35 --out path")]
    Plan(Box<plan::PlanArguments>),
    /// Simulate an experiment with known errors, and write its measurements and the true values.
    #[command(after_help = "Example: identify simulate --robot irb2400_16 --out demo")]
    Simulate(simulate::SimulateArguments),
    /// Simulate thousands of experiments and compare estimators on them, as in chapter 3 of the thesis.
    Study(Box<study::StudyArguments>),
    /// Write completions for a shell, or man pages.
    #[command(
        after_help = "Example: identify generate completions bash",
        mut_subcommands(generate::with_example("identify"))
    )]
    Generate(GenerateArguments),
}

impl IdentifyArguments {
    /// Parses the words of a command line. The first word is the program's name. Without a subcommand, `plan` plans a
    /// path and `simulate` simulates the ball-bar. `calibrate` uses the ball-bar or, with `--experiment`, the instruments
    /// of the experiment file.
    ///
    /// # Errors
    /// Errors of clap. Requests for help or the version are returned as errors, too.
    pub fn from_words(words: impl IntoIterator<Item = OsString>) -> Result<Self, clap::Error> {
        let mut words: Vec<OsString> = words.into_iter().collect();
        if let Some(subcommand) = default_subcommand(&words) {
            words.insert(2, subcommand.into());
        }
        Self::try_parse_from(words)
    }
}

/// The default subcommand of a command, if an option directly follows the command. `None` if no default is needed.
fn default_subcommand(words: &[OsString]) -> Option<&'static str> {
    let [_, command, option, ..] = words else { return None };
    let option = option.to_str()?;
    if !option.starts_with("--") || option == "--help" {
        return None;
    }
    let is_experiment = |word: &str| word == "--experiment" || word.starts_with("--experiment=");
    match command.to_str()? {
        "plan" => Some("path"),
        "simulate" => Some("bar"),
        "calibrate" if words.iter().filter_map(|word| word.to_str()).any(is_experiment) => Some("experiment"),
        "calibrate" => Some("bar"),
        _ => None,
    }
}

/// Reads the mapping of a robot's logs. If the mapping contains joints, they must be the axes of the robot.
fn load_log_mapping(path: &Path, robot: &RobotConfig) -> anyhow::Result<RobotLogMapping> {
    let mapping: RobotLogMapping = config::load(path)?;
    if let Some(mapping) = mapping.with_joints() {
        joints_of_robot(&mapping.joints, robot, path)?;
    }
    Ok(mapping)
}

/// Checks that an arm has enough axes to follow the bar in all directions.
fn ensure_follows_bar(robot: &RobotConfig) -> anyhow::Result<()> {
    const AXES_MIN: usize = 6;
    anyhow::ensure!(
        robot.axes() >= AXES_MIN,
        "{} has {} axes; an arm needs {AXES_MIN} to follow the bar",
        robot.name,
        robot.axes()
    );
    Ok(())
}

/// Checks, before any work, that files can be created in a directory. If the directory does not exist yet, its
/// nearest existing parent is checked.
fn ensure_can_write(directory: &Path) -> anyhow::Result<()> {
    let parents = directory.ancestors();
    let mut parents = parents.map(|path| if path.as_os_str().is_empty() { Path::new(".") } else { path });
    let existing = parents.find(|path| path.exists()).unwrap_or(directory);
    anyhow::ensure!(
        existing.is_dir(),
        "--out {}: {} is a file; give a directory",
        directory.display(),
        existing.display()
    );
    let trial = existing.join(format!(".identify-{}", std::process::id()));
    let created = File::create_new(&trial).and_then(|_| std::fs::remove_file(&trial));
    created.with_context(|| {
        let (out, existing) = (directory.display(), existing.display());
        format!("--out {out}: cannot write in {existing}; give another directory")
    })
}

/// Runs a command. The text of an error is intended for the user.
pub fn run(arguments: IdentifyArguments) -> anyhow::Result<()> {
    match arguments.command {
        IdentifyCommand::Calibrate(arguments) => calibrate::run(&arguments),
        IdentifyCommand::Examine(arguments) => examine::run(&arguments),
        IdentifyCommand::Inspect(arguments) => inspect::run(&arguments),
        IdentifyCommand::Compare(arguments) => compare::run(&arguments),
        IdentifyCommand::Robot(arguments) => robot::run(&arguments),
        IdentifyCommand::Plan(arguments) => plan::run(&arguments),
        IdentifyCommand::Simulate(arguments) => simulate::run(&arguments),
        IdentifyCommand::Study(arguments) => study::run(&arguments),
        IdentifyCommand::Generate(arguments) => Ok(arguments.run(IdentifyArguments::command())?),
    }
}
