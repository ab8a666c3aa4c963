//! Paths of the bar. A path is a smooth curve of the bar's five joints. Its schedule consists of moves with smooth
//! starts, and of rests between them.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::Rng;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;

/// Family of paths on the sphere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Family {
    /// Each joint of the bar follows a sine of its own frequency.
    Lissajous,
    /// The rod moves on a cone about a direction. The width of the cone varies.
    Spiral,
    /// A B-spline through random control points.
    Waypoints,
    /// A sequence of imperfect circles. The flange has a constant direction in each of them.
    Circles,
    /// A closed curve, repeated.
    Laps,
    /// Short moves between long rests.
    Bursts,
    /// Joint speeds are up to 1.5 rad/s.
    Fast,
    /// A run of half a minute.
    Short,
    /// A run of ten minutes.
    Long,
    /// The angle between the rod and the gimbal's first axis decreases to a few degrees.
    NearSingular,
    /// The rod passes through the gimbal's first axis, so that the bar changes its configuration.
    ThroughSingular,
}

impl Family {
    pub const ALL: [Self; 11] = [
        Self::Lissajous,
        Self::Spiral,
        Self::Waypoints,
        Self::Circles,
        Self::Laps,
        Self::Bursts,
        Self::Fast,
        Self::Short,
        Self::Long,
        Self::NearSingular,
        Self::ThroughSingular,
    ];

    /// Default duration of a run \[s\].
    pub fn duration_s(self) -> f64 {
        match self {
            Self::Short => 30.0,
            Self::Fast => 60.0,
            Self::Bursts | Self::Circles => 240.0,
            Self::Long => 600.0,
            _ => 120.0,
        }
    }

    /// Highest speed of any joint of robot or bar \[rad/s\].
    pub fn speed_rad_s(self) -> f64 {
        match self {
            Self::Fast => 1.5,
            Self::Short | Self::Bursts => 0.7,
            Self::Long => 0.3,
            _ => 0.5,
        }
    }
}

type Curve = Box<dyn Fn(f64) -> [f64; 5]>;

/// Joints of the bar as functions of a path coordinate. The fastest joint turns by at most one radian per unit.
pub struct Path {
    curve: Curve,
    unit: f64,
}

impl Path {
    /// A random curve of this length about the middle of the sweep.
    pub fn new(family: Family, length: f64, sweep: Sweep, random: &mut ChaCha8Rng) -> Self {
        let curve = curve(family, length, sweep, random);
        let step = 0.01;
        let count = (length.min(60.0) / step) as usize;
        let fastest = (0..count)
            .map(|index| index as f64 * step)
            .flat_map(|at| {
                let (here, there) = (curve(at), curve(at + 1e-4));
                (0..5).map(move |joint| (there[joint] - here[joint]).abs() / 1e-4)
            })
            .fold(0.0, f64::max);
        Self { curve, unit: 1.0 / fastest }
    }

    /// Angles of the bar's joints at this path coordinate \[rad\].
    pub fn joints_rad(&self, at: f64) -> [f64; 5] {
        (self.curve)(at * self.unit)
    }
}

/// Centre and half width of the sweep of each joint \[rad\].
#[derive(Debug, Clone, Copy)]
pub struct Sweep {
    pub middle: [f64; 5],
    half: [f64; 5],
}

impl Sweep {
    /// Sweeps that are wider than the default by the factor `scale`. `flange` is the rotation of the flange in the
    /// bar's base, from which the angles of the third joint and the cardan follow. `None` if the rod would be nearly
    /// parallel to the axis of the flange.
    pub fn about(
        flange: &Rotation3<f64>,
        family: Family,
        scale: f64,
        random: &mut ChaCha8Rng,
    ) -> Option<Self> {
        let mut degrees = |low: f64, high: f64| random.random_range(low..high).to_radians();
        let mut half = [(35.0, 65.0), (18.0, 32.0), (30.0, 70.0), (20.0, 35.0), (50.0, 100.0)]
            .map(|(low, high)| scale * degrees(low, high));
        if family == Family::ThroughSingular {
            // Near the singular pose, the gimbal restricts the motion of the rod to one plane.
            half[0] *= 0.4;
        }
        let b1 = degrees(-150.0, 150.0);
        let b2 = match family {
            // The smallest distance from the axis is 2 to 6 degrees.
            Family::NearSingular => half[1] + degrees(2.0, 6.0),
            Family::ThroughSingular => degrees(5.0, 12.0),
            _ => half[1] + degrees(10.0, 60.0),
        };
        let side = if random.random_bool(0.5) { 1.0 } else { -1.0 };
        let rod_from_flange = (zyz(b1, b2, 0.0).transpose() * flange).into_inner();
        let [b3, b4, b5] = cardan(&rod_from_flange, &[b1, b2, 0.0, side, 0.0]);
        (b4.sin().abs() > 0.8).then_some(Self { middle: [b1, b2, b3, b4, b5], half })
    }

    /// Joint angles at the fractions `share` (-1 to 1) of the half sweeps \[rad\].
    fn at(&self, share: [f64; 5]) -> [f64; 5] {
        std::array::from_fn(|joint| self.middle[joint] + self.half[joint] * share[joint])
    }
}

