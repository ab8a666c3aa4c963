//! Generates ball-bar experiments with known truth, as files like those of a user. None of the code is shared with
//! the product: kinematics, inverse kinematics, paths, gears, encoders, clocks and file formats are implemented again
//! from their descriptions (TFRT-6017 chapters 2 to 5, data sheets, README). All of these runs are healthy, so a
//! refusal is an error of the program.

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

/// Sizes of all deviations from the nominal experiment, and settings of the run.
#[derive(Debug, Clone)]
pub struct Sizes {
    /// Standard deviation of each parameter of the robot's links \[mm, mrad\].
    pub robot_links_mm_mrad: f64,
    /// Standard deviation of each parameter of the bar's links, which are manufactured accurately \[mm, mrad\].
    pub bar_links_mm_mrad: f64,
    /// Standard deviation of the bar's length \[mm\].
    pub bar_length_mm: f64,
    /// Standard deviation of the measured length of the offset plate, which determines the scale \[mm\].
    pub plate_mm: f64,
    /// Tilt of the bar's base, in a random direction \[mrad\].
    pub base_tilt_mrad: f64,
    /// Amplitudes of the errors of each robot axis, for orders one and two per turn and for the orders
    /// of its gear, from..to \[urad\].
    pub gear_urad: (f64, f64),
    /// Number of lobes of cycloid gears, from..to. The robots' files state 39.
    pub lobes: (u32, u32),
    /// Width of the play of each axis \[urad\].
    pub backlash_urad: f64,
    /// White noise of a resolver on the shaft of the motor \[mrad\].
    pub resolver_noise_mrad: f64,
    /// Resolution of a resolver: number of steps per turn of its motor.
    pub resolver_steps: f64,
    /// Eccentricity of each encoder of the bar: amplitudes of orders one and two per turn \[urad\].
    pub encoder_once_urad: f64,
    pub encoder_twice_urad: f64,
    /// White noise of each encoder, from..to \[urad\].
    pub encoder_noise_urad: (f64, f64),
    /// Amplitude of the bar length as a function of each of its first two joints, order two per turn \[um\].
    pub bar_runout_um: f64,
    /// Robot clock minus bar clock at the bar's first cycle, from..to \[s\]. The sign is random.
    pub clock_shift_s: (f64, f64),
    /// Rate error of the robot's clock, from..to \[ppm\]. The sign is random.
    pub clock_skew_ppm: (f64, f64),
    pub robot_log_hz: f64,
    pub bar_hz: f64,
    pub stamps: Stamps,
    /// Whether the stamps of the bar are UTC. Otherwise they are seconds since an arbitrary instant.
    pub bar_utc: bool,
    /// Duration \[s\]. `speed_rad_s` is the highest speed \[rad/s\]. If one of them is `None`, the
    /// default of the family of paths is used.
    pub duration_s: Option<f64>,
    pub speed_rad_s: Option<f64>,
    /// Largest permitted lower bound of the robot's error \[mm|mrad\], see [`health`]. If a motion has a larger
    /// bound, another motion is generated.
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
    /// Deviations of geometry only. Both chains close exactly. The only other errors are that counts and stamps are rounded.
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

/// Maximum number of pairs of posture and path that are tried until the robot can follow
/// one. Usually some hundreds are needed.
const ATTEMPTS: u32 = 30_000;

/// True values of a run.
#[derive(Debug, Clone)]
pub struct Truth {
    /// Corrections of the nominal link parameters by name, `ra1` to `rtheta6` \[m, rad\]. As in the files of the
    /// program, `ra6` includes the plate.
    pub robot: BTreeMap<String, f64>,
    /// Correction of the bar's nominal length \[m\].
    pub bar_length_m: f64,
    /// Centre of the gimbal in the robot's base \[m\].
    pub base_m: [f64; 3],
    /// Time of the robot's clock at the first cycle of the bar \[s\]. The bar's time is zero at this cycle.
    pub clock_shift_s: f64,
    /// Rate of the robot's clock relative to the bar's clock, minus one.
    pub clock_skew: f64,
}

/// Paths of the files of one run.
#[derive(Debug, Clone)]
pub struct Files {
    pub robot: PathBuf,
    pub bar: PathBuf,
    pub robot_log: PathBuf,
    pub recording: PathBuf,
}

/// One run with its true values and its readings.
pub struct Run {
    pub robot: Robot,
    pub truth: Truth,
    /// Lower bound of the robot's error \[mm|mrad\], see [`health`].
    pub bound_mm_mrad: f64,
    /// Standard uncertainty of the plate \[mm\].
    plate_u_mm: f64,
    true_arm: Arm,
    true_bar: Bar,
    motion: Motion,
    /// Time on the bar's clock \[s\] and true joint angles of the robot \[rad\], for each row of the log.
    true_rows: Vec<(f64, [f64; 6])>,
    rows: Vec<Row>,
    cycles: Vec<(f64, [u32; 5])>,
    origins: [i64; 5],
    bar_time: BarTime,
}

/// Joints of the bar at any time of a run.
struct Motion {
    path: BarPath,
    schedule: Schedule,
    duration_s: f64,
    /// Deviations of the bar length as functions of joints 1 and 2.
    runout: [Waves; 2],
}

impl Motion {
    fn bar_rad(&self, time_s: f64) -> [f64; 5] {
        self.path.joints_rad(self.schedule.at(time_s))
    }

