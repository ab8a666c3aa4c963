//! The command line.

mod calibrate;
mod compare;
mod examine;
mod inspect;
mod on_terminal;
mod plan;
mod robot;
mod simulate;
mod study;

pub use on_terminal::interrupt;

use std::ffi::OsString;
use std::fs::File;
use std::path::Path;

use anyhow::Context;
use clap::{CommandFactory, Parser, Subcommand};
use generate::GenerateArguments;

use shared::version::version;

/// Calibrates a robot from a ball-bar recording and the robot's own log.
#[derive(Debug, Parser)]
#[command(name = "identify", version = version(), about)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Identify the robot's geometry.
    Calibrate(Box<calibrate::CalibrateArguments>),
    /// List what each cost can identify on a robot and a bar, before anything is measured.
    Examine(examine::ExamineArguments),
    /// Show what is in recordings and robot logs, and what is suspicious in them.
    Inspect(inspect::InspectArguments),
    /// Put several calibrations of one robot side by side: do they agree within their uncertainty?
    Compare(compare::CompareArguments),
    /// Take a robot's configuration from a URDF, or check and draw one.
    Robot(robot::RobotArguments),
    /// Plan a path that the robot can drive and a calibration learns much from, or check one.
    Plan(Box<plan::PlanArguments>),
    /// Make an experiment with known errors: what was measured, and the truth beside it.
    Simulate(simulate::SimulateArguments),
    /// Simulate experiments by the thousand and show what each estimator makes of them: the thesis' chapter 3.
    Study(Box<study::StudyArguments>),
    /// Write completions for a shell, or man pages.
    Generate(GenerateArguments),
}

impl Arguments {
    /// Parses the words of a command line, the program's name first. `identify calibrate --recording ..` means the ball-bar,
    /// `identify calibrate --experiment ..` whatever the file says, `identify plan --robot ..` a path, `identify simulate --robot ..` the ball-bar.
    ///
    /// # Errors
    /// Those of clap; help and version are errors, too.
    pub fn typed(words: impl IntoIterator<Item = OsString>) -> Result<Self, clap::Error> {
        let mut words: Vec<OsString> = words.into_iter().collect();
        let is_option = |word: &OsString| word.to_str().is_some_and(|word| word.starts_with("--"));
        let option_first = words.get(2).is_some_and(|word| is_option(word) && word != "--help");
        if option_first && words.get(1).is_some_and(|word| word == "plan") {
            words.insert(2, "path".into());
        } else if option_first && words.get(1).is_some_and(|word| word == "simulate") {
            words.insert(2, "bar".into());
        } else if option_first && words.get(1).is_some_and(|word| word == "calibrate") {
            let mixed = words.iter().any(|word| {
                word.to_str().is_some_and(|word| word == "--experiment" || word.starts_with("--experiment="))
            });
            words.insert(2, if mixed { "experiment".into() } else { "bar".into() });
        }
        Self::try_parse_from(words)
    }
}

/// Files can be made in this directory, which need not exist yet: tried before any work is done, and nothing is left there.
fn ensure_can_write(directory: &Path) -> anyhow::Result<()> {
    let above = directory.ancestors();
    let mut above = above.map(|path| if path.as_os_str().is_empty() { Path::new(".") } else { path });
    let there = above.find(|path| path.exists()).unwrap_or(directory);
    anyhow::ensure!(
        there.is_dir(),
        "--out {}: {} is a file; give a directory",
        directory.display(),
        there.display()
    );
    let trial = there.join(format!(".identify-{}", std::process::id()));
    let tried = File::create_new(&trial).and_then(|_| std::fs::remove_file(&trial));
    tried.with_context(|| {
        let (out, there) = (directory.display(), there.display());
        format!("--out {out}: cannot write in {there}; give another directory")
    })
}

/// Runs a command; an error's text is meant for the user.
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Command::Calibrate(arguments) => calibrate::run(&arguments),
        Command::Examine(arguments) => examine::run(&arguments),
        Command::Inspect(arguments) => inspect::run(&arguments),
        Command::Compare(arguments) => compare::run(&arguments),
        Command::Robot(arguments) => robot::run(&arguments),
        Command::Plan(arguments) => plan::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Study(arguments) => study::run(&arguments),
        Command::Generate(arguments) => Ok(arguments.run(Arguments::command())?),
    }
}
