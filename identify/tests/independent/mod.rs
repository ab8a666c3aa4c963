//! Ball-bar experiments with known truth, as files that a user would have, made by code that shares nothing with the
//! product's: kinematics, inverse kinematics, paths, gears, encoders, clocks and file formats are written anew from their
//! descriptions (TFRT-6017 chapters 2 to 5, data sheets, README). All of these runs are healthy: refusing one is an error.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test stops at the first surprise")]

mod campaign;
mod changes;
mod checks;
mod errors;
mod health;
mod kinematics;
mod logs;
mod paths;
mod robots;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix4, Rotation3, RowVector6, Vector3};
use rand::seq::IndexedRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use self::errors::{Play, Waves};
use self::kinematics::{Arm, Bar, Dh, within};
use self::logs::{BarTime, COUNTS_PER_TURN, Row, Stamps};
use self::paths::{CABLE_RAD, Family, Path as BarPath, Schedule, Sweep};
use self::robots::{Robot, link_toml};

/// Sizes of all that differs from the nominal.
#[derive(Debug, Clone)]
pub struct Sizes {
    /// Standard deviation of each number of the robot's links \[mm, mrad\].
    pub robot_links_mm_mrad: f64,
    /// Of each number of the bar's links: they are made with care \[mm, mrad\].
    pub bar_links_mm_mrad: f64,
    /// Of the bar's length \[mm\].
    pub bar_length_mm: f64,
    /// Of the measured offset plate, which gives the scale \[mm\].
    pub plate_mm: f64,
    /// Lean of the bar's base, in any direction \[mrad\].
    pub base_tilt_mrad: f64,
    /// Amplitude of what each axis of the robot repeats once and twice per turn and with its gear, from..to \[urad\].
    pub gear_urad: (f64, f64),
    /// Lobes of cycloid gears, from..to; the robots' files say 39.
    pub lobes: (u32, u32),
    /// Width of the play of each axis \[urad\].
    pub backlash_urad: f64,
    /// White noise of a resolver on the motor's shaft \[mrad\].
    pub resolver_noise_mrad: f64,
    /// Steps of a resolver for each turn of its motor.
    pub resolver_steps: f64,
    /// Eccentricity of each encoder of the bar: amplitudes once and twice per turn \[urad\].
    pub encoder_once_urad: f64,
    pub encoder_twice_urad: f64,
    /// White noise of each encoder, from..to \[urad\].
    pub encoder_noise_urad: (f64, f64),
    /// Amplitude of how the bar's length follows its first two joints, twice per turn \[um\].
    pub bar_runout_um: f64,
    /// The robot's clock is so much ahead or behind at the bar's first cycle, from..to \[s\].
    pub clock_shift_s: (f64, f64),
    /// ...and faster or slower by so much, from..to \[ppm\].
    pub clock_skew_ppm: (f64, f64),
    pub robot_log_hz: f64,
    pub bar_hz: f64,
    pub stamps: Stamps,
    /// Whether the bar's stamps are UTC, not seconds since some instant.
    pub bar_utc: bool,
    /// None: what the path's kind usually lasts \[s\], and how fast \[rad/s\].
    pub duration_s: Option<f64>,
    pub speed_rad_s: Option<f64>,
    /// The best that the motion lets anybody find of the robot, or another one is drawn \[mm|mrad\]: see [`health`].
    pub bound_mm_mrad: f64,
}

impl Default for Sizes {
    fn default() -> Self {
        Self {
            robot_links_mm_mrad: 0.7,
            bar_links_mm_mrad: 0.02,
            bar_length_mm: 0.3,
            plate_mm: 0.005,
            base_tilt_mrad: 5.0,
            gear_urad: (20.0, 30.0),
            lobes: (31, 47),
            backlash_urad: 8.0,
            resolver_noise_mrad: 0.2,
            resolver_steps: 65_536.0,
            encoder_once_urad: 40.0,
            encoder_twice_urad: 20.0,
            encoder_noise_urad: (5.0, 15.0),
            bar_runout_um: 2.0,
            clock_shift_s: (1.0, 10_000.0),
            clock_skew_ppm: (25.0, 50.0),
            robot_log_hz: 250.0,
            bar_hz: 100.0,
            stamps: Stamps::Perfect,
            bar_utc: false,
            duration_s: None,
            speed_rad_s: None,
            bound_mm_mrad: 0.2,
        }
    }
}

