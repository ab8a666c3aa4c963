//! `identify simulate` writes measurements of a robot with known errors, and the true values of its parameters. The files
//! have the formats that `identify calibrate` reads.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use shared::config::{self, BallBarConfig, RobotConfig};
use shared::output::say;
use shared::time::parse_duration;

use super::ensure_can_write;
use super::plan::{REACH_M_MAX, in_metres, set_posture};
use crate::plan::PlannedPath;
use crate::simulate::ArmErrors;
use crate::simulate::contact::{self, ContactExperiment};
use crate::simulate::touch::{self, TouchExperiment};
use crate::simulate::{self, BarLoad, Effects, Experiment, StaticErrors};

#[derive(Debug, Clone, Copy, ValueEnum)]
enum RobotErrors {
    /// Errors of table 3.1 of the thesis
    Thesis,
    /// Random errors with a standard deviation of 1 mm or 1 mrad; --robot-seed selects them
    Drawn,
    /// No errors: robot and bar have their nominal parameters
    None,
}

/// Default sizes of the effects.
const LABORATORY: Effects = Effects::LABORATORY;

/// What to simulate; by default the ball-bar.
#[derive(Debug, Args)]
pub struct SimulateArguments {
    #[command(subcommand)]
    command: SimulateCommand,
}

#[derive(Debug, Subcommand)]
enum SimulateCommand {
    /// Simulate a recording of the ball-bar and a log of the robot
    #[command(after_help = "Example: identify simulate bar --robot irb2400_16 --errors drawn --out demo")]
    Bar(Box<SimulateBarArguments>),
    /// Simulate poses at which a ball on the flange is seated in sockets
    #[command(after_help = "Example: identify simulate contact --robot irb120_3 --rows 200 --out seats")]
    Contact(SimulateContactArguments),
    /// Simulate poses at which a tip on the flange touches the faces of a block
    #[command(after_help = "Example: identify simulate touch --robot irb120_3 --block-mm 100 --out cube")]
    Touch(SimulateTouchArguments),
}

/// Options that `contact` and `touch` share.
#[derive(Debug, Args)]
#[command(next_help_heading = "Simulation")]
struct ArmArguments {
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    robot: PathBuf,
    /// Directory for the table of measurements, its mapping, sockets.toml or faces.toml, and truth.toml
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: PathBuf,
    /// Position of the plate's frame or of the block's centre in the robot's base frame [m]; default: a position that the
    /// robot reaches in most postures
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    place: Option<[f64; 3]>,
    /// Seed of poses, noise and errors of the measured objects
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Seed of the robot's errors; give the same one to simulate the same robot with another
    /// set-up. Default: the value of --seed
    #[arg(long, value_name = "SEED")]
    robot_seed: Option<u64>,
    /// Standard deviation of the error of each link parameter [mm, or mrad for angles]
    #[arg(long, value_name = "MM", default_value_t = 1.0)]
    errors_mm_mrad: f64,
    /// White noise of each joint [urad, or um for a linear axis]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.robot_noise_urad)]
    robot_noise_urad: f64,
    /// Amplitude of the sinusoidal error of each robot gear [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.gear_sine_urad)]
    gear_sine_urad: f64,
}

