//! A UR10 with link errors that a tracker measures. The tracker has an independent clock.

use std::f64::consts::TAU;
use std::path::Path;

use identify::instrument::Tracker;
use identify::kinematics::{Chain, Joints, Pose, flange_chain};
use identify::logs::{MeasuredPoseMapping, PoseRow, RobotLog, Stream, TimedPoses};
use identify::model::{Model, ParameterId, SetUp};
use identify::prepare::{AlignedPoses, PrepareError, PrepareOptions, align_poses};
use nalgebra::{Rotation3, Vector3};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;

use super::ur10;

/// Properties of the two logs.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    /// Duration of the tracker's log \[s\].
    pub duration_s: f64,
    /// Number of rows of the tracker per second. Below one, the robot stops for each row.
    pub rate_hz: f64,
    /// Standard deviation of each measured coordinate \[m\].
    pub noise_m: f64,
    /// Standard deviation of each stamp of the tracker \[s\]. Stamps never decrease.
    pub jitter_s: f64,
    /// Largest difference between the time of a row and the corresponding regular time \[s\].
    pub uneven_s: f64,
    /// Rate of the robot's clock relative to the tracker's clock, minus one.
    pub skew: f64,
    /// Robot clock minus tracker clock at the tracker's first row \[s\].
    pub shift_s: f64,
    /// The robot's log begins earlier than the tracker's log by the first value, and ends later by the second value \[s\].
    pub lead_s: [f64; 2],
    /// Time after which the motion repeats \[s\]; `None` if it does not repeat.
    pub lap_s: Option<f64>,
    /// True if the tracker is moved after three quarters of the time and measures a second target. The second target is
    /// measured at each stop of the robot or, if the robot does not stop, in the second half of the time.
    pub moved: bool,
    /// Before and after each stop of the robot, it stands still for this fraction of the time between stops.
    pub stay: f64,
    pub with_rotation: bool,
}

impl Default for Sizes {
    fn default() -> Self {
        Self {
            duration_s: 120.0,
            rate_hz: 100.0,
            noise_m: 2e-5,
            jitter_s: 0.0,
            uneven_s: 0.0,
            skew: 35e-6,
            shift_s: 4321.0987,
            lead_s: [3.0, 2.0],
            lap_s: None,
            moved: false,
            stay: 0.4,
            with_rotation: false,
        }
    }
}

/// Both logs and their truth.
pub struct Followed {
    pub sizes: Sizes,
    pub truth: Chain,
    pub log: RobotLog,
    /// Content of the tracker's file: `t_ms;x;y;z` in mm, and a rotation vector in rad if rotations are measured.
    pub text: String,
    /// True time of each row of the tracker \[s\]. It is a time of the tracker's clock and
    /// counts from the first regular time.
    taken_s: Vec<f64>,
    path: PathOfJoints,
    /// Poses of the two stations.
    places: [Pose; 2],
    /// Poses of the two targets on the flange.
    pub probes: [Pose; 2],
    seed: u64,
}

/// Time of the tracker's first row on its clock \[s\].
const FIRST_S: f64 = 1000.25;
/// Time between two rows of the robot's log \[s\].
const ROBOT_PERIOD_S: f64 = 0.008;
const NOISE_RAD: f64 = 1e-5;

/// Joints as functions of time. Each seed has a different motion.
struct PathOfJoints {
    sines: [[(f64, f64, f64); 3]; 6],
    /// Time between two stops \[s\]; `None` if the robot never stops.
    stops_s: Option<f64>,
    stay: f64,
}

impl PathOfJoints {
    fn new(Sizes { rate_hz, lap_s, stay, .. }: Sizes, random: &mut StdRng) -> Self {
        let stops_s = (rate_hz < 1.0).then_some(1.0 / rate_hz);
        let mut sine = || {
            let period_s: f64 = random.random_range(4.0..15.0);
            // A lap has an integer number of periods.
            let period_s = lap_s.map_or(period_s, |lap_s| lap_s / (lap_s / period_s).round());
            (random.random_range(0.15..0.4), period_s, random.random_range(0.0..TAU))
        };
        Self { sines: std::array::from_fn(|_| std::array::from_fn(|_| sine())), stops_s, stay }
    }

    fn at(&self, t_s: f64) -> Joints {
        const MIDDLE: [f64; 6] = [0.3, -1.2, 1.4, -0.6, -1.2, 0.2];
        let along_s = self.stops_s.map_or(t_s, |stop_s| {
            let (number, part) = ((t_s / stop_s).floor(), (t_s / stop_s).rem_euclid(1.0));
            // The robot moves smoothly in the middle of the interval between two stops. To stand still at both ends, it
            // moves faster than the interval would require.
            let u = ((part - self.stay) / (1.0 - 2.0 * self.stay)).clamp(0.0, 1.0);
            7.3 * (number + u * u * u * (10.0 + u * (6.0 * u - 15.0)))
        });
        let of = |joint: usize| -> f64 {
            self.sines[joint]
                .iter()
                .map(|(size, period_s, phase)| size * (TAU * along_s / period_s + phase).sin())
                .sum()
        };
        Joints::from_fn(6, |joint| MIDDLE[joint] + of(joint))
    }
}

