//! `identify plan` searches for a path of the bar, a position of the bar, or poses for a tracker or wire that give a
//! calibration much information ([`crate::plan`]). It can also check a path. It prints the expected accuracy, and
//! writes path, programs and page.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use clap::{Args, Subcommand, ValueEnum};
use shared::config::{self, BallBarConfig, JointKind, RobotConfig};
use shared::output::{say, show};
use shared::time::parse_duration;

use super::on_terminal::OnTerminal;
use super::simulate::numbers;
use super::{ensure_can_write, ensure_follows_bar, load_log_mapping};
use crate::cost::PoseNoise;
use crate::kinematics::{Chain, Joints, ball_bar_chain, flange_chain, robot_chain};
use crate::logs::{self, JointTableMapping, LogOptions, joints_of_robot};
use crate::model::ParameterId;
use crate::plan::{
    self, BestPath, Bodies, Constraints, Criterion, Design, Information, Language, MeasuredQuantity,
    PlaceRequest, PlannedPath, PoseRequest, ProgramError, ProgramPurpose, SearchProgress,
};
use crate::report::page::{PathPage, PosesPage};
use crate::report::path;
use crate::report::result::file::CalibrationFile;

#[derive(Debug, Args)]
pub struct PlanArguments {
    #[command(subcommand)]
    command: PlanCommand,
}

#[derive(Debug, Subcommand)]
enum PlanCommand {
    /// Find a path; `identify plan` without a command does the same.
    #[command(
        after_help = "Example: identify plan path --robot irb2400_16 --duration 2m --floor 0 --out path"
    )]
    Path(PathArguments),
    /// Propose a position of the bar and a length of its rod.
    #[command(after_help = "Example: identify plan place --robot ur10 --lengths 0.4,0.6 --height 0,0.5")]
    Place(PlaceArguments),
    /// Select poses for a tracker or a wire.
    #[command(
        after_help = "Example: identify plan poses --robot ur10 --measures positions --count 50 --out poses"
    )]
    Poses(Box<PosesArguments>),
    /// Check a path of the robot for violated constraints every millisecond, and print the expected accuracy of a calibration.
    #[command(
        after_help = "Example: identify plan check robot_path.csv --robot irb2400_16 --base 1.0,0.05,0.35"
    )]
    Check(CheckPathArguments),
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Planning")]
struct CellArguments {
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    robot: PathBuf,
    /// Configuration file of the bar. `ball_bar` is ball_bar.toml in config, else in /etc/ballbard, else the built-in one
    #[arg(long, help_heading = "Input", value_name = "FILE", default_value = "ball_bar")]
    bar: PathBuf,
    /// Centre of the bar's gimbal in the robot's base frame [m]; default: 1.0,0.05,0.35, or 1.7,0.05,0.6 if link 2 is longer
    /// than a metre
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    base: Option<[f64; 3]>,
    /// Highest speed of a revolute joint of the robot [rad/s]
    #[arg(long, value_name = "RAD_S", default_value_t = Design::IRB_2400.robot_speed_rad_s)]
    speed: f64,
    /// Highest speed of a linear axis of the robot [m/s]; default: the number of --speed
    #[arg(long, value_name = "M_S")]
    linear_speed_m_s: Option<f64>,
    /// Highest acceleration of a robot joint [rad/s^2, or m/s^2 for a linear axis]
    #[arg(long, value_name = "RAD_S2", default_value_t = 5.0)]
    acceleration: f64,
    #[command(flatten)]
    around: Around,
    /// Earlier calibration of this robot and bar: calibration.json or its directory. Its
    /// information is added to that of the path
    #[arg(long, help_heading = "Input", value_name = "PATH")]
    calibration: Option<PathBuf>,
}

/// Objects that the robot must not touch.
#[derive(Debug, Args)]
#[command(next_help_heading = "Planning")]
struct Around {
    /// Obstacle: a box with edges parallel to the axes of the robot's base frame, given by two
    /// opposite corners [m] (repeatable)
    #[arg(long = "box", value_name = "X,Y,Z,X,Y,Z", value_parser = numbers::<6>, allow_hyphen_values = true)]
    boxes: Vec<[f64; 6]>,
    /// Height of the floor in the robot's base frame [m]; default: no floor
    #[arg(long, value_name = "Z", allow_hyphen_values = true)]
    floor: Option<f64>,
    /// Radius of the robot's links for collision checks [mm]; default: a twentieth of the robot's reach
    #[arg(long, value_name = "MM")]
    link_radius_mm: Option<f64>,
}