impl Sizes {
    /// Nothing but geometry: both chains close exactly, counts and stamps are only rounded.
    pub fn without_varying_errors() -> Self {
        Self {
            gear_urad: (0.0, 0.0),
            backlash_urad: 0.0,
            resolver_noise_mrad: 0.0,
            resolver_steps: 1e9,
            encoder_once_urad: 0.0,
            encoder_twice_urad: 0.0,
            encoder_noise_urad: (0.0, 0.0),
            bar_runout_um: 0.0,
            ..Self::default()
        }
    }
}

/// Postures and paths that are tried until the robot can follow one; it takes some hundreds.
const ATTEMPTS: u32 = 30_000;

/// What a calibration should find.
#[derive(Debug, Clone)]
pub struct Truth {
    /// What to add to each nominal number of the robot's links, by name, `ra1` to `rtheta6` \[m, rad\]. The plate is part of
    /// `ra6`, as in the program's files.
    pub robot: BTreeMap<String, f64>,
    /// What to add to the bar's nominal length \[m\].
    pub bar_length_m: f64,
    /// Centre of the gimbal in the robot's base \[m\].
    pub base_m: [f64; 3],
    /// The robot's clock less the bar's seconds since its first cycle, at that cycle \[s\].
    pub clock_shift_s: f64,
    /// Rate of the robot's clock by the bar's, less one.
    pub clock_skew: f64,
}

/// The files of one run, in the directory that they were written to.
#[derive(Debug, Clone)]
pub struct Files {
    pub robot: PathBuf,
    pub bar: PathBuf,
    pub robot_log: PathBuf,
    pub recording: PathBuf,
}

/// One run: what is true, and what was seen of it.
pub struct Run {
    pub robot: Robot,
    pub truth: Truth,
    /// The best that anybody can find of the robot: see [`health`].
    pub bound_mm_mrad: f64,
    /// What is known of the plate, one standard deviation \[mm\].
    plate_u_mm: f64,
    true_arm: Arm,
    true_bar: Bar,
    motion: Motion,
    /// Times on the bar's clock \[s\], true joint angles of the robot \[rad\]: one for each row of the log.
    true_rows: Vec<(f64, [f64; 6])>,
    rows: Vec<Row>,
    cycles: Vec<(f64, [u32; 5])>,
    origins: [i64; 5],
    bar_time: BarTime,
}

/// Where the bar's joints are at any time.
struct Motion {
    path: BarPath,
    schedule: Schedule,
    duration_s: f64,
    /// How the length follows joints 1 and 2.
    runout: [Waves; 2],
}

impl Motion {
    fn bar_rad(&self, time_s: f64) -> [f64; 5] {
        self.path.joints_rad(self.schedule.at(time_s))
    }

    /// How much longer the rod is than its parameter \[m\].
    fn longer_m(&self, bar_rad: &[f64; 5]) -> f64 {
        self.runout[0].at(bar_rad[0]) + self.runout[1].at(bar_rad[1])
    }
}

/// A placement of the bar and a motion that the robot can follow.
struct Feasible {
    bar: Bar,
    motion: Motion,
    start_rad: [f64; 6],
    bound_mm_mrad: f64,
}

