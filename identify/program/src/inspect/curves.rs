//! Joint positions over time for the page of a refusal, thinned to the points that a figure can show.

use std::ops::Range;

use shared::config::{JointKind, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use crate::kinematics::BAR_JOINTS;
use crate::logs::{RobotLog, Row, Stream};
use crate::prepare::{BarAngles, bar_angles};

/// Approximate number of pixel columns of a figure.
const COLUMNS: f64 = 400.0;
/// There is a gap between two rows if the time between them is longer than a column and longer than this
/// number of mean steps.
const HOLE_STEPS: f64 = 10.0;

/// One joint over time.
#[derive(Debug, Clone, PartialEq)]
pub struct JointTrace {
    /// Name of the joint, such as `b1` or `q1`.
    pub name: String,
    /// Unit of the values, `deg` or `mm`.
    pub unit: &'static str,
    /// Parts without gaps, in the order of time. A point is the time after the first row \[s\] and the value.
    pub parts: Vec<Vec<(f64, f64)>>,
}

/// Curves of the recorded encoders, from their counters. Each part between two changes of the counters' origin begins near
/// zero. Empty if the cycles cannot be used. Times count from the first valid cycle.
pub fn of_bar(cycles: &[CycleRecord], encoders: &[EncoderInfo]) -> Vec<JointTrace> {
    let Ok(BarAngles { measured, readings, .. }) = bar_angles(cycles, encoders) else { return Vec::new() };
    let measured = (0..BAR_JOINTS).filter(|joint| measured[*joint]);
    curves('b', &readings, measured.map(|joint| (joint, JointKind::Revolute)))
}

/// Curves of the joints of a robot's log. Times count from its first stamp.
pub fn of_robot(log: &RobotLog, robot: &RobotConfig) -> Vec<JointTrace> {
    curves('q', &log.q_rad, (0..log.axes()).zip(robot.joint_kinds()))
}

/// One curve for each joint. Each part without gaps is thinned to the points that a figure needs.
fn curves<R: Row>(
    prefix: char,
    rows: &Stream<R>,
    joints: impl Iterator<Item = (usize, JointKind)>,
) -> Vec<JointTrace> {
    let span_s = rows.duration_s();
    let column_s = (span_s / COLUMNS).max(f64::MIN_POSITIVE);
    let parts = rows.parts_within(column_s.max(HOLE_STEPS * span_s / rows.len().max(1) as f64));
    let curve = |(joint, kind): (usize, JointKind)| {
        let point = |row: usize| (rows.t_s[row], rows[row].numbers()[joint] * kind.display_factor());
        let thinned = |part: &Range<usize>| {
            let points: Vec<(f64, f64)> = part.clone().map(point).collect();
            extremes_of_columns(&points, |(t_s, _)| (t_s / column_s) as i64, |(_, value)| *value)
        };
        JointTrace {
            name: format!("{prefix}{}", joint + 1),
            unit: kind.display_symbol(),
            parts: parts.iter().map(thinned).collect(),
        }
    };
    joints.map(curve).collect()
}

/// Keeps the first, lowest, highest and last point of each column. A line through these points looks like a line
/// through all points (Jugel et al. 2014, "M4: a visualization-oriented time series data aggregation"). Points of the
/// same column must be consecutive.
pub(crate) fn extremes_of_columns<P: Copy>(
    points: &[P],
    column: impl Fn(&P) -> i64,
    height: impl Fn(&P) -> f64,
) -> Vec<P> {
    let mut kept = Vec::new();
    for within in points.chunk_by(|a, b| column(a) == column(b)) {
        let by_height = |a: &usize, b: &usize| height(&within[*a]).total_cmp(&height(&within[*b]));
        let [lowest, highest] = [(0..within.len()).min_by(by_height), (0..within.len()).max_by(by_height)]
            .map(Option::unwrap_or_default);
        let mut picked = [0, lowest, highest, within.len() - 1].to_vec();
        picked.sort_unstable();
        picked.dedup();
        kept.extend(picked.into_iter().map(|index| within[index]));
    }
    kept
}