fn above_zero(option: &str, value: f64) -> anyhow::Result<()> {
    anyhow::ensure!(value.is_finite() && value > 0.0, "--{option} is {value}; give a number above zero");
    Ok(())
}

/// Distance between target and last axis that a message proposes, so that the rotation of this axis can be measured \[m\].
const OFF_AXIS_M: f64 = 0.1;
/// Largest coordinate in a cell \[m\].
const CELL_M_MAX: f64 = 100.0;
/// Largest coordinate that a robot reaches \[m\].
pub(super) const REACH_M_MAX: f64 = 10.0;

/// Checks that coordinates are finite, and not larger than a limit that is plausible for metres.
pub(super) fn in_metres(option: &str, numbers: &[f64], limit_m: f64) -> anyhow::Result<()> {
    let list = |divisor: f64| {
        numbers.iter().map(|number| (number / divisor).to_string()).collect::<Vec<_>>().join(",")
    };
    anyhow::ensure!(
        numbers.iter().all(|number| number.is_finite()),
        "--{option} has {}; give numbers in metres",
        list(1.0)
    );
    anyhow::ensure!(
        numbers.iter().all(|number| number.abs() <= limit_m),
        "--{option} {} is in metres, and beyond {limit_m} m; if these are millimetres write --{option} {}",
        list(1.0),
        list(1e3)
    );
    Ok(())
}

/// Sets the posture of the design to the posture that the user typed, if there is one. The typed posture must have one
/// number for each axis.
pub(super) fn set_posture(design: &mut Design, typed: &[f64], robot: &RobotConfig) -> anyhow::Result<()> {
    let (given, axes) = (typed.len(), robot.axes());
    anyhow::ensure!(
        given == 0 || given == axes,
        "--posture has {given} numbers, {} has {axes} axes; give one for each",
        robot.name
    );
    if given > 0 {
        design.posture_deg = typed.iter().copied().collect();
    }
    Ok(())
}