impl Run {
    /// The run that belongs to a seed.
    ///
    /// # Panics
    /// If no motion that the robot can follow was found: a mistake in the sizes.
    pub fn new(robot: Robot, family: Family, sizes: &Sizes, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let (true_arm, corrections) = true_arm(&robot, sizes, &mut random);
        let bar_links = true_bar_links(&robot, sizes, &mut random);
        let found = (0..ATTEMPTS)
            .find_map(|attempt| {
                // Wide sweeps first; where they are beyond the robot, narrower ones.
                let scale = 1.2 - 0.8 * f64::from(attempt) / f64::from(ATTEMPTS);
                feasible(&robot, &true_arm, &bar_links, family, sizes, scale, &mut random)
            })
            .unwrap_or_else(|| panic!("{} cannot follow {family:?}, seed {seed}", robot.name));
        let sign = *[-1.0, 1.0].choose(&mut random).unwrap();
        let (nearest_s, furthest_s) = sizes.clock_shift_s;
        let (slowest, fastest) = sizes.clock_skew_ppm;
        let truth = Truth {
            robot: corrections,
            bar_length_m: bar_links[2].d_m - robot.bar_length_m,
            base_m: kinematics::position(&found.bar.world_from_base).into(),
            // Some clocks were set by hand, some count since the power came on: all magnitudes are as likely.
            clock_shift_s: sign * random.random_range(nearest_s.ln()..=furthest_s.ln()).exp(),
            clock_skew: random.random_range(slowest..=fastest)
                * 1e-6
                * [-1.0, 1.0].choose(&mut random).unwrap(),
        };
        let bar_time = if sizes.bar_utc {
            BarTime::Utc(random.random_range(1_700_000_000..1_800_000_000))
        } else {
            BarTime::Seconds(random.random_range(0.0..5000.0f64).round())
        };
        let mut run = Self {
            robot,
            truth,
            bound_mm_mrad: found.bound_mm_mrad,
            plate_u_mm: sizes.plate_mm,
            true_arm,
            true_bar: found.bar,
            motion: found.motion,
            true_rows: Vec::new(),
            rows: Vec::new(),
            cycles: Vec::new(),
            origins: [0; 5],
            bar_time,
        };
        run.log_robot(&found.start_rad, sizes, &mut random);
        run.log_bar(sizes, &mut random);
        run
    }

    fn log_robot(&mut self, start_rad: &[f64; 6], sizes: &Sizes, random: &mut ChaCha8Rng) {
        // Somebody starts one log, then the other; both have all of the motion.
        let begin_s = random.random_range(-3.0..0.8);
        let end_s = self.motion.duration_s + random.random_range(-0.8..3.0);
        let count = ((end_s - begin_s) * sizes.robot_log_hz) as usize;
        let mut angles = *start_rad;
        let mut before = angles;
        for index in 0..count {
            let time_s = begin_s + index as f64 / sizes.robot_log_hz;
            let bar_rad = self.motion.bar_rad(time_s);
            let pose = self.true_bar.pose(&bar_rad, self.motion.longer_m(&bar_rad));
            let ahead = std::array::from_fn(|joint| 2.0 * angles[joint] - before[joint]);
            before = angles;
            angles = self.true_arm.inverse_near(&pose, &ahead).unwrap();
            self.true_rows.push((time_s, angles));
        }
        let read = self.controller_angles(sizes, random);
        let raw_from_joints = self.robot.joints_from_raw.try_inverse().unwrap();
        let noise = Normal::new(0.0, sizes.resolver_noise_mrad * 1e-3).unwrap();
        let step_rad = std::f64::consts::TAU / sizes.resolver_steps;
        let logs_motors = self.robot.log.column == "motor";
        let ratios = if logs_motors { [1.0; 6] } else { self.robot.gear_ratio };
        let mut resolve = |raw_rad: f64, ratio: f64| {
            let motor_rad = raw_rad * ratio + noise.sample(random);
            (motor_rad / step_rad).round() * step_rad / ratio
        };
        let rows: Vec<Row> = self
            .true_rows
            .iter()
            .zip(read)
            .map(|((time_s, _), read)| {
                let raw = RowVector6::from_row_slice(&read) * raw_from_joints;
                (self.robot_s(*time_s), std::array::from_fn(|motor| resolve(raw[motor], ratios[motor])))
            })
            .collect();
        // From a seed, so that a run is the same with other stamps.
        self.rows = sizes.stamps.applied(&rows, &mut ChaCha8Rng::seed_from_u64(random.random()));
    }

    /// What the controller takes for its joints: before the gears, whose errors have zero mean over the motion (TFRT-6017
    /// section 3.1: a mean would be a static error).
    fn controller_angles(&self, sizes: &Sizes, random: &mut ChaCha8Rng) -> Vec<[f64; 6]> {
        let mut read: Vec<[f64; 6]> = self.true_rows.iter().map(|row| row.1).collect();
        for joint in 0..6 {
            let waves = Waves::of_axis(&self.robot, joint, sizes, random);
            let mut play = Play::new(sizes.backlash_urad);
            let errors: Vec<f64> =
                read.iter().map(|angles| waves.at(angles[joint]) - play.ahead_rad(angles[joint])).collect();
            let moving: Vec<f64> = (self.true_rows.iter().zip(&errors))
                .filter(|((time_s, _), _)| self.motion.schedule.moves(*time_s))
                .map(|(_, error)| *error)
                .collect();
            let mean = moving.iter().sum::<f64>() / moving.len() as f64;
            read.iter_mut().zip(errors).for_each(|(angles, error)| angles[joint] -= error - mean);
        }
        read
    }

