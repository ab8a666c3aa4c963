//! `identify examine` prints, for each cost, which parameters of a nominal robot and bar the
//! cost can identify ([`crate::examine`]).

use std::path::PathBuf;

use clap::Args;
use shared::config::{self, BallBarConfig, RobotConfig};
use shared::output::{say, show};

use super::ensure_follows_bar;
use crate::examine::examine;
use crate::instrument::CostName;
use crate::report::examination::examinations;

#[derive(Debug, Args)]
pub struct ExamineArguments {
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    robot: PathBuf,
    /// Configuration file of the bar. `ball_bar` is ball_bar.toml in config, else in /etc/ballbard, else the built-in one
    #[arg(long, help_heading = "Input", value_name = "FILE", default_value = "ball_bar")]
    bar: PathBuf,
    /// Cost functions to examine, separated by commas; default: all
    #[arg(long, help_heading = "Estimation", value_delimiter = ',')]
    cost: Vec<CostName>,
    /// Number of random poses
    #[arg(long, help_heading = "Estimation", default_value_t = 300, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=100_000))]
    poses: usize,
    /// Seed of the poses
    #[arg(long, help_heading = "Estimation", default_value_t = 1)]
    seed: u64,
}

/// All costs, from the one that needs most encoders to the one that needs none.
const ALL: [CostName; 5] =
    [CostName::Pose, CostName::Transform, CostName::PositionAngles, CostName::Position, CostName::Length];

pub fn run(arguments: &ExamineArguments) -> anyhow::Result<()> {
    let robot: RobotConfig = config::load(&arguments.robot)?;
    ensure_follows_bar(&robot)?;
    let bar: BallBarConfig = config::load(&arguments.bar)?;
    let costs = if arguments.cost.is_empty() { &ALL[..] } else { &arguments.cost };
    let examined = |&cost: &CostName| examine(&robot, &bar, cost, arguments.poses, arguments.seed);
    let found = costs.iter().map(examined).collect::<Result<Vec<_>, _>>()?;
    say(format_args!("{} with {}, {} random poses\n", robot.name, bar.name, arguments.poses))?;
    show(examinations(&found))?;
    Ok(())
}