impl Around {
    fn bodies(&self, reach_m: f64) -> anyhow::Result<Bodies> {
        self.link_radius_mm.map_or(Ok(()), |radius_mm| above_zero("link-radius-mm", radius_mm))?;
        self.boxes.iter().try_for_each(|corners| in_metres("box", corners, CELL_M_MAX))?;
        in_metres("floor", self.floor.as_slice(), CELL_M_MAX)?;
        let mut bodies = Bodies::for_reach(reach_m);
        bodies.link_radius_m = self.link_radius_mm.map_or(bodies.link_radius_m, |mm| mm * 1e-3);
        bodies.boxes_m = self.boxes.iter().map(|&[a, b, c, d, e, f]| [[a, b, c], [d, e, f]]).collect();
        bodies.floor_m = self.floor;
        Ok(bodies)
    }
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Planning")]
struct PathArguments {
    #[command(flatten)]
    cell: CellArguments,
    /// Quantity that the path minimises
    #[arg(long, value_enum, default_value_t)]
    criterion: Criterion,
    /// Directory for path.toml, robot_path.csv, path.html and a program for the robot's controller
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: PathBuf,
    /// Posture of the robot near which the motion begins, one number for each axis [deg, or mm for a linear axis]; it
    /// selects the configuration of elbow and wrist. Default: 0,20,10,0,60,0 for six axes, otherwise random
    #[arg(long, value_name = "Q1,Q2,..", value_delimiter = ',', allow_hyphen_values = true)]
    posture: Vec<f64>,
    /// Length of the run, such as 90s or 2m; a plain number is seconds
    #[arg(long, default_value = "2m", value_parser = parse_duration)]
    duration: Duration,
    /// Time limit of the search for better paths, such as 50s; afterwards the best path is checked at every millisecond
    #[arg(long, default_value = "50s", value_parser = parse_duration)]
    budget: Duration,
    /// Languages of the programs for robot controllers, separated by commas; default: the language of the robot's
    /// manufacturer, detected from the robot's name
    #[arg(long, help_heading = "Output", value_enum, value_delimiter = ',')]
    program: Vec<Language>,
    /// Seed of the search for paths
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Planning")]
struct PlaceArguments {
    #[command(flatten)]
    cell: CellArguments,
    /// Quantity that the path at each position of the bar minimises
    #[arg(long, value_enum, default_value_t)]
    criterion: Criterion,
    /// Rod lengths to compare [m], separated by commas; default: the length of the bar's rod
    #[arg(long, value_name = "M", value_delimiter = ',')]
    lengths: Vec<f64>,
    /// Lowest and highest position of the bar's gimbal above the robot's base frame [m]
    #[arg(long, value_name = "LOW,HIGH", value_parser = numbers::<2>, allow_hyphen_values = true, default_value = "0,1")]
    height: [f64; 2],
    /// Length of the run, such as 90s or 2m; a plain number is seconds
    #[arg(long, default_value = "2m", value_parser = parse_duration)]
    duration: Duration,
    /// Time limit of the search, such as 60s
    #[arg(long, default_value = "60s", value_parser = parse_duration)]
    budget: Duration,
    /// Seed of the search for positions of the bar
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Planning")]
struct PosesArguments {
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    robot: PathBuf,
    /// What is measured at each pose
    #[arg(long, value_enum)]
    measures: MeasuredQuantity,
    /// Directory for poses.csv, its mapping poses.toml, poses.html and a program for the robot's controller. If no path
    /// without collision was found for a move, poses.csv marks it as BLOCKED, programs stop there, and the exit code is 1
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: PathBuf,
    /// Number of poses to select
    #[arg(long, default_value_t = 50)]
    count: usize,
    /// Table of reachable poses to select from; default: random poses with each joint within half a turn of zero
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "mapping", conflicts_with_all = ["draw", "boxes", "floor", "link_radius_mm"])]
    candidates: Option<PathBuf>,
    /// Mapping file that names the joint columns of --candidates; any mapping for `calibrate tracker`, `wire`,
    /// `contact` or `touch` is accepted
    #[arg(long, help_heading = "Input", value_name = "FILE", requires = "candidates")]
    mapping: Option<PathBuf>,
    /// Number of random poses to select from
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=100_000))]
    draw: usize,
    #[command(flatten)]
    around: Around,
    /// Position of the reflector, of the probe's centre, or of the end of the wire in the flange frame [m]
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true, default_value = "0,0,0.1")]
    target: [f64; 3],
    /// Outlet of the draw-wire in the robot's base frame [m]; required with --measures lengths, refused otherwise
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    anchor: Option<[f64; 3]>,
    /// Standard deviation of a measured coordinate or length, including the repeatability of the robot [mm]
    #[arg(long, value_name = "MM", default_value_t = 0.05)]
    noise_mm: f64,
    /// Standard deviation of a measured orientation about each axis [mrad], for --measures poses only; default: 0.1
    #[arg(long, value_name = "MRAD")]
    noise_mrad: Option<f64>,
    /// Languages of the programs for robot controllers, separated by commas; default: the language of the robot's
    /// manufacturer, detected from the robot's name
    #[arg(long, help_heading = "Output", value_enum, value_delimiter = ',')]
    program: Vec<Language>,
    /// Time for which a program waits at each pose, such as 3s
    #[arg(long, help_heading = "Output", default_value = "3s", value_parser = parse_duration)]
    stand: Duration,
    /// Seed of the random poses
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(Debug, Args)]
struct CheckPathArguments {
    /// File with the robot's joints along the path, in any log format that `calibrate` reads
    #[arg(value_name = "PATH")]
    path: PathBuf,
    #[command(flatten)]
    cell: CellArguments,
    /// Mapping file for PATH (names its columns or joints), such as config/robot_log.toml; default:
    /// `[log]` of the robot's configuration
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    log_mapping: Option<PathBuf>,
}

/// Robot, bar, obstacles and limits, as configured.
struct Loaded {
    robot: RobotConfig,
    bar: BallBarConfig,
    arm: Chain,
    bar_chain: Chain,
    design: Design,
    bodies: Bodies,
    acceleration_rad_s2: f64,
    criterion: Criterion,
    calibration: Option<CalibrationFile>,
}