    fn log_bar(&mut self, sizes: &Sizes, random: &mut ChaCha8Rng) {
        let waves: [Waves; 5] = std::array::from_fn(|_| Waves::of_encoder(sizes, random));
        let (least, most) = sizes.encoder_noise_urad;
        let noise: [Normal<f64>; 5] =
            std::array::from_fn(|_| Normal::new(0.0, random.random_range(least..=most) * 1e-6).unwrap());
        // Counters that begin at zero when the power comes on, and others that came from anywhere.
        let first = self.motion.bar_rad(0.0);
        let begins_at_zero = random.random_bool(0.5);
        self.origins = first.map(|angle_rad| {
            let begin = (angle_rad / std::f64::consts::TAU * COUNTS_PER_TURN).round() as i64;
            begin - if begins_at_zero { 0 } else { i64::from(random.random::<u32>()) }
        });
        for cycle in 0..(self.motion.duration_s * sizes.bar_hz) as usize {
            let time_s = cycle as f64 / sizes.bar_hz;
            let bar_rad = self.motion.bar_rad(time_s);
            let counts = std::array::from_fn(|joint| {
                let read = bar_rad[joint] + waves[joint].at(bar_rad[joint]) + noise[joint].sample(random);
                logs::counter(read, self.origins[joint])
            });
            self.cycles.push((time_s, counts));
        }
    }

    /// The robot's clock at a time of the bar's since its first cycle \[s\].
    pub fn robot_s(&self, bar_s: f64) -> f64 {
        self.truth.clock_shift_s + (1.0 + self.truth.clock_skew) * bar_s
    }

    /// How far a robot whose links were corrected by so much, by name, holds the end of its plate from where the true one does, mean
    /// over the range of its joints \[mm\].
    pub fn position_error_mm(&self, corrections: &BTreeMap<String, f64>) -> f64 {
        const POSES: usize = 300;
        let mut found = self.robot.nominal.clone();
        found.links[5].a_m += self.robot.plate_m;
        for (index, link) in found.links.iter_mut().enumerate() {
            let of = |kind: &str| corrections.get(&format!("{kind}{}", index + 1)).unwrap_or(&0.0);
            link.a_m += of("ra");
            link.d_m += of("rd");
            link.alpha_rad += of("ralpha");
            link.theta_rad += of("rtheta");
            link.beta_rad += of("rbeta");
        }
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let limits = self.robot.limits_rad();
        let apart = (0..POSES).map(|_| {
            let q = limits.map(|[low, high]| random.random_range(low..high));
            (kinematics::position(&found.pose(&q)) - kinematics::position(&self.true_arm.pose(&q))).norm()
        });
        apart.sum::<f64>() / POSES as f64 * 1e3
    }

    /// Writes the files of a run.
    pub fn write(&self, directory: &Path) -> Files {
        self.write_as(&self.rows, &self.cycles, directory)
    }

    fn write_as(&self, rows: &[Row], cycles: &[(f64, [u32; 5])], directory: &Path) -> Files {
        let bar = directory.join("ball_bar.toml");
        std::fs::write(&bar, bar_toml(&self.robot, self.plate_u_mm)).unwrap();
        Files {
            robot: self.robot.file(directory),
            bar,
            robot_log: logs::write_robot(&self.robot, rows, directory),
            recording: logs::write_bar(self.bar_time, cycles, directory),
        }
    }
}

