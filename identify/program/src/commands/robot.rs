//! `identify robot` creates a robot's configuration from a URDF, lists the known ones, or checks and draws one.

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, Subcommand};
use shared::config::{self, RobotConfig, Source};
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
    /// Convert the joints between two links of a URDF to a configuration with Denavit-Hartenberg parameters.
    #[command(after_help = "Example: identify robot import arm.urdf --tip tool0 --out arm.toml")]
    Import(ImportArguments),
    /// List the robots that `--robot` accepts by name instead of by file.
    #[command(after_help = "Example: identify robot list")]
    List,
    /// Describe and draw a configuration: axes, conventions, limits, reach, and suspicious values.
    #[command(after_help = "Example: identify robot check arm.toml --picture arm.svg")]
    Check(CheckRobotArguments),
}

#[derive(Debug, Args)]
struct ImportArguments {
    /// The robot's URDF
    #[arg(value_name = "URDF")]
    urdf: PathBuf,
    /// URDF link with the robot's base frame; default: base_link, base, link0 or link_0, else the
    /// link that carries the first axis
    #[arg(long, help_heading = "Input", value_name = "LINK")]
    base: Option<String>,
    /// URDF link that is the flange; default: tool0 or flange, else the end of the longest chain of axes, without a gripper
    #[arg(long, help_heading = "Input", value_name = "LINK")]
    tip: Option<String>,
    /// File for the configuration; default: the URDF's name with .toml, in the current directory
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    out: Option<PathBuf>,
    /// Overwrite the configuration if it exists
    #[arg(long, help_heading = "Output")]
    force: bool,
}

#[derive(Debug, Args)]
struct CheckRobotArguments {
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16
    #[arg(value_name = "FILE")]
    robot: PathBuf,
    /// File for the picture (SVG); default: the configuration's name with .svg, in the current directory
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    picture: Option<PathBuf>,
}

pub fn run(arguments: &RobotArguments) -> anyhow::Result<()> {
    match &arguments.command {
        RobotCommand::Import(arguments) => run_import(arguments),
        RobotCommand::List => run_list(),
        RobotCommand::Check(arguments) => run_check(arguments),
    }
}

/// The path `given` by the user. The default is a path in the current directory: the file name of `like` with this ending.
fn output_path(given: Option<&PathBuf>, like: &Path, ending: &str) -> PathBuf {
    given
        .cloned()
        .unwrap_or_else(|| PathBuf::from(like.file_name().unwrap_or_default()).with_extension(ending))
}

fn run_import(arguments: &ImportArguments) -> anyhow::Result<()> {
    let urdf = &arguments.urdf;
    let text = std::fs::read(urdf).with_context(|| format!("cannot read {}", urdf.display()))?;
    // Comments may be in any encoding; names of links and joints are ASCII.
    let text = String::from_utf8_lossy(&text);
    let imported = import(&text, arguments.base.as_deref(), arguments.tip.as_deref())
        .with_context(|| urdf.display().to_string())?;
    let out = output_path(arguments.out.as_ref(), urdf, "toml");
    let source = urdf.file_name().unwrap_or_default().to_string_lossy();
    let toml = imported.to_toml(&source);
    let file = if arguments.force { File::create(&out) } else { File::create_new(&out) };
    let written = match file {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => anyhow::bail!(
            "{} exists and may have been edited; give another name with --out, or --force",
            out.display()
        ),
        file => file.and_then(|mut file| file.write_all(toml.as_bytes())),
    };
    written.with_context(|| format!("cannot write {}", out.display()))?;
    say(format_args!(
        "{}: {} axes from link `{}` to link `{}`: {}",
        imported.config.name,
        imported.config.axes(),
        imported.base,
        imported.tip,
        imported.joints.join(", ")
    ))?;
    for sentence in imported.left_out.iter().chain(&imported.assumed) {
        say(format_args!("  {sentence}"))?;
    }
    say(format_args!(
        "written to {}; look at it with `identify robot check {}`",
        out.display(),
        out.display()
    ))?;
    Ok(())
}

fn run_list() -> anyhow::Result<()> {
    for (name, source) in Source::robots() {
        let robot = source.text().and_then(|text| config::parse::<RobotConfig>(&text, source.path()));
        // A file with an error must not prevent the listing of the others.
        let described = robot.map_or_else(|error| error.to_string(), |robot| robot.name);
        let place = match &source {
            Source::File(file) => file.display().to_string(),
            Source::BuiltIn(..) => "built in".into(),
        };
        say(format_args!("{name:<16} {described:<36} {place}"))?;
    }
    Ok(())
}

fn run_check(arguments: &CheckRobotArguments) -> anyhow::Result<()> {
    let robot: RobotConfig = config::load(&arguments.robot)?;
    let checked = check(&robot);
    show(robot_check(&robot, &checked))?;
    let out = output_path(arguments.picture.as_ref(), &arguments.robot, "svg");
    std::fs::write(&out, picture(&checked)).with_context(|| format!("cannot write {}", out.display()))?;
    say(format_args!("\npicture: {}", out.display()))?;
    Ok(())
}