impl CellArguments {
    fn load(&self, criterion: Criterion) -> anyhow::Result<Loaded> {
        let robot: RobotConfig = config::load(&self.robot)?;
        ensure_follows_bar(&robot)?;
        let bar: BallBarConfig = config::load(&self.bar)?;
        above_zero("speed", self.speed)?;
        if let Some(speed_m_s) = self.linear_speed_m_s {
            above_zero("linear-speed-m-s", speed_m_s)?;
            let has_linear_axis = robot.joint_kinds().any(|kind| kind == JointKind::Prismatic);
            let name = &robot.name;
            anyhow::ensure!(has_linear_axis, "--linear-speed-m-s: {name} has no linear axis; leave it out");
        }
        above_zero("acceleration", self.acceleration)?;
        let arm = robot_chain(&robot, &bar);
        let bodies = self.around.bodies(arm.reach_m())?;
        let mut design = Design::for_robot(&robot);
        design.base_m = self.base.unwrap_or(design.base_m);
        in_metres("base", &design.base_m, REACH_M_MAX)?;
        design.robot_speed_rad_s = self.speed;
        design.robot_speed_m_s = self.linear_speed_m_s;
        let mut bar_chain = ball_bar_chain(&bar);
        bar_chain.root_from_base = nalgebra::Translation3::from(design.base_m).into();
        let calibration = self.calibration.as_deref().map(CalibrationFile::open).transpose()?;
        if let Some(file) = calibration.as_ref().filter(|file| file.robot != robot.name) {
            anyhow::bail!(
                "the calibration is of {}, not of {}; give one of this robot",
                file.robot,
                robot.name
            );
        }
        let acceleration_rad_s2 = self.acceleration;
        Ok(Loaded { robot, bar, arm, bar_chain, design, bodies, acceleration_rad_s2, criterion, calibration })
    }
}

impl Loaded {
    fn constraints(&self) -> Constraints<'_> {
        let limits = self.robot.joint_limits();
        Constraints::new(&self.arm, &self.bar_chain, &limits, &self.design)
            .with(Some(self.bodies.clone()), self.acceleration_rad_s2)
    }

    /// Expected information of a run of this length. If an earlier calibration is given, the information of
    /// that calibration is added.
    fn information(&self, duration_s: f64) -> anyhow::Result<Information> {
        let chains = (&self.arm, &self.bar_chain);
        let information = Information::new((&self.robot, &self.bar), chains, self.criterion, duration_s)?;
        let Some(file) = &self.calibration else { return Ok(information) };
        let updated = file.covariance.as_ref().and_then(|covariance| {
            let index = |id: ParameterId| covariance.names.iter().position(|name| *name == id.to_string());
            let covariance_of = |a, b| covariance.between(index(a)?, index(b)?);
            information.after(covariance_of)
        });
        updated.context("the calibration has no covariance of the robot's parameters; give calibration.json or its directory")
    }
}

pub fn run(arguments: &PlanArguments) -> anyhow::Result<()> {
    match &arguments.command {
        PlanCommand::Path(arguments) => find_path(arguments),
        PlanCommand::Place(arguments) => find_places(arguments),
        PlanCommand::Poses(arguments) => select_poses(arguments),
        PlanCommand::Check(arguments) => check_path(arguments),
    }
}

