//! Finds standstills, and the jitter of bar and robot angles in them, for reports.
//!
//! The input is the readings at which neither robot nor bar moves. Readings without a gap between them form a
//! standstill, if they last long enough. The jitter is the standard deviation of the angles about a straight line, which
//! is fitted to each standstill.

use serde::Serialize;

use crate::kinematics::{BAR_JOINTS, Joints};

/// A joint with a lower speed is at standstill \[rad/s\]. Speeds are computed over 0.1 s, so noise of 75 urad causes
/// speeds below this limit.
pub const MOVING_RAD_S: f64 = 3e-3;
/// Shortest standstill \[s\]. Shorter ones are turning points of the motion.
const DURATION_S_MIN: f64 = 0.4;
/// Longest time between two readings of the same standstill \[s\].
const BREAK_S: f64 = 0.05;
/// Readings nearer than this to an end of a standstill are not used for the jitter, because the motion ends
/// and begins there \[s\].
const EDGE_S: f64 = 0.1;
/// Smallest number of readings of a standstill that is used for the jitter.
const READINGS_MIN: usize = 10;

/// An interval of time in which neither robot nor bar moves.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Standstill {
    /// First instant, as bar time since the reference time \[s\].
    pub from_s: f64,
    /// Last instant, as bar time since the reference time \[s\].
    pub to_s: f64,
}

impl Standstill {
    /// Duration of the standstill \[s\].
    pub fn duration_s(&self) -> f64 {
        self.to_s - self.from_s
    }
}

/// Standard deviation of the readings at standstill. The deviations are taken about a straight line through each standstill,
/// and combined over all standstills. `None` without encoder, or if no standstill is long enough.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Jitter {
    /// Jitter of each bar encoder \[urad\].
    pub bar_urad: [Option<f64>; BAR_JOINTS],
    /// Jitter of each robot joint, at the bar's sample times \[urad\].
    pub robot_urad: Vec<Option<f64>>,
}

/// Readings at one instant.
#[derive(Debug, Clone, Copy)]
pub(in crate::prepare) struct Readings {
    /// Bar time \[s\].
    pub t_s: f64,
    /// Bar joints \[rad\].
    pub bar_rad: [f64; BAR_JOINTS],
    /// Robot joints \[rad\].
    pub robot_rad: Joints,
}

/// Finds the standstills and the jitter in them. `still` are the readings at which neither robot nor bar moves, in
/// the order of time.
pub(in crate::prepare) fn standstills(
    still: &[Readings],
    measured: &[bool; BAR_JOINTS],
) -> (Vec<Standstill>, Jitter) {
    let mut found = Vec::new();
    let mut bar = [SquaredDeviations::default(); BAR_JOINTS];
    let mut robot =
        vec![SquaredDeviations::default(); still.first().map_or(0, |reading| reading.robot_rad.len())];
    for segment in still.chunk_by(|a, b| b.t_s - a.t_s < BREAK_S) {
        let (Some(first), Some(last)) = (segment.first(), segment.last()) else { continue };
        let standstill = Standstill { from_s: first.t_s, to_s: last.t_s };
        if standstill.duration_s() < DURATION_S_MIN {
            continue;
        }
        found.push(standstill);
        let within = |reading: &&Readings| {
            reading.t_s > standstill.from_s + EDGE_S && reading.t_s < standstill.to_s - EDGE_S
        };
        let inner: Vec<&Readings> = segment.iter().filter(within).collect();
        for (joint, spread) in bar.iter_mut().enumerate() {
            spread.add(inner.iter().map(|reading| (reading.t_s, reading.bar_rad[joint])));
        }
        for (joint, spread) in robot.iter_mut().enumerate() {
            spread.add(inner.iter().map(|reading| (reading.t_s, reading.robot_rad[joint])));
        }
    }
    let mut bar_urad = bar.map(|spread| spread.deviation_urad());
    for (deviation, measured) in bar_urad.iter_mut().zip(measured) {
        *deviation = deviation.filter(|_| *measured);
    }
    (
        found,
        Jitter { bar_urad, robot_urad: robot.into_iter().map(SquaredDeviations::deviation_urad).collect() },
    )
}

/// Sum of the squared deviations from straight lines, and the number of degrees of freedom of this sum.
#[derive(Debug, Clone, Copy, Default)]
struct SquaredDeviations {
    squares: f64,
    degrees_of_freedom: usize,
}

impl SquaredDeviations {
    /// Adds the times and angles `x` of one standstill. The deviations are taken about a straight line, because a robot that
    /// comes to rest drifts. The line has two parameters, so a standstill with `n` readings adds `n - 2` degrees of freedom.
    /// A standstill with too few readings is ignored.
    fn add(&mut self, readings: impl Iterator<Item = (f64, f64)> + Clone) {
        let count = readings.clone().count();
        if count < READINGS_MIN {
            return;
        }
        let n = count as f64;
        let (mut t_mean, mut x_mean) = (0.0, 0.0);
        for (t, x) in readings.clone() {
            t_mean += t / n;
            x_mean += x / n;
        }
        let (mut sum_tt, mut sum_tx, mut sum_xx) = (0.0, 0.0, 0.0);
        for (t, x) in readings {
            let (t, x) = (t - t_mean, x - x_mean);
            sum_tt += t * t;
            sum_tx += t * x;
            sum_xx += x * x;
        }
        self.squares += (sum_xx - sum_tx * sum_tx / sum_tt.max(f64::MIN_POSITIVE)).max(0.0);
        self.degrees_of_freedom += count - 2;
    }

    /// Standard deviation \[urad\]; `None` without degrees of freedom.
    fn deviation_urad(self) -> Option<f64> {
        (self.degrees_of_freedom > 0).then(|| (self.squares / self.degrees_of_freedom as f64).sqrt() * 1e6)
    }
}
