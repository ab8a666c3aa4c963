//! `identify robot`: a robot's configuration before anything is measured.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, Subcommand};
use shared::config::{self, RobotConfig};
use shared::output::{say, show};

use crate::report::{picture, robot_check};
use crate::robot::{check, import};

#[derive(Debug, Args)]
pub struct RobotArguments {
    #[command(subcommand)]
    command: RobotCommand,
}

#[derive(Debug, Subcommand)]
enum RobotCommand {
    /// Make a configuration from a URDF: the joints between two of its links as Denavit-Hartenberg links.
    Import(ImportArguments),
    /// Draw and explain a configuration: axes, conventions, limits, reach, and what looks wrong.
    Check(CheckArguments),
}

#[derive(Debug, Args)]
struct ImportArguments {
    /// The robot's URDF
    #[arg(value_name = "URDF")]
    urdf: PathBuf,
    /// Link where the robot's base frame is; default: the one that hangs on none
    #[arg(long, value_name = "LINK")]
    base: Option<String>,
    /// Link that is the flange; default: the one on which none hangs
    #[arg(long, value_name = "LINK")]
    tip: Option<String>,
    /// Where the configuration goes; default: the URDF's name with .toml, in the current directory
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct CheckArguments {
    /// The robot's configuration, such as config/robots/ur10.toml
    #[arg(value_name = "FILE")]
    robot: PathBuf,
    /// Where the picture goes; default: the configuration's name with .svg, in the current directory
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
}

pub fn run(arguments: &RobotArguments) -> anyhow::Result<()> {
    match &arguments.command {
        RobotCommand::Import(arguments) => run_import(arguments),
        RobotCommand::Check(arguments) => run_check(arguments),
    }
}

/// What was asked for, or the name of a file with another ending, here.
fn place(asked: Option<&PathBuf>, like: &Path, ending: &str) -> PathBuf {
    asked
        .cloned()
        .unwrap_or_else(|| PathBuf::from(like.file_name().unwrap_or_default()).with_extension(ending))
}

/// Nobody's file is lost to a default name.
fn write_new(path: &Path, text: &str, asked: bool) -> anyhow::Result<()> {
    let exists = !asked && path.exists();
    anyhow::ensure!(
        !exists,
        "{} exists already; name another file, or this one, with its option",
        path.display()
    );
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

fn run_import(arguments: &ImportArguments) -> anyhow::Result<()> {
    let urdf = &arguments.urdf;
    let text = std::fs::read_to_string(urdf).with_context(|| format!("cannot read {}", urdf.display()))?;
    let imported = import(&text, arguments.base.as_deref(), arguments.tip.as_deref())
        .with_context(|| urdf.display().to_string())?;
    let out = place(arguments.out.as_ref(), urdf, "toml");
    let source = urdf.file_name().unwrap_or_default().to_string_lossy();
    write_new(&out, &imported.to_toml(&source), arguments.out.is_some())?;
    say(format_args!(
        "{}: {} axes from link `{}` to link `{}`: {}",
        imported.config.name,
        imported.config.axes(),
        imported.base,
        imported.tip,
        imported.joints.join(", ")
    ))?;
    for sentence in &imported.assumed {
        say(format_args!("  {sentence}"))?;
    }
    say(format_args!(
        "written to {}; look at it with `identify robot check {}`",
        out.display(),
        out.display()
    ))?;
    Ok(())
}

fn run_check(arguments: &CheckArguments) -> anyhow::Result<()> {
    let robot: RobotConfig = config::load(&arguments.robot)?;
    let checked = check(&robot);
    show(robot_check(&robot, &checked))?;
    let out = place(arguments.picture.as_ref(), &arguments.robot, "svg");
    let picture = picture(&checked)?;
    std::fs::write(&out, picture).with_context(|| format!("cannot write {}", out.display()))?;
    say(format_args!("\npicture: {}", out.display()))?;
    Ok(())
}