/// Searches for a path, checks it, and writes the planned path, the robot's joints, the page and programs.
fn find_path(arguments: &PathArguments) -> anyhow::Result<()> {
    let mut loaded = arguments.cell.load(arguments.criterion)?;
    ensure_programs_can_be_written(&arguments.program, &loaded.robot)?;
    ensure_can_write(&arguments.out)?;
    set_posture(&mut loaded.design, &arguments.posture, &loaded.robot)?;
    loaded.design.duration_s = arguments.duration.as_secs_f64();
    let (constraints, information) = (loaded.constraints(), loaded.information(loaded.design.duration_s)?);
    // Search for a path and check it.
    let found = search_path(arguments, &constraints, &information)?;
    let robot_path = plan::robot_path(&loaded.robot.name, &constraints, &found.route)
        .map_err(|(t_s, error)| anyhow::anyhow!("the robot cannot follow the path at {t_s:.3} s: {error}"))?;
    let checked = plan::check(&robot_path, &constraints, &information)?;
    let summary = path::summary(&checked, &constraints, &information, Some(&found));
    show(&summary)?;
    anyhow::ensure!(
        checked.violations.is_empty(),
        "the path that was found violates its constraints; give another --seed, or a lower --speed"
    );
    // Write path, joints, page and programs.
    let out = &arguments.out;
    fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
    remove_programs(ProgramPurpose::Path, out)?;
    let route = &found.route;
    let start = route.robot_rad.first().copied().unwrap_or_default();
    let planned_path = PlannedPath {
        robot: loaded.robot.name.clone(),
        base_m: loaded.design.base_m,
        robot_start_rad: start,
        path: route.path.clone(),
    };
    write(&out.join("path.toml"), &config::to_toml(&planned_path)?)?;
    let csv = out.join("robot_path.csv");
    let sink = fs::File::create(&csv).with_context(|| format!("cannot create {}", csv.display()))?;
    logs::write(&robot_path, &loaded.robot, sink)
        .with_context(|| format!("cannot write {}", csv.display()))?;
    say(csv.display())?;
    let page = PathPage {
        robot: &loaded.robot.name,
        constraints: &constraints,
        path: &route.path,
        robot_path: &robot_path,
        checked: &checked,
        summary: &summary,
        sigmas: &information.sigmas(&checked.normal),
    };
    say(page.write(out)?.display())?;
    write_programs(&arguments.program, &loaded.robot, ProgramPurpose::Path, out, |language| {
        plan::program(language, &robot_path, &loaded.robot, &constraints)
    })
}

/// Searches until the given time has elapsed or Ctrl-C is pressed. Progress is shown on the terminal.
fn search_path(
    arguments: &PathArguments,
    constraints: &Constraints<'_>,
    information: &Information,
) -> anyhow::Result<BestPath> {
    let terminal = OnTerminal::new();
    let found = plan::search(constraints, information, arguments.seed, arguments.budget, |progress| {
        !terminal.show_sentence(|| match progress {
            None => "first paths; Ctrl-C takes the best so far".into(),
            Some(SearchProgress { tried, taken, score }) => format!(
                "{tried} changes tried, {taken} taken, criterion {score:.3e}; Ctrl-C takes the path as it is"
            ),
        })
    });
    Ok(found?)
}

/// Checks whether the requested programs can be written. This is done before the search, so that an
/// error is reported immediately.
fn ensure_programs_can_be_written(asked: &[Language], robot: &RobotConfig) -> anyhow::Result<()> {
    asked.iter().try_for_each(|language| plan::can_be_programmed(*language, robot)).context("--program")
}

/// Removes the programs of an earlier plan, because they would move the robot to other poses than the new files contain.
fn remove_programs(purpose: ProgramPurpose, out: &Path) -> anyhow::Result<()> {
    for language in Language::value_variants() {
        let program = out.join(language.file_name(purpose));
        let removed = fs::remove_file(&program);
        if removed.as_ref().is_err_and(|error| error.kind() != ErrorKind::NotFound) {
            return removed.with_context(|| format!("cannot remove {}", program.display()));
        }
    }
    Ok(())
}

/// Writes the requested programs. Without a request, writes the program for the robot's maker. If a requested program cannot
/// be written, an error is returned. Without a request, the reason is only printed.
fn write_programs(
    asked: &[Language],
    robot: &RobotConfig,
    purpose: ProgramPurpose,
    out: &Path,
    program: impl Fn(Language) -> Result<String, ProgramError>,
) -> anyhow::Result<()> {
    let of_maker = Language::for_robot(robot).filter(|_| asked.is_empty());
    if asked.is_empty() && of_maker.is_none() {
        say(format_args!(
            "no program is written: the maker of `{}` is unknown; select a language with --program",
            robot.name
        ))?;
    }
    for &language in asked.iter().chain(&of_maker) {
        match program(language) {
            Ok(text) => write(&out.join(language.file_name(purpose)), &text)?,
            Err(error) if of_maker.is_some() => say(format_args!("no program: {error}"))?,
            Err(error) => return Err(error.into()),
        }
    }
    Ok(())
}