impl ArmArguments {
    fn errors(&self) -> ArmErrors {
        ArmErrors {
            errors_mm_mrad: self.errors_mm_mrad,
            robot_noise_urad: self.robot_noise_urad,
            gear_sine_urad: self.gear_sine_urad,
            robot_seed: self.robot_seed.unwrap_or(self.seed),
        }
    }
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Simulation")]
struct SimulateContactArguments {
    #[command(flatten)]
    arm: ArmArguments,
    /// File with the positions of the sockets on their plate, such as config/sockets.toml; default: six sockets at three
    /// heights, scaled to the robot's reach
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    sockets: Option<PathBuf>,
    /// Write the distances between the sockets to sockets.toml instead of their positions
    #[arg(long)]
    distances: bool,
    /// Number of poses to simulate
    #[arg(long, value_name = "N", default_value_t = 200)]
    rows: usize,
    /// Repeatability of the seated ball: standard deviation along each axis [um]
    #[arg(long, value_name = "UM", default_value_t = 5.0)]
    seating_um: f64,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Simulation")]
struct SimulateTouchArguments {
    #[command(flatten)]
    arm: ArmArguments,
    /// Edge length of the block [mm]; default: scaled to the robot's reach
    #[arg(long, value_name = "MM")]
    block_mm: Option<f64>,
    /// Write faces.toml without the distances and angles of the faces
    #[arg(long)]
    unknown: bool,
    /// Number of touches to simulate
    #[arg(long, value_name = "N", default_value_t = 300)]
    rows: usize,
    /// Repeatability of a touch: standard deviation [um]
    #[arg(long, value_name = "UM", default_value_t = 2.0)]
    touch_um: f64,
    /// Travel of a dial gauge [mm]; 0 simulates a touch probe
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    gauge_mm: f64,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Simulation")]
struct SimulateBarArguments {
    /// Configuration file of the robot, or a name that `identify robot list` prints, such as irb2400_16
    #[arg(long, help_heading = "Input", value_name = "FILE")]
    robot: PathBuf,
    /// Configuration file of the bar. `ball_bar` is ball_bar.toml in config, else in /etc/ballbard, else the built-in one
    #[arg(long, help_heading = "Input", value_name = "FILE", default_value = "ball_bar")]
    bar: PathBuf,
    /// Directory for recording.mcap, robot_log.csv and truth.toml
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: PathBuf,
    /// Seed of path, encoder offsets and noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Seed of random errors and of the phases of gears and encoders; give the same one to simulate another run of the same
    /// robot and bar. Default: the value of --seed
    #[arg(long, value_name = "SEED")]
    robot_seed: Option<u64>,
    /// Errors of robot and bar
    #[arg(long, value_enum, default_value = "thesis")]
    errors: RobotErrors,
    /// Centre of the bar's gimbal in the robot's base frame [m]; default: 1.0,0.05,0.35, or 1.7,0.05,0.6 if link 2 is longer
    /// than a metre
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    base: Option<[f64; 3]>,
    /// Posture of the robot near which the motion begins, one number for each axis [deg, or mm for a linear axis]; it
    /// selects the configuration of elbow and wrist. Default: 0,20,10,0,60,0 for six axes, otherwise random
    #[arg(long, value_name = "Q1,Q2,..", value_delimiter = ',', allow_hyphen_values = true)]
    posture: Vec<f64>,
    /// Length of the run, such as 90s or 2m; a plain number is seconds
    #[arg(long, default_value = "2m", value_parser = parse_duration)]
    duration: Duration,
    /// Path that the robot follows, such as path.toml of `identify plan`; default: a random path
    #[arg(long, help_heading = "Input", value_name = "FILE", conflicts_with_all = ["base", "posture", "duration"])]
    path: Option<PathBuf>,
    /// Reading of the robot's clock when the recording begins [s], at most 9e9; default: 3712.345678901
    #[arg(long, value_name = "S", allow_hyphen_values = true)]
    robot_clock_s: Option<f64>,
    /// Rate error of the robot's clock relative to the bar's clock [ppm], -10000 to 10000
    #[arg(long, value_name = "PPM", default_value_t = 25.0, allow_hyphen_values = true)]
    skew_ppm: f64,
    /// Simulate none of the effects from --robot-noise-urad to --base-tilt-urad, to test the estimator alone
    #[arg(long, conflicts_with_all = Effects::keys())]
    exact: bool,
    /// White noise of each robot joint [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.robot_noise_urad)]
    robot_noise_urad: f64,
    /// White noise of each bar encoder [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.encoder_noise_urad)]
    encoder_noise_urad: f64,
    /// Amplitude of the sinusoidal error of each robot gear [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.gear_sine_urad)]
    gear_sine_urad: f64,
    /// Amplitude of the ripple of each cycloid gear [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.cycloid_urad)]
    cycloid_urad: f64,
    /// Half of the backlash of each robot gear [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.backlash_urad)]
    backlash_urad: f64,
    /// Eccentricity of each bar encoder: amplitude of the error with one period per turn [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.encoder_eccentricity_urad)]
    encoder_eccentricity_urad: f64,
    /// Ellipticity of each bar encoder: amplitude of the error with two periods per turn [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.encoder_ellipticity_urad)]
    encoder_ellipticity_urad: f64,
    /// Resolution of each bar encoder, if coarser than its counts [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.encoder_step_urad)]
    encoder_step_urad: f64,
    /// Tilt of the bar's base relative to the robot's base [urad]
    #[arg(long, value_name = "URAD", default_value_t = LABORATORY.base_tilt_urad)]
    base_tilt_urad: f64,
    /// Largest force along the bar [N]; above 0 the robot's log has a column `force_N`
    #[arg(long, value_name = "N", default_value_t = 0.0)]
    force_n: f64,
    /// Elongation of the bar per newton of tension [um/N]
    #[arg(long, value_name = "UM", default_value_t = 0.0, requires = "force_n")]
    compliance_um_per_n: f64,
    /// Half of the bar's play: the bar is longer by this under tension, and shorter by this under compression [um]
    #[arg(long, value_name = "UM", default_value_t = 0.0, requires = "force_n")]
    bar_play_um: f64,
    /// White noise of the force in the log [N]
    #[arg(long, value_name = "N", default_value_t = 1.0, requires = "force_n")]
    force_noise_n: f64,
}

impl SimulateBarArguments {
    fn effects(&self) -> Effects {
        if self.exact {
            return Effects::NONE;
        }
        Effects {
            robot_noise_urad: self.robot_noise_urad,
            encoder_noise_urad: self.encoder_noise_urad,
            gear_sine_urad: self.gear_sine_urad,
            cycloid_urad: self.cycloid_urad,
            backlash_urad: self.backlash_urad,
            encoder_ellipticity_urad: self.encoder_ellipticity_urad,
            encoder_eccentricity_urad: self.encoder_eccentricity_urad,
            encoder_step_urad: self.encoder_step_urad,
            base_tilt_urad: self.base_tilt_urad,
        }
    }
}

/// Parses `N` numbers that are separated by commas.
pub(super) fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|number| number.trim().parse().map_err(|_| format!("`{number}` is not a number")))
        .collect::<Result<_, String>>()?;
    let count = numbers.len();
    numbers.try_into().map_err(|_| format!("{count} numbers are given, {N} are needed"))
}

/// Largest difference of the rates of two clocks [ppm].
const SKEW_PPM_MAX: f64 = 1e4;
/// Largest time of a clock \[s\]. Clocks count nanoseconds since 1970 in 64 bits, which overflow at 9.2e9 s. The limit leaves
/// room for a run of any length.
const CLOCK_S_MAX: f64 = 9e9;

fn ensure_within(option: &str, value: f64, limit: f64) -> anyhow::Result<()> {
    // `contains` also refuses NaN.
    anyhow::ensure!(
        (-limit..=limit).contains(&value),
        "--{option} is {value}; give a number from {} to {limit}",
        -limit
    );
    Ok(())
}

pub fn run(arguments: &SimulateArguments) -> anyhow::Result<()> {
    match &arguments.command {
        SimulateCommand::Bar(arguments) => simulate_bar(arguments),
        SimulateCommand::Contact(arguments) => simulate_contacts(arguments),
        SimulateCommand::Touch(arguments) => simulate_touches(arguments),
    }
}

fn at_least_one(rows: usize) -> anyhow::Result<usize> {
    anyhow::ensure!(rows > 0, "--rows is 0; give at least one pose");
    Ok(rows)
}

fn simulate_contacts(
    SimulateContactArguments { arm, sockets, distances, rows, seating_um }: &SimulateContactArguments,
) -> anyhow::Result<()> {
    ensure_can_write(&arm.out)?;
    let robot: RobotConfig = config::load(&arm.robot)?;
    let simulated = contact::run(&ContactExperiment {
        robot: &robot,
        sockets: sockets.as_deref().map(config::load).transpose()?,
        place_m: arm.place,
        distances: *distances,
        rows: at_least_one(*rows)?,
        errors: arm.errors(),
        seating_um: *seating_um,
        seed: arm.seed,
    })?;
    contact::write(&arm.out, &simulated, &robot)?.iter().try_for_each(|path| Ok(say(path.display())?))
}

fn simulate_touches(
    SimulateTouchArguments { arm, block_mm, unknown, rows, touch_um, gauge_mm }: &SimulateTouchArguments,
) -> anyhow::Result<()> {
    ensure_can_write(&arm.out)?;
    let robot: RobotConfig = config::load(&arm.robot)?;
    let simulated = touch::run(&TouchExperiment {
        robot: &robot,
        block_mm: *block_mm,
        place_m: arm.place,
        known: !unknown,
        rows: at_least_one(*rows)?,
        errors: arm.errors(),
        touch_um: *touch_um,
        gauge_mm: *gauge_mm,
        seed: arm.seed,
    })?;
    touch::write(&arm.out, &simulated, &robot)?.iter().try_for_each(|path| Ok(say(path.display())?))
}

fn simulate_bar(arguments: &SimulateBarArguments) -> anyhow::Result<()> {
    ensure_can_write(&arguments.out)?;
    let robot: RobotConfig = config::load(&arguments.robot)?;
    let bar: BallBarConfig = config::load(&arguments.bar)?;
    let mut experiment = Experiment::new(&robot, &bar);
    experiment.seed = arguments.seed;
    experiment.robot_seed = arguments.robot_seed;
    experiment.errors = match arguments.errors {
        RobotErrors::Thesis => StaticErrors::Thesis,
        RobotErrors::Drawn => StaticErrors::Drawn { seed: arguments.robot_seed.unwrap_or(arguments.seed) },
        RobotErrors::None => StaticErrors::None,
    };
    experiment.design.base_m = arguments.base.unwrap_or(experiment.design.base_m);
    in_metres("base", &experiment.design.base_m, REACH_M_MAX)?;
    set_posture(&mut experiment.design, &arguments.posture, &robot)?;
    experiment.design.duration_s = arguments.duration.as_secs_f64();
    if let Some(file) = &arguments.path {
        let planned: PlannedPath = config::load(file)?;
        anyhow::ensure!(
            planned.robot == robot.name,
            "{} is a path of {}, not of {}; give the robot's own",
            file.display(),
            planned.robot,
            robot.name
        );
        experiment.design.base_m = planned.base_m;
        experiment.design.duration_s = planned.path.duration_s;
        experiment.path = Some(planned);
    }
    ensure_within("skew-ppm", arguments.skew_ppm, SKEW_PPM_MAX)?;
    experiment.clocks.skew = arguments.skew_ppm * 1e-6;
    if let Some(clock_s) = arguments.robot_clock_s {
        ensure_within("robot-clock-s", clock_s, CLOCK_S_MAX)?;
        experiment.clocks.robot_at_bar_start_ns = (clock_s * 1e9).round() as i64;
    }
    experiment.effects = arguments.effects();
    experiment.load = BarLoad {
        force_n: arguments.force_n,
        compliance_um_per_n: arguments.compliance_um_per_n,
        play_um: arguments.bar_play_um,
        noise_n: arguments.force_noise_n,
    };
    let simulated = simulate::run(&experiment)?;
    let files = simulate::write(&arguments.out, &simulated, &robot, &bar)?;
    for path in [&files.recording, &files.robot_log, &files.truth] {
        say(path.display())?;
    }
    Ok(())
}