/// The robot as it was built, with the plate, and what to add to each nominal number.
fn true_arm(robot: &Robot, sizes: &Sizes, random: &mut ChaCha8Rng) -> (Arm, BTreeMap<String, f64>) {
    let error = Normal::new(0.0, sizes.robot_links_mm_mrad * 1e-3).unwrap();
    let of_plate = Normal::new(0.0, sizes.plate_mm * 1e-3).unwrap();
    let mut arm = robot.nominal.clone();
    arm.links[5].a_m += robot.plate_m;
    let mut corrections = BTreeMap::new();
    for (index, link) in arm.links.iter_mut().enumerate() {
        let numbers = [
            ("ra", &mut link.a_m),
            ("rd", &mut link.d_m),
            ("ralpha", &mut link.alpha_rad),
            ("rtheta", &mut link.theta_rad),
        ];
        for (kind, number) in numbers {
            let name = format!("{kind}{}", index + 1);
            let drawn = if name == "ra6" { of_plate.sample(random) } else { error.sample(random) };
            let drawn = if robot.undetermined.contains(&name.as_str()) { 0.0 } else { drawn };
            *number += drawn;
            corrections.insert(name, drawn);
        }
    }
    (arm, corrections)
}

/// The bar's nominal links, rod included.
fn nominal_bar_links(length_m: f64) -> [Dh; 5] {
    [
        Dh::new(0.0, -90.0, 0.0, 0.0),
        Dh::new(0.0, 90.0, 0.0, 0.0),
        Dh::new(0.0, -90.0, length_m, 0.0),
        Dh::new(0.0, 90.0, 0.0, 0.0),
        Dh::new(0.0, 0.0, 0.0, 0.0),
    ]
}

/// The bar as it was built. What no loop can determine beside the robot's own numbers (bd1, balpha2, and link 5: table 3.2
/// of TFRT-6017) is exact; offsets of the encoders are in the counters' origins.
fn true_bar_links(robot: &Robot, sizes: &Sizes, random: &mut ChaCha8Rng) -> [Dh; 5] {
    let error = Normal::new(0.0, sizes.bar_links_mm_mrad * 1e-3).unwrap();
    let mut links = nominal_bar_links(robot.bar_length_m);
    for (index, link) in links.iter_mut().take(4).enumerate() {
        link.a_m += error.sample(random);
        link.d_m += if [1, 3].contains(&index) { error.sample(random) } else { 0.0 };
        link.alpha_rad += if index == 1 { 0.0 } else { error.sample(random) };
    }
    links[2].d_m += Normal::new(0.0, sizes.bar_length_mm * 1e-3).unwrap().sample(random);
    links
}

/// Some place of the bar and some motion, if the robot can follow it well.
fn feasible(
    robot: &Robot,
    arm: &Arm,
    bar_links: &[Dh; 5],
    family: Family,
    sizes: &Sizes,
    scale: f64,
    random: &mut ChaCha8Rng,
) -> Option<Feasible> {
    let duration_s = sizes.duration_s.unwrap_or(family.duration_s());
    let speed = sizes.speed_rad_s.unwrap_or(family.speed_rad_s());
    let limits = robot.limits_rad().map(|[low, high]| [low + 0.05, high - 0.05]);
    // The operator drives the robot to a posture in the middle of its reach, and sets up the bar there.
    let posture = limits.map(|[low, high]| {
        let (middle, half) = ((low + high) / 2.0, (high - low) / 2.0);
        middle + random.random_range(-0.6..0.6) * half.min(2.0)
    });
    let flange = arm.pose(&posture);
    let turned = Rotation3::from_matrix_unchecked(kinematics::rotation(&flange));
    let sweep = Sweep::about(&turned, family, scale, random)?;
    let bar = placed(&flange, &sweep.middle, bar_links, sizes, random)?;
    let path = BarPath::new(family, speed * duration_s, sweep, random);
    let start_rad = approached(arm, &bar, &sweep.middle, &path.joints_rad(0.0), &posture)?;
    // As fast as asked for where nothing needs to be faster than the path: see what the robot needs.
    let whole = followed(arm, &bar, &path, speed * duration_s, &start_rad, &limits)?;
    let schedule = Schedule::new(family, duration_s, speed / whole.fastest.max(1.0), random);
    let run = followed(arm, &bar, &path, schedule.length(), &start_rad, &limits)?;
    let bound_mm_mrad = health::bound_mm_mrad(robot, arm, &bar, &run.poses);
    if bound_mm_mrad > sizes.bound_mm_mrad {
        return None;
    }
    let runout = [(); 2].map(|()| Waves::of_bar(sizes, random));
    let motion = Motion { path, schedule, duration_s, runout };
    Some(Feasible { bar, motion, start_rad, bound_mm_mrad })
}