/// Selects poses from the candidates, and writes their table with its mapping, the page and programs.
fn select_poses(arguments: &PosesArguments) -> anyhow::Result<()> {
    let PosesArguments { measures, out, count, anchor, noise_mm, noise_mrad, seed, .. } = arguments;
    let robot: RobotConfig = config::load(&arguments.robot)?;
    ensure_programs_can_be_written(&arguments.program, &robot)?;
    ensure_can_write(out)?;
    ensure_has_no_measurements(&out.join("poses.csv"))?;
    ensure_valid(arguments)?;
    let bodies = arguments.around.bodies(flange_chain(&robot).reach_m())?;
    let candidates = candidates(arguments, &robot, &bodies)?;
    // Only random poses are checked for collisions. Poses of a table are assumed to be reachable.
    let bodies = arguments.candidates.is_none().then_some(&bodies);
    let request = PoseRequest {
        robot: &robot,
        measures: *measures,
        target_m: arguments.target,
        anchor_m: anchor.unwrap_or_default(),
        noise: PoseNoise { position_m: noise_mm * 1e-3, rotation_rad: noise_mrad.unwrap_or(0.1) * 1e-3 },
    };
    if *measures != MeasuredQuantity::Poses && plan::is_on_last_axis(&robot, &arguments.target) {
        let [x, y, z] = arguments.target;
        say(format_args!(
            "--target is on the axis of joint {}, so that nothing shows how far it turns: mount it off the axis, such as --target {},{y},{z}",
            robot.axes(),
            x + OFF_AXIS_M
        ))?;
    }
    let count_min = measures.poses_min();
    if *count < count_min {
        say(format_args!(
            "--count {count} is too few: `identify calibrate` needs at least {count_min} of these poses, or data of other instruments with them"
        ))?;
    }
    // Select the poses, then write table, mapping, page and programs.
    let planned = plan::poses(&request, &candidates, *count, bodies, *seed)?;
    show(path::poses(&planned, candidates.len()))?;
    fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
    remove_programs(ProgramPurpose::Poses, out)?;
    let (table, mapping) = path::pose_table(&planned, &robot, *measures)?;
    write(&out.join("poses.csv"), &table)?;
    write(&out.join("poses.toml"), &mapping)?;
    let page = PosesPage {
        robot: &robot.name,
        arm: &flange_chain(&robot),
        limits: &robot.joint_limits(),
        target_m: arguments.target,
        planned: &planned,
        candidates: candidates.len(),
        bodies,
    };
    say(page.write(out)?.display())?;
    write_programs(&arguments.program, &robot, ProgramPurpose::Poses, out, |language| {
        plan::pose_program(language, &planned, &robot, arguments.stand.as_secs_f64())
    })?;
    let blocked = planned.blocked();
    anyhow::ensure!(
        blocked.is_empty(),
        "{} of {} moves are blocked: no path without collision was found; poses.csv marks them, and programs stop there;\n\
         give another --seed, more poses to choose from (--draw), or a smaller --link-radius-mm",
        blocked.len(),
        planned.joints.len() - 1
    );
    Ok(())
}

/// Checks that a new table of poses will not overwrite a table with measurements.
fn ensure_has_no_measurements(table: &Path) -> anyhow::Result<()> {
    let bytes = match fs::read(table) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        read => read.with_context(|| format!("cannot read {}", table.display()))?,
    };
    anyhow::ensure!(
        path::has_no_measurements(&String::from_utf8_lossy(&bytes)),
        "{} exists and may contain measurements; give another directory with --out",
        table.display()
    );
    Ok(())
}

