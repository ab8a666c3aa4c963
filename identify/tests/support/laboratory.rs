//! A simulated laboratory with realistic errors in addition to those of `simulate`.
#![allow(dead_code, reason = "each test uses its part")]

use std::f64::consts::TAU;

use identify::kinematics::{Trace, Tracer, robot_chain};
use identify::model::DriveTrain;
use identify::simulate::{self, Clocks, Design, Effects, Experiment, Simulated};
use nalgebra::{Matrix6, Vector6};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shared::config::{BallBarConfig, RobotConfig};

/// Sizes of the errors.
#[derive(Debug, Clone, Copy)]
pub struct Level {
    pub robot_noise_urad: f64,
    pub encoder_noise_urad: f64,
    /// Amplitude of errors by eccentric output gears, order two per turn.
    pub gear_sine_urad: f64,
    /// Amplitude of the errors of cycloid gears.
    pub cycloid_urad: f64,
    /// Backlash of the robot's axes, as the full width.
    pub backlash_urad: f64,
    /// Amplitude of errors of the bar's encoders, order one per turn.
    pub eccentricity_urad: f64,
    /// Amplitude of errors of the bar's encoders, order two per turn.
    pub second_harmonic_urad: f64,
    /// Amplitude of the bar length as a function of the bar's direction.
    pub bar_um: f64,
    pub base_tilt_urad: f64,
}

impl Level {
    pub const USUAL: Self = Self {
        robot_noise_urad: 15.0,
        encoder_noise_urad: 5.0,
        gear_sine_urad: 30.0,
        cycloid_urad: 20.0,
        backlash_urad: 0.0,
        eccentricity_urad: 40.0,
        second_harmonic_urad: 15.0,
        bar_um: 8.0,
        base_tilt_urad: 5000.0,
    };
    pub const HARD: Self = Self {
        robot_noise_urad: 30.0,
        encoder_noise_urad: 10.0,
        gear_sine_urad: 60.0,
        cycloid_urad: 40.0,
        backlash_urad: 20.0,
        eccentricity_urad: 80.0,
        second_harmonic_urad: 30.0,
        bar_um: 25.0,
        base_tilt_urad: 10_000.0,
    };
}

/// Number of lobes of the cycloid gear of each drive. They differ from those in the robots' files.
const LOBES: [f64; 6] = [59.0, 59.0, 39.0, 41.0, 47.0, 43.0];
/// Range of speeds in which the backlash changes from one side to the other \[rad/s\].
const BACKLASH_RAD_S: f64 = 2e-3;

/// Simulates a run of two minutes, unless `design` states another duration. The clocks differ by up to an hour and 80 ppm,
/// and the encoder offsets are arbitrary.
pub fn run(robot: &RobotConfig, bar: &BallBarConfig, seed: u64, level: &Level, design: Design) -> Simulated {
    let mut clean = without_noise(robot, bar, seed, level, design);
    add_noise(&mut clean, seed, level);
    clean
}

/// Simulates the same run without noise.
pub fn without_noise(
    robot: &RobotConfig,
    bar: &BallBarConfig,
    seed: u64,
    level: &Level,
    design: Design,
) -> Simulated {
    let mut random = ChaCha8Rng::seed_from_u64(1000 + seed);
    let bar_start = Clocks::default().bar_start;
    let clocks = Clocks {
        bar_start,
        robot_at_bar_start_ns: bar_start.0 + random.random_range(-3_600_000_000_000i64..3_600_000_000_000),
        skew: random.random_range(-80e-6..80e-6),
    };
    let effects = Effects {
        gear_sine_urad: level.gear_sine_urad,
        encoder_eccentricity_urad: level.eccentricity_urad,
        base_tilt_urad: level.base_tilt_urad,
        ..Effects::default()
    };
    let experiment = Experiment { seed, effects, clocks, design, ..Experiment::new(robot, bar) };
    let mut run = simulate::run(&experiment).unwrap();
    add_second_harmonic(&mut run, level, &mut random);
    add_to_robot(&mut run, robot, level, &mut random);
    run
}

fn add_second_harmonic(run: &mut Simulated, level: &Level, random: &mut ChaCha8Rng) {
    let phases: [f64; 5] = std::array::from_fn(|_| random.random_range(0.0..TAU));
    let start = run.truth.clock.bar_start;
    for cycle in &mut run.cycles {
        let joints = run.motion.path.at(cycle.sample_time.seconds_since(start));
        for (sample, encoder) in cycle.encoders.iter_mut().zip(&run.encoders) {
            let joint = usize::from(encoder.joint) - 1;
            let error_rad = level.second_harmonic_urad * 1e-6 * (2.0 * joints[joint] + phases[joint]).sin();
            add(&mut sample.count, error_rad, encoder);
        }
    }
}

fn add(count: &mut u32, by_rad: f64, encoder: &shared::recording::schema::EncoderInfo) {
    let counts = (by_rad / encoder.scale.rad_per_count()).round() as i64;
    *count = count.wrapping_add((encoder.scale.direction.sign() * counts) as u32);
}