/// The bar below the flange, its base not quite upright; none if it would stand in the ground or in the robot.
fn placed(
    flange: &Matrix4<f64>,
    middle: &[f64; 5],
    bar_links: &[Dh; 5],
    sizes: &Sizes,
    random: &mut ChaCha8Rng,
) -> Option<Bar> {
    let lean_towards = random.random_range(0.0..std::f64::consts::TAU);
    let lean = Vector3::new(lean_towards.cos(), lean_towards.sin(), 0.0) * (sizes.base_tilt_mrad * 1e-3);
    let mut bar =
        Bar { world_from_base: Isometry3::new(Vector3::zeros(), lean).to_homogeneous(), links: *bar_links };
    let place = kinematics::position(flange) - kinematics::position(&bar.pose(middle, 0.0));
    bar.world_from_base.fixed_view_mut::<3, 1>(0, 3).copy_from(&place);
    (place.z > 0.0 && place.x.hypot(place.y) > 0.2).then_some(bar)
}

/// Angles of the robot where the bar has been led from one posture to another.
fn approached(arm: &Arm, bar: &Bar, from: &[f64; 5], to: &[f64; 5], posture: &[f64; 6]) -> Option<[f64; 6]> {
    (0..=20).try_fold(*posture, |angles, step| {
        let share = f64::from(step) / 20.0;
        let between = std::array::from_fn(|joint| from[joint] + share * (to[joint] - from[joint]));
        arm.inverse_near(&bar.pose(&between, 0.0), &angles)
    })
}

/// How the robot moves on a path.
struct Followed {
    /// Speed of the fastest joint where it is fastest, by that of the path.
    fastest: f64,
    /// Joints of the bar and of the robot, evenly along the path.
    poses: Vec<([f64; 5], [f64; 6])>,
}

/// Leads the robot along the path; none if that is beyond its or the bar's limits, or comes near a singular pose of it.
fn followed(
    arm: &Arm,
    bar: &Bar,
    path: &BarPath,
    length: f64,
    start_rad: &[f64; 6],
    limits: &[[f64; 2]; 6],
) -> Option<Followed> {
    const STEP: f64 = 0.04;
    const FASTEST: f64 = 4.0;
    let mut angles = *start_rad;
    let mut followed = Followed { fastest: 0.0, poses: Vec::new() };
    let mut last_bar = path.joints_rad(0.0);
    let first_bar = last_bar;
    for index in 1..=(length / STEP) as usize {
        let bar_rad = path.joints_rad(index as f64 * STEP);
        let jumps = bar_rad.iter().zip(&last_bar).any(|(now, last)| (now - last).abs() > 2.0 * STEP);
        let cable = bar_rad.iter().zip(&first_bar).any(|(now, first)| (now - first).abs() > CABLE_RAD);
        let next = arm.inverse_near(&bar.pose(&bar_rad, 0.0), &angles)?;
        let fastest = (0..6).map(|joint| (next[joint] - angles[joint]).abs() / STEP).fold(0.0, f64::max);
        // Above the ground on which robot and bar stand.
        let sunk = kinematics::position(&arm.pose(&next)).z < 0.05;
        if jumps || cable || sunk || fastest > FASTEST || !within(&next, limits) {
            return None;
        }
        followed.fastest = followed.fastest.max(fastest);
        followed.poses.push((bar_rad, next));
        (angles, last_bar) = (next, bar_rad);
    }
    Some(followed)
}

/// The bar's file: nominal, encoders in order.
fn bar_toml(robot: &Robot, plate_u_mm: f64) -> String {
    let mut text = format!(
        "name = \"double ball-bar\"\nlength_m = {:?}\nplate_m = {:?}\nplate_u_um = {:?}\ntool_m = 0.0\n",
        robot.bar_length_m,
        robot.plate_m,
        plate_u_mm * 1e3
    );
    nominal_bar_links(0.0).iter().for_each(|link| text += &link_toml(link));
    for joint in 1..=5 {
        text += &format!(
            "\n[[encoders]]\njoint = {joint}\nlines = 3600\ninterpolation_bits = 12\ndirection = \"positive\"\n"
        );
    }
    text
}