/// Checks the options that describe measurement and candidate poses.
fn ensure_valid(arguments: &PosesArguments) -> anyhow::Result<()> {
    let PosesArguments { measures, count, anchor, noise_mm, noise_mrad, .. } = arguments;
    anyhow::ensure!(*count > 0, "--count is 0; give at least one pose");
    above_zero("noise-mm", *noise_mm)?;
    above_zero("noise-mrad", noise_mrad.unwrap_or(1.0))?;
    anyhow::ensure!(
        noise_mrad.is_none() || *measures == MeasuredQuantity::Poses,
        "--noise-mrad is that of orientations; give it with --measures poses"
    );
    anyhow::ensure!(
        anchor.is_some() || *measures != MeasuredQuantity::Lengths,
        "--measures lengths needs --anchor X,Y,Z: the outlet of the wire in the robot's base frame, in metres"
    );
    anyhow::ensure!(
        anchor.is_none() || *measures == MeasuredQuantity::Lengths,
        "--anchor is the outlet of a wire; give it with --measures lengths only"
    );
    anyhow::ensure!(
        arguments.mapping.is_none() || arguments.candidates.is_some(),
        "--mapping names the columns of --candidates that are joints; give both or none"
    );
    in_metres("target", &arguments.target, REACH_M_MAX)?;
    in_metres("anchor", anchor.as_ref().map_or(&[], |anchor| anchor), CELL_M_MAX)?;
    Ok(())
}

/// The candidate postures: those of the given table, or random ones.
fn candidates(
    arguments: &PosesArguments,
    robot: &RobotConfig,
    bodies: &Bodies,
) -> anyhow::Result<Vec<Joints>> {
    let Some((file, mapping)) = arguments.candidates.as_deref().zip(arguments.mapping.as_deref()) else {
        let design = Design::for_robot(robot);
        return Ok(plan::random_postures(robot, bodies, &design, arguments.draw, arguments.seed)?);
    };
    let joint_mapping: JointTableMapping = config::load(mapping)?;
    joints_of_robot(&joint_mapping.joints, robot, mapping)?;
    Ok(joint_mapping.load(file)?)
}

/// Writes a file and prints its path.
fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(say(path.display())?)
}

fn find_places(arguments: &PlaceArguments) -> anyhow::Result<()> {
    let CellArguments { base, calibration, .. } = &arguments.cell;
    anyhow::ensure!(base.is_none(), "--base is the result of this command; leave it out");
    anyhow::ensure!(
        calibration.is_none(),
        "places are compared for an uncalibrated robot; leave --calibration out"
    );
    let mut loaded = arguments.cell.load(arguments.criterion)?;
    loaded.design.duration_s = arguments.duration.as_secs_f64();
    let length_of_bar = [loaded.bar.length_m];
    let lengths_m = if arguments.lengths.is_empty() { &length_of_bar[..] } else { &arguments.lengths };
    if let Some(length_m) = lengths_m.iter().find(|length_m| !(0.01..=10.0).contains(*length_m)) {
        anyhow::bail!("--lengths has {length_m} m; give rods of 0.01 to 10 m");
    }
    let request = PlaceRequest {
        robot: &loaded.robot,
        bar: &loaded.bar,
        design: &loaded.design,
        bodies: &loaded.bodies,
        acceleration_rad_s2: loaded.acceleration_rad_s2,
        lengths_m,
        height_m: arguments.height,
        criterion: loaded.criterion,
    };
    let terminal = OnTerminal::new();
    let places = plan::places(&request, arguments.seed, arguments.budget, |tried| {
        !terminal.show_sentence(|| format!("{tried} places tried; Ctrl-C shows the best so far"))
    });
    drop(terminal);
    let places = places?;
    show(path::places(&places, loaded.design.duration_s))?;
    anyhow::ensure!(
        !places.found.is_empty(),
        "no place had a path; give a longer --budget, another --height, other --lengths, or slower motion"
    );
    Ok(())
}

fn check_path(arguments: &CheckPathArguments) -> anyhow::Result<()> {
    let loaded = arguments.cell.load(Criterion::default())?;
    let mapping =
        arguments.log_mapping.as_deref().map(|path| load_log_mapping(path, &loaded.robot)).transpose()?;
    let log =
        logs::load_with(&arguments.path, &loaded.robot, &LogOptions { mapping, ..LogOptions::default() })?;
    let information = loaded.information(log.q_rad.duration_s())?;
    let constraints = loaded.constraints();
    let checked = plan::check(&log, &constraints, &information)?;
    show(path::summary(&checked, &constraints, &information, None))?;
    anyhow::ensure!(checked.violations.is_empty(), "the path does not keep to its constraints");
    Ok(())
}