    /// Length of the rod minus its parameter at these joint angles \[m\].
    fn longer_m(&self, bar_rad: &[f64; 5]) -> f64 {
        self.runout[0].at(bar_rad[0]) + self.runout[1].at(bar_rad[1])
    }
}

/// A base of the bar and a motion that the robot can follow.
struct Feasible {
    bar: Bar,
    motion: Motion,
    start_rad: [f64; 6],
    bound_mm_mrad: f64,
}

impl Run {
    /// Generates the run of a seed.
    ///
    /// # Panics
    /// If no motion is found that the robot can follow, because sizes are wrong.
    pub fn new(robot: Robot, family: Family, sizes: &Sizes, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let (true_arm, corrections) = true_arm(&robot, sizes, &mut random);
        let bar_links = true_bar_links(&robot, sizes, &mut random);
        let found = (0..ATTEMPTS)
            .find_map(|attempt| {
                // The first attempts have wide sweeps. Later attempts have narrower ones, which more robots can follow.
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
            // Some clocks are set by hand, others count from power-on. All orders of magnitude of the
            // shift therefore have equal probability.
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
        // The two logs begin at different times, but both contain the whole motion.
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
        // Use a separate seed for the stamps, so that other stamps do not change the rest of the run.
        self.rows = sizes.stamps.applied(&rows, &mut ChaCha8Rng::seed_from_u64(random.random()));
    }

    /// Joint angles of the controller, without the errors of the gears. The mean of the gear errors over the motion is
    /// subtracted, because a mean would be a static error (TFRT-6017 section 3.1).
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
        // Some counters start at zero at power-on, others at an arbitrary value.
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

    /// Time of the robot's clock at a time of the bar \[s\]. The bar's time counts from its first cycle.
    pub fn robot_s(&self, bar_s: f64) -> f64 {
        self.truth.clock_shift_s + (1.0 + self.truth.clock_skew) * bar_s
    }

    /// Mean distance between the plate ends of the true robot and of a robot with these link corrections \[mm\]. The
    /// mean is over the range of the joints.
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

    /// Writes the files of the run to a directory.
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

/// Links of the true robot including the plate, and the corrections of its nominal parameters.
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

/// Nominal links of the bar, with this length of the rod.
fn nominal_bar_links(length_m: f64) -> [Dh; 5] {
    [
        Dh::new(0.0, -90.0, 0.0, 0.0),
        Dh::new(0.0, 90.0, 0.0, 0.0),
        Dh::new(0.0, -90.0, length_m, 0.0),
        Dh::new(0.0, 90.0, 0.0, 0.0),
        Dh::new(0.0, 0.0, 0.0, 0.0),
    ]
}

/// Links of the true bar. Parameters that the loop cannot separate from those of the robot are exact: bd1, balpha2, and link
/// 5 (table 3.2 of TFRT-6017). The origins of the counters contain the offsets of the encoders.
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

/// A random base of the bar with a random motion. `None` if the robot cannot follow the motion, or if the motion
/// determines the robot too poorly.
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
    // As an operator would, move the robot to a posture in the middle of its reach, and set up the bar there.
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
    // Follow the path once to find out by which factor robot joints are faster than the path. Then
    // slow down the schedule by this factor.
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

/// Places the bar so that its end is at the flange, with a small tilt of its base. `None` if its base would be below the
/// ground or inside the robot.
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

/// Angles of the robot after it has followed the bar from the joints `from` to the joints `to`. `None` if it cannot.
fn approached(arm: &Arm, bar: &Bar, from: &[f64; 5], to: &[f64; 5], posture: &[f64; 6]) -> Option<[f64; 6]> {
    (0..=20).try_fold(*posture, |angles, step| {
        let share = f64::from(step) / 20.0;
        let between = std::array::from_fn(|joint| from[joint] + share * (to[joint] - from[joint]));
        arm.inverse_near(&bar.pose(&between, 0.0), &angles)
    })
}

/// Motion of the robot while it follows a path of the bar.
struct Followed {
    /// Largest ratio of the speed of a robot joint to the speed along the path.
    fastest: f64,
    /// Joint angles of the bar and of the robot at equal distances along the path \[rad\].
    poses: Vec<([f64; 5], [f64; 6])>,
}

/// Moves the robot along the path. `None` if the path exceeds the limits of robot or bar, or is nearly singular.
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
        // The robot and the bar stand on the ground at height zero, so the end must stay above it.
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

/// Text of the bar's file, with nominal lengths and the encoders in order.
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
