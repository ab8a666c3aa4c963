//! Joints over time, thinned to what a figure shows.

use std::ops::Range;

use shared::recording::schema::{CycleRecord, EncoderInfo};

use crate::kinematics::BAR_JOINTS;
use crate::logs::{RobotLog, Row, Stream};
use crate::prepare::{BarAngles, bar_angles};

/// Columns of a figure, about.
const COLUMNS: f64 = 400.0;
/// Rows further apart than this number of usual steps, and than a column, have a gap between them.
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
    let Ok(BarAngles { measured, readings, .. }) = bar_angles(cycles, encoders) else { return Vec::new() };
    curves('b', &readings, (0..BAR_JOINTS).filter(|joint| measured[*joint]))
}

/// The joints of a robot's log; time counts from its first stamp.
pub fn of_robot(log: &RobotLog) -> Vec<Curve> {
    curves('q', &log.q_rad, 0..log.axes())
}

/// Of each column of a part without holes the first, lowest, highest and last angle.
fn curves<R: Row>(prefix: char, rows: &Stream<R>, joints: impl Iterator<Item = usize>) -> Vec<Curve> {
    let span_s = rows.duration_s();
    let column_s = span_s / COLUMNS;
    let parts = rows.parts_within(column_s.max(HOLE_STEPS * span_s / rows.len().max(1) as f64));
    let column = |row: usize| if column_s > 0.0 { (rows.t_s[row] / column_s).floor() } else { 0.0 };
    let curve = |joint: usize| {
        let angle_rad = |row: usize| rows[row].numbers()[joint];
        let of_column = |within: &[usize]| {
            let by_angle = |a: &&usize, b: &&usize| angle_rad(**a).total_cmp(&angle_rad(**b));
            let lowest_highest = [within.iter().min_by(by_angle), within.iter().max_by(by_angle)];
            let ends = [within.first(), within.last()];
            let mut kept: Vec<usize> = ends.into_iter().chain(lowest_highest).flatten().copied().collect();
            kept.sort_unstable();
            kept.dedup();
            kept.into_iter().map(|row| (rows.t_s[row], angle_rad(row).to_degrees())).collect::<Vec<_>>()
        };
        let thinned = |part: &Range<usize>| {
            let places: Vec<usize> = part.clone().collect();
            places.chunk_by(|a, b| column(*a) == column(*b)).flat_map(of_column).collect()
        };
        Curve { name: format!("{prefix}{}", joint + 1), parts: parts.iter().map(thinned).collect() }
    };
    joints.map(curve).collect()
}