fn curve(family: Family, length: f64, sweep: Sweep, random: &mut ChaCha8Rng) -> Curve {
    match family {
        Family::Spiral => spiral(sweep, random),
        Family::Waypoints | Family::Bursts | Family::Long => waypoints(sweep, length, random),
        Family::Circles => circles(sweep, length, random),
        Family::Laps => sines(sweep, closed_frequencies(random), random),
        _ => sines(sweep, open_frequencies(random), random),
    }
}

/// Random frequencies without a common multiple, so that the curve does not close. Joints
/// with wide sweeps have low frequencies.
fn open_frequencies(random: &mut ChaCha8Rng) -> [f64; 5] {
    [0.9, 2.1, 1.0, 1.7, 0.6].map(|frequency: f64| frequency * random.random_range(0.8..1.25))
}

/// Integer frequencies, so that the curve is closed.
fn closed_frequencies(random: &mut ChaCha8Rng) -> [f64; 5] {
    let mut of = |choice: &[f64]| *choice.choose(random).unwrap();
    [of(&[1.0, 2.0]), of(&[2.0, 3.0]), of(&[1.0, 2.0]), of(&[2.0, 3.0]), 1.0]
}

fn phases(random: &mut ChaCha8Rng) -> [f64; 5] {
    std::array::from_fn(|_| random.random_range(0.0..TAU))
}

fn sines(sweep: Sweep, frequencies: [f64; 5], random: &mut ChaCha8Rng) -> Curve {
    let phases = phases(random);
    Box::new(move |at| sweep.at(std::array::from_fn(|joint| (frequencies[joint] * at + phases[joint]).sin())))
}

fn spiral(sweep: Sweep, random: &mut ChaCha8Rng) -> Curve {
    let frequencies = open_frequencies(random);
    let phases = phases(random);
    let turns = random.random_range(6.0..10.0);
    Box::new(move |at| {
        // The width of the cone increases and decreases once in this number of turns. It never becomes zero.
        let radius = 0.55 - 0.45 * (at / turns).cos();
        let wave = |joint: usize| (0.37 * frequencies[joint] * at + phases[joint]).sin();
        sweep.at([
            radius * (at + phases[0]).cos(),
            radius * (at + phases[0]).sin(),
            wave(2),
            wave(3),
            wave(4),
        ])
    })
}

fn waypoints(sweep: Sweep, length: f64, random: &mut ChaCha8Rng) -> Curve {
    // Control points of a uniform cubic B-spline. They are at most one unit apart, and the curve remains within their hull.
    let count = (length * 2.0) as usize + 8;
    let points: Vec<[f64; 5]> = (0..count)
        .map(|_| std::array::from_fn(|_| (1.4 * random.random_range(-1.0..1.0f64)).clamp(-1.2, 1.2)))
        .collect();
    Box::new(move |at| {
        let at = at.clamp(0.0, (count - 5) as f64);
        let first = at as usize;
        let x = at - first as f64;
        let weights = [
            (1.0 - x).powi(3),
            3.0 * x.powi(3) - 6.0 * x.powi(2) + 4.0,
            -3.0 * x.powi(3) + 3.0 * x.powi(2) + 3.0 * x + 1.0,
            x.powi(3),
        ]
        .map(|weight| weight / 6.0);
        let of = |joint: usize| (0..4).map(|k| weights[k] * points[first + k][joint]).sum();
        sweep.at(std::array::from_fn(of))
    })
}

/// One circle of the rod: centre and half width of the first two joints \[rad\], and the rotation of the flange.
#[derive(Clone, Copy)]
struct Circle {
    middle: [f64; 2],
    half: [f64; 2],
    world_from_flange: Rotation3<f64>,
}

/// Rotation from the rod to the flange, as rotations about z, y and z. The middle rotation is about y, because the middle
/// links of the bar rotate about y of the previous link.
fn zyz(first: f64, second: f64, third: f64) -> Rotation3<f64> {
    let about = |axis: &Vector3<f64>, angle: f64| Rotation3::new(axis * angle);
    about(&Vector3::z(), first) * about(&Vector3::y(), second) * about(&Vector3::z(), third)
}

