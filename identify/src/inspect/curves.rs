//! Joints over time, thinned to what a figure shows.

use shared::recording::schema::{CycleRecord, EncoderInfo};

use crate::kinematics::BAR_JOINTS;
use crate::logs::RobotLog;
use crate::prepare::{BarAngles, bar_angles};

/// Columns of a figure, about.
const COLUMNS: f64 = 400.0;
/// Rows further apart than so many usual steps, and than a column, have a hole between them.
const HOLE_STEPS: f64 = 10.0;

/// One joint over time.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// Such as `b1` or `q1`.
    pub name: String,
    /// Parts without holes, in the order of time: time after the first row \[s\] and angle \[deg\].
    pub parts: Vec<Vec<(f64, f64)>>,
}

/// The recorded encoders, by their counters alone: each part between two changes of the origin begins near zero. Nothing
/// where the cycles cannot be used at all; time counts from the first valid cycle.
pub fn of_bar(cycles: &[CycleRecord], encoders: &[EncoderInfo]) -> Vec<Curve> {
    let Ok(BarAngles { measured, segments, .. }) = bar_angles(cycles, encoders) else { return Vec::new() };
    let Some(first) = segments.first().and_then(|segment| segment.times.first()).copied() else {
        return Vec::new();
    };
    let times_s: Vec<Vec<f64>> = segments
        .iter()
        .map(|segment| segment.times.iter().map(|time| time.seconds_since(first)).collect())
        .collect();
    let steps = Steps::of(&times_s);
    let curve = |joint: usize| Curve {
        name: format!("b{}", joint + 1),
        parts: (times_s.iter().zip(&segments))
            .flat_map(|(t_s, segment)| steps.parts(t_s, |row| segment.angles_rad[row][joint]))
            .collect(),
    };
    (0..BAR_JOINTS).filter(|joint| measured[*joint]).map(curve).collect()
}

/// The joints of a robot's log; time counts from its first stamp.
pub fn of_robot(log: &RobotLog) -> Vec<Curve> {
    let steps = Steps::of(std::slice::from_ref(&log.t_s));
    let curve = |joint: usize| Curve {
        name: format!("q{}", joint + 1),
        parts: steps.parts(&log.t_s, |row| log.q_rad[row][joint]),
    };
    (0..log.axes()).map(curve).collect()
}

/// Which steps of time matter to a figure \[s\].
struct Steps {
    column_s: f64,
    hole_s: f64,
}

impl Steps {
    fn of(times_s: &[Vec<f64>]) -> Self {
        let ends = times_s.iter().flatten().next().zip(times_s.iter().flatten().next_back());
        let span_s = ends.map_or(0.0, |(first, last)| last - first);
        let rows: usize = times_s.iter().map(Vec::len).sum();
        let column_s = span_s / COLUMNS;
        Self { column_s, hole_s: column_s.max(HOLE_STEPS * span_s / rows.max(1) as f64) }
    }

    /// Parts without holes; of each column of a part the first, lowest, highest and last angle.
    fn parts(&self, t_s: &[f64], angle_rad: impl Fn(usize) -> f64) -> Vec<Vec<(f64, f64)>> {
        let rows: Vec<usize> = (0..t_s.len()).collect();
        let angle_rad = &angle_rad;
        let of_column = |rows: &[usize]| {
            let by_angle = |a: &&usize, b: &&usize| angle_rad(**a).total_cmp(&angle_rad(**b));
            let lowest_highest = [rows.iter().min_by(by_angle), rows.iter().max_by(by_angle)];
            let mut kept: Vec<usize> =
                [rows.first(), rows.last()].into_iter().chain(lowest_highest).flatten().copied().collect();
            kept.sort_unstable();
            kept.dedup();
            kept.into_iter().map(|row| (t_s[row], angle_rad(row).to_degrees())).collect::<Vec<_>>()
        };
        let column = |row: usize| if self.column_s > 0.0 { (t_s[row] / self.column_s).floor() } else { 0.0 };
        rows.chunk_by(|a, b| t_s[*b] - t_s[*a] <= self.hole_s)
            .map(|part| part.chunk_by(|a, b| column(*a) == column(*b)).flat_map(of_column).collect())
            .collect()
    }
}
