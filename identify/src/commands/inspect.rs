//! `identify inspect`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::config::{self, RobotConfig};
use shared::recording::Recording;

use crate::inspect::{self, Inspection};
use crate::logs;
use crate::report::table;

#[derive(Debug, Args)]
pub struct InspectArguments {
    /// Recordings of the ball-bar (.mcap) and logs of the robot
    #[arg(required = true, value_name = "FILES")]
    files: Vec<PathBuf>,
    /// The robot's configuration, such as config/robots/irb2400_16.toml: says how its log becomes joint angles
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
}

pub fn run(arguments: &InspectArguments) -> anyhow::Result<()> {
    let robot = arguments.robot.as_deref().map(config::load::<RobotConfig>).transpose()?;
    for path in &arguments.files {
        println!("{}", path.display());
        println!("{}", table::inspection(&inspected(path, robot.as_ref())?));
    }
    Ok(())
}

fn inspected(path: &Path, robot: Option<&RobotConfig>) -> anyhow::Result<Inspection> {
    let ours = path.extension().is_some_and(|ending| ending == "mcap");
    let cannot = || format!("cannot inspect {}", path.display());
    match (ours.then(|| Recording::open(path)), robot) {
        (Some(Ok(recording)), _) => Ok(inspect::recording(&recording)),
        (Some(Err(error)), None) => Err(error).with_context(cannot),
        // A robot's log may be MCAP too.
        (_, Some(robot)) => Ok(inspect::robot_log(&logs::load(path, robot).with_context(cannot)?)),
        (None, None) => anyhow::bail!(
            "{} is no recording; if it is a robot's log, say with --robot which robot's",
            path.display()
        ),
    }
}