fn circles(sweep: Sweep, length: f64, random: &mut ChaCha8Rng) -> Curve {
    const TURNS: f64 = 1.5;
    let count = (length / TURNS) as usize + 3;
    let circles: Vec<Circle> = (0..count)
        .map(|_| {
            let share = std::array::from_fn(|_| random.random_range(-0.8..0.8));
            let [b1, b2, b3, b4, b5] = sweep.at(share);
            let radius = random.random_range(0.4..0.9);
            Circle {
                middle: [0, 1].map(|joint| sweep.middle[joint] + 0.3 * sweep.half[joint] * share[joint]),
                half: [0, 1].map(|joint| radius * sweep.half[joint] * random.random_range(0.85..1.15)),
                world_from_flange: zyz(b1, b2, 0.0) * zyz(b3, b4, b5),
            }
        })
        .collect();
    let wobble = phases(random);
    Box::new(move |at| {
        let turn = (at / (TAU * TURNS)).clamp(0.0, (count - 2) as f64);
        let (one, next) = (circles[turn as usize], circles[turn as usize + 1]);
        // Each circle changes gradually into the next one, so no two laps are equal.
        let part = smooth(turn.fract());
        let mix = |from: f64, to: f64| from + (to - from) * part;
        // A motion by hand is irregular: the radius varies by some percent.
        let hand = 1.0 + 0.04 * (2.3 * at + wobble[0]).sin() + 0.03 * (3.7 * at + wobble[1]).sin();
        let b1 = mix(one.middle[0], next.middle[0]) + hand * mix(one.half[0], next.half[0]) * at.cos();
        let b2 = mix(one.middle[1], next.middle[1]) + hand * mix(one.half[1], next.half[1]) * at.sin();
        let flange = one.world_from_flange.slerp(&next.world_from_flange, part);
        let [b3, b4, b5] = cardan(&(zyz(b1, b2, 0.0).transpose() * flange).into_inner(), &sweep.middle);
        [b1, b2, b3, b4, b5]
    })
}

/// Angles of joints 3 to 5 that rotate the frame of the rod into the frame of the flange. If there are several solutions,
/// the one nearest to `middle` is returned.
fn cardan(rod_from_flange: &Matrix3<f64>, middle: &[f64; 5]) -> [f64; 3] {
    let m = rod_from_flange;
    let side = middle[3].signum();
    let near = |angle: f64, middle: f64| angle - ((angle - middle) / TAU).round() * TAU;
    let b4 = side * (m[(0, 2)].hypot(m[(1, 2)])).atan2(m[(2, 2)]);
    let b3 = (side * m[(1, 2)]).atan2(side * m[(0, 2)]);
    let b5 = (side * m[(2, 1)]).atan2(-side * m[(2, 0)]);
    [near(b3, middle[2]), b4, near(b5, middle[4])]
}

/// Rises from 0 to 1. Speed, acceleration and jerk are zero at both ends.
fn smooth(x: f64) -> f64 {
    x.powi(4) * (35.0 - 84.0 * x + 70.0 * x.powi(2) - 20.0 * x.powi(3))
}

/// One move along the path.
#[derive(Debug, Clone, Copy)]
struct Move {
    start_s: f64,
    duration_s: f64,
    from: f64,
    speed: f64,
}

impl Move {
    /// Time to reach full speed \[s\].
    fn ramp_s(&self) -> f64 {
        (self.duration_s / 2.0).min(1.5)
    }

    /// Distance after this time, relative to a full speed of 1. During a ramp, the speed rises as 3x^2 - 2x^3.
    fn way(&self, time_s: f64) -> f64 {
        let ramp_s = self.ramp_s();
        let of_ramp = |time_s: f64| {
            let x = time_s / ramp_s;
            ramp_s * (x.powi(3) - x.powi(4) / 2.0)
        };
        let time_s = time_s.clamp(0.0, self.duration_s);
        let left_s = self.duration_s - time_s;
        if time_s < ramp_s {
            of_ramp(time_s)
        } else if left_s < ramp_s {
            self.duration_s - ramp_s - of_ramp(left_s)
        } else {
            time_s - ramp_s / 2.0
        }
    }
}

/// The path coordinate as a function of time: moves with rests between them.
#[derive(Debug, Clone)]
pub struct Schedule {
    moves: Vec<Move>,
}

impl Schedule {
    /// A schedule of `duration_s`. It consists of one move, or of many short moves for
    /// [`Family::Bursts`], and has a rest at both ends.
    pub fn new(family: Family, duration_s: f64, speed: f64, random: &mut ChaCha8Rng) -> Self {
        let mut moves = Vec::new();
        let end_s = duration_s - random.random_range(1.0..2.5);
        let mut start_s = random.random_range(1.0..2.5);
        let mut from = 0.0;
        while start_s < end_s - 2.0 {
            let longest_s =
                if family == Family::Bursts { random.random_range(2.5..6.0) } else { f64::INFINITY };
            let one = Move { start_s, duration_s: f64::min(end_s - start_s, longest_s), from, speed };
            from += one.speed * one.way(one.duration_s);
            start_s += one.duration_s + random.random_range(4.0..14.0);
            moves.push(one);
        }
        Self { moves }
    }

    /// Path coordinate at this time.
    pub fn at(&self, time_s: f64) -> f64 {
        let index = self.moves.partition_point(|one| one.start_s <= time_s);
        let Some(one) = index.checked_sub(1).map(|index| &self.moves[index]) else { return 0.0 };
        one.from + one.speed * one.way(time_s - one.start_s)
    }

    /// Path coordinate at the end of the last move.
    pub fn length(&self) -> f64 {
        self.at(f64::MAX)
    }

    /// True if the robot is moving at this time.
    pub fn moves(&self, time_s: f64) -> bool {
        self.moves.iter().any(|one| (one.start_s..one.start_s + one.duration_s).contains(&time_s))
    }
}

/// Largest rotation of a joint that the cables permit \[rad\].
pub const CABLE_RAD: f64 = 2.0 * PI;