impl Followed {
    pub fn new(seed: u64, sizes: Sizes) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let mut truth = flange_chain(&ur10());
        for link in truth.links.iter_mut().take(5) {
            link.a_m += random.random_range(-1e-3..1e-3);
            link.theta_rad += random.random_range(-2e-3..2e-3);
            link.alpha_rad += random.random_range(-1e-3..1e-3);
        }
        let pose = |at_m: [f64; 3], turned: [f64; 3]| {
            Pose::from_parts(Vector3::from(at_m).into(), Rotation3::new(Vector3::from(turned)))
        };
        let places = [pose([-3.0, 0.5, 1.3], [0.4, 1.9, -2.1]), pose([1.0, 3.5, 1.1], [-0.2, 0.1, 1.0])];
        let probes =
            [pose([0.05, -0.08, 0.12], [0.1, -1.5, 0.3]), pose([-0.07, 0.02, 0.15], [0.4, 0.2, -0.9])];
        let path = PathOfJoints::new(sizes, &mut random);
        let mut normal = |sigma: f64| -> f64 { sigma * random.sample::<f64, _>(StandardNormal) };
        let rows = ((sizes.duration_s + sizes.lead_s[0] + sizes.lead_s[1]) / ROBOT_PERIOD_S) as usize;
        let (mut stamps_s, mut q_rad) = (Vec::new(), Vec::new());
        for row in 0..rows {
            // Rows are regular on the robot's clock.
            let tau_s = row as f64 * ROBOT_PERIOD_S;
            let t_s = tau_s / (1.0 + sizes.skew) - sizes.lead_s[0];
            stamps_s.push(tau_s);
            q_rad.push(path.at(t_s).map(|q| q).iter().map(|q| q + normal(NOISE_RAD)).collect());
        }
        let first_ns = ((FIRST_S + sizes.shift_s - sizes.lead_s[0] * (1.0 + sizes.skew)) * 1e9) as i64;
        let log = RobotLog { q_rad: Stream::new(first_ns, stamps_s, q_rad).into(), ..RobotLog::default() };
        let mut text = String::from("t_ms;x;y;z");
        text += if sizes.with_rotation { ";rx;ry;rz" } else { "" };
        text += if sizes.moved { ";station;target\n" } else { "\n" };
        let rows = (sizes.duration_s * sizes.rate_hz) as usize;
        let mut uneven = StdRng::seed_from_u64(2000 + seed);
        let due_s: Vec<f64> = (0..rows)
            .map(|row| row as f64 / sizes.rate_hz + sizes.uneven_s * uneven.random_range(-1.0..=1.0))
            .collect();
        let (mut before_ms, mut taken_s) = (0.0, Vec::new());
        for (row, &due_s) in due_s.iter().enumerate() {
            let station = usize::from(sizes.moved && row >= rows - rows / 4);
            let both = path.stops_s.is_some() && sizes.moved;
            let targets = if both { vec![0, 1] } else { vec![usize::from(sizes.moved && row > rows / 2)] };
            for target in targets {
                let t_s = due_s + if both { 0.2 * target as f64 } else { 0.0 };
                taken_s.push(t_s);
                let mut seen = places[station].inverse() * truth.forward(&path.at(t_s)) * probes[target];
                seen.translation.vector += Vector3::from_fn(|_, _| normal(sizes.noise_m));
                let stamp_ms = f64::max(before_ms, (FIRST_S + t_s + normal(sizes.jitter_s)) * 1e3);
                before_ms = stamp_ms;
                let position = seen.translation.vector * 1e3;
                text += &format!("{stamp_ms:.4};{:.5};{:.5};{:.5}", position.x, position.y, position.z);
                if sizes.with_rotation {
                    let turn = seen.rotation.scaled_axis();
                    let turn = turn + Vector3::from_fn(|_, _| normal(sizes.noise_m));
                    text += &format!(";{:.8};{:.8};{:.8}", turn.x, turn.y, turn.z);
                }
                if sizes.moved {
                    text += &format!(";{};{}", ["north", "south"][station], ["red", "green"][target]);
                }
                text += "\n";
            }
        }
        Self { sizes, truth, log, text, taken_s, path, places, probes, seed }
    }

    pub fn mapping(&self) -> String {
        let views = if self.sizes.moved { "station = \"station\"\ntarget = \"target\"\n" } else { "" };
        let mut mapping = format!(
            "{views}[csv]\ndelimiter = \";\"\n[time]\ncolumn = \"t_ms\"\nunit = \"ms\"\n[position]\ncolumns = [\"x\", \"y\", \
             \"z\"]\nunit = \"mm\"\n",
        );
        if self.sizes.with_rotation {
            mapping +=
                "[rotation]\nas = \"rotation_vector\"\ncolumns = [\"rx\", \"ry\", \"rz\"]\nunit = \"rad\"\n";
        }
        mapping
    }

    pub fn poses(&self) -> TimedPoses {
        let mapping: MeasuredPoseMapping = toml::from_str(&self.mapping()).unwrap();
        TimedPoses::read(self.text.as_bytes(), Path::new("tracker.csv"), &mapping).unwrap()
    }

    pub fn aligned(&self) -> Result<AlignedPoses, PrepareError> {
        self.aligned_with(&self.log)
    }

    pub fn aligned_with(&self, log: &RobotLog) -> Result<AlignedPoses, PrepareError> {
        align_poses(&self.poses(), log, &flange_chain(&ur10()), &PrepareOptions::default())
    }

    /// Writes the files `robot.csv`, `tracker.csv` and `tracker.toml`.
    pub fn write(&self, directory: &Path) {
        let log = std::fs::File::create(directory.join("robot.csv")).unwrap();
        identify::logs::write(&self.log, &ur10(), log).unwrap();
        std::fs::write(directory.join("tracker.csv"), &self.text).unwrap();
        std::fs::write(directory.join("tracker.toml"), self.mapping()).unwrap();
    }

    /// Rows of an alignment with their joints, in the form that a calibration uses.
    pub fn measured(&self, aligned: &AlignedPoses) -> Tracker {
        let poses = self.poses();
        let rows: Vec<PoseRow> = aligned
            .rows
            .iter()
            .zip(&aligned.states)
            .map(|(row, state)| PoseRow { joints_rad: state.q, ..poses.rows[*row] })
            .collect();
        match &aligned.moving {
            Some(moving) => Tracker::of_moving(&rows, moving.clone()),
            None => Tracker::new(&rows),
        }
    }

    /// The same rows with the joints at the true times of the rows. The noise of the rows remains.
    pub fn with_perfect_times(&self, aligned: &AlignedPoses) -> Vec<PoseRow> {
        let (poses, mut random) = (self.poses(), StdRng::seed_from_u64(1000 + self.seed));
        let rows = aligned.rows.iter().map(|row| {
            // Rows with the stamp of the previous row may have been dropped, so the line number identifies the row.
            // The header is line 1.
            let joints = self.path.at(self.taken_s[poses.rows[*row].line as usize - 2]);
            let noisy = joints.iter().map(|q| q + NOISE_RAD * random.sample::<f64, _>(StandardNormal));
            PoseRow { joints_rad: noisy.collect(), ..poses.rows[*row] }
        });
        rows.collect()
    }

    /// Errors of the estimated clock shift \[s\] and skew, for a solved model of a moving target.
    pub fn clock_errors(&self, aligned: &AlignedPoses, model: &Model) -> [f64; 2] {
        let value = |id| model.parameter(id).unwrap().value;
        let moving = aligned.moving.as_ref().unwrap();
        let t_ref_s = self.poses().rows.t_s[aligned.rows[0]] - moving.t_s[0];
        // The times count from the first regular time, from which the first stamp may differ.
        let t_ref_s = t_ref_s + self.poses().rows.first_stamp_ns as f64 * 1e-9 - FIRST_S;
        let found_s = aligned.alignment.clock_difference_ns as f64 * 1e-9 + value(ParameterId::ClockShift);
        let truly_s = self.sizes.shift_s + self.sizes.skew * t_ref_s;
        [found_s - truly_s, value(ParameterId::ClockSkew) - self.sizes.skew]
    }

    /// Robot clock minus tracker clock \[s\] at the tracker's time `t_s` \[s\].
    pub fn clock_difference_s(&self, t_s: f64) -> f64 {
        self.sizes.shift_s + self.sizes.skew * (t_s - FIRST_S)
    }

    /// Mean distance between the probe positions of an identified and of the true robot \[m\]. It includes errors of the
    /// poses of tracker and probe.
    pub fn error_m(&self, model: &Model) -> f64 {
        let geometry = model.geometry(&[]);
        let (place, probe) = geometry.tracker.at(SetUp::default()).unwrap();
        let (place, probe) = (place.pose(), probe.pose());
        let mut random = StdRng::seed_from_u64(7);
        let errors = (0..400).map(|_| {
            let q = self.path.at(random.random_range(0.0..self.sizes.duration_s));
            let found = place.inverse() * geometry.robot.forward(&q) * probe;
            let truly = self.places[0].inverse() * self.truth.forward(&q) * self.probes[0];
            (found.translation.vector - truly.translation.vector).norm()
        });
        errors.sum::<f64>() / 400.0
    }
}