/// Adds errors of cycloid gears and backlash of the drives to the robot's log. Also changes the joints so that the robot
/// follows a bar whose length varies.
fn add_to_robot(run: &mut Simulated, robot: &RobotConfig, level: &Level, random: &mut ChaCha8Rng) {
    let phases: [f64; 6] = std::array::from_fn(|_| random.random_range(0.0..TAU));
    let azimuth = random.random_range(0.0..TAU);
    let truth = run.truth.clock;
    let tracer = Tracer::new(&run.motion.robot);
    let drives = DriveTrain::from_robot(robot, &run.motion.robot);
    let mut trace = Trace::default();
    let rows = run.robot_log.q_rad.clone();
    let before_bar_start_ns = run.robot_log.q_rad.first_stamp_ns - truth.robot_at_bar_start_ns;
    for (drive, phase) in phases.iter().enumerate() {
        let (lobes, axis) = (LOBES[drive], drive + 1);
        let errors = [
            (format!("rsin{lobes}_{axis}"), level.cycloid_urad * phase.cos()),
            (format!("rcos{lobes}_{axis}"), level.cycloid_urad * phase.sin()),
            (format!("rbacklash_{axis}"), 0.5 * level.backlash_urad),
        ];
        run.truth.parameters.extend(errors.map(|(name, shown_urad)| (name, -1e-6 * shown_urad)));
    }
    for (k, q) in run.robot_log.q_rad.iter_mut().enumerate() {
        let t_s = (rows.t_s[k] + before_bar_start_ns as f64 * 1e-9) / (1.0 + truth.skew);
        let bar = run.motion.path.at(t_s);
        let longer_m =
            level.bar_um * 1e-6 * (0.6 * (2.0 * bar[0] + azimuth).sin() + 0.4 * (3.0 * bar[1]).cos());
        tracer.trace(&rows[k], &mut trace);
        let rod = (trace.position_m() - run.motion.bar.root_from_base.translation.vector).normalize();
        let mut jacobian = Matrix6::zeros();
        for (mut column, twist) in jacobian.column_iter_mut().zip(trace.joint_twists()) {
            column.fixed_rows_mut::<3>(0).copy_from(&twist.linear);
            column.fixed_rows_mut::<3>(3).copy_from(&twist.angular);
        }
        let moved = rod * longer_m;
        let by = jacobian.try_inverse().unwrap() * Vector6::new(moved.x, moved.y, moved.z, 0.0, 0.0, 0.0);
        let (before, after) = (&rows[k.saturating_sub(3)], &rows[(k + 3).min(rows.len() - 1)]);
        for drive in 0..6 {
            let angle = |joints| drives.of_drive(drive, joints);
            let speed = (angle(after) - angle(before)) / (6.0 * 0.004);
            let ripple = level.cycloid_urad * (LOBES[drive] * angle(&rows[k]) + phases[drive]).sin();
            let backlash = 0.5 * level.backlash_urad * (speed / BACKLASH_RAD_S).tanh();
            q[drive] += by[drive];
            for (joint, part) in drives.joint_from_drive[drive].iter().enumerate() {
                q[joint] += part * 1e-6 * (ripple + backlash);
            }
        }
    }
}

/// Adds white noise to encoders and robot joints, independent for each row of both logs.
pub fn add_noise(run: &mut Simulated, seed: u64, level: &Level) {
    let mut random = ChaCha8Rng::seed_from_u64(2000 + seed);
    let mut noise = |urad: f64| {
        let normal: f64 = StandardNormal.sample(&mut random);
        urad * 1e-6 * normal
    };
    for cycle in &mut run.cycles {
        for (sample, encoder) in cycle.encoders.iter_mut().zip(&run.encoders) {
            add(&mut sample.count, noise(level.encoder_noise_urad), encoder);
        }
    }
    for q in run.robot_log.q_rad.iter_mut().flatten() {
        *q += noise(level.robot_noise_urad);
    }
}

/// Assigns encoder `place` to the joint of encoder `order[place]`, as if cables had been exchanged.
pub fn exchange(run: &mut Simulated, order: &[usize]) {
    let joints: Vec<u8> = order.iter().map(|&place| run.encoders[place].joint).collect();
    for (encoder, joint) in run.encoders.iter_mut().zip(&joints) {
        encoder.joint = *joint;
    }
    for cycle in &mut run.cycles {
        for (encoder, joint) in cycle.encoders.iter_mut().zip(&joints) {
            encoder.joint = *joint;
        }
    }
}

/// Replaces the values of one drive in every row by those of `shown`, which receives the values of all rows and the row
/// number. A drive is used instead of a joint, because faults of controllers affect single drives.
pub fn of_drive(
    run: &mut Simulated,
    robot: &RobotConfig,
    drive: usize,
    shown: impl Fn(&[f64], usize) -> f64,
) {
    let drives = DriveTrain::from_robot(robot, &robot_chain(robot, &super::bar()));
    let before: Vec<f64> = run.robot_log.q_rad.iter().map(|q| drives.of_drive(drive, q)).collect();
    for (row, q) in run.robot_log.q_rad.iter_mut().enumerate() {
        let by = shown(&before, row) - before[row];
        for (joint, part) in drives.joint_from_drive[drive].iter().enumerate() {
            q[joint] += part * by;
        }
    }
}

/// Repeats the motion of a run. The repetition starts `pause_s` after the start of the original motion \[s\].
pub fn repeat(run: &mut Simulated, pause_s: f64) {
    let again: Vec<_> = run
        .cycles
        .iter()
        .map(|cycle| {
            let mut cycle = *cycle;
            cycle.sample_time = cycle.sample_time.plus_ns((pause_s * 1e9) as i64);
            cycle
        })
        .collect();
    run.cycles.extend(again);
    let log = &mut run.robot_log;
    let again = log.q_rad.clone();
    log.q_rad.t_s.extend(again.t_s.iter().map(|t| t + pause_s * (1.0 + run.truth.clock.skew)));
    log.q_rad.rows.extend(&*again.rows);
}
