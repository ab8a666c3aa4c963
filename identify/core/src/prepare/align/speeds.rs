//! Computes unsigned speeds on a uniform time grid: `|x(t + h) - x(t - h)| / 2 h`.
//!
//! The input is either the encoder readings, which give the *measured* speeds, or the robot's log, which gives the
//! *predicted* speeds. Unsigned speeds do not depend on offsets and signs. Two logs can therefore be correlated
//! (`correlate`) before offsets and signs are known.

use super::predict::Predictor;
use crate::kinematics::{BAR_JOINTS, wrapped};
use crate::logs::Stream;
use crate::prepare::{BarReading, Channels};
use crate::threads::rows;

/// Finest step of the grid \[s\].
const STEP_S: f64 = 0.01;
/// Largest number of grid points for the robot's log.
const GRID_MAX: f64 = 1e6;
/// The speed at a grid point is computed from the points this number of steps before and after it. A larger number reduces
/// the effect of noise in the readings.
pub(in crate::prepare) const REACH: usize = 2;
/// Largest speed of a bar joint \[rad/s\]. A higher speed means that the counters or the robot's log jump.
const SPEED_RAD_S_MAX: f64 = 4.0;

/// Joint angles at each grid point; `None` if they are unknown there.
type Angles = Vec<Option<[f64; BAR_JOINTS]>>;

/// Measured speeds of `joints` (counted from 0), starting at the first reading. The grid step is `step_s` on a clock that
/// runs `1 + rate` times as fast as the clock of the recording.
pub(in crate::prepare) fn measured_speeds(
    readings: &Stream<BarReading>,
    joints: &[usize],
    step_s: f64,
    rate: f64,
) -> Channels {
    let bar_step_s = step_s / (1.0 + rate);
    let steps = if readings.is_empty() { 0 } else { (readings.duration_s() / bar_step_s) as usize + 1 };
    let spline = readings.clone().spline();
    let angle = |step: usize| Some(spline.as_ref()?.at(step as f64 * bar_step_s)?.value.recorded_rad);
    let angles: Angles = (0..steps).map(angle).collect();
    speeds_of_joints(&angles, joints, step_s)
}

/// Step of the grid for a robot's log with this duration \[s\].
pub(in crate::prepare) fn grid_step_s(log_duration_s: f64) -> f64 {
    STEP_S.max(log_duration_s / GRID_MAX)
}

/// Predicted speeds, from the first stamp of the robot's log until `duration_s`. A speed is unknown at poses nearer to a
/// singular pose than `margin_rad`, because errors of the nominal geometry are amplified there.
pub(in crate::prepare) fn predicted_speeds(
    predictor: &Predictor<'_>,
    duration_s: f64,
    joints: &[usize],
    margin_rad: f64,
    step_s: f64,
) -> Channels {
    let steps = (duration_s / step_s) as usize + 1;
    let angles: Angles = rows(steps, |step| {
        let bar = predictor.at(step as f64 * step_s);
        bar.filter(|bar| bar.margin_rad > margin_rad).map(|bar| bar.joints_rad)
    });
    speeds_of_joints(&angles, joints, step_s)
}

fn speeds_of_joints(angles: &Angles, joints: &[usize], step_s: f64) -> Channels {
    let turned = |before: &[f64; BAR_JOINTS], after: &[f64; BAR_JOINTS], channel: usize| {
        wrapped(after[joints[channel]] - before[joints[channel]]).abs()
    };
    speeds(angles, joints.len(), REACH, step_s, SPEED_RAD_S_MAX, turned)
}

/// Speeds of points on a grid, in a number of channels. The speed at a grid point is computed from the points `reach` steps
/// before and after it; `distance` returns the distance of two points in a channel. The speeds of all channels are unknown
/// if one of the two points is unknown, or if a speed exceeds `speed_max`.
pub(in crate::prepare) fn speeds<T>(
    points: &[Option<T>],
    channels: usize,
    reach: usize,
    step_s: f64,
    speed_max: f64,
    distance: impl Fn(&T, &T, usize) -> f64,
) -> Channels {
    let mut found =
        Channels { known: vec![false; points.len()], values: vec![vec![0.0; points.len()]; channels] };
    for step in reach..points.len().saturating_sub(reach) {
        let around = (&points[step - reach], &points[step + reach]);
        let (Some(before), Some(after)) = around else { continue };
        let speed = |channel: usize| distance(before, after, channel) / (2.0 * reach as f64 * step_s);
        if (0..channels).any(|channel| speed(channel) > speed_max) {
            continue;
        }
        found.known[step] = true;
        for (channel, values) in found.values.iter_mut().enumerate() {
            values[step] = speed(channel);
        }
    }
    found
}

/// Combines all channels into one, the root of the sum of their squares. The result does not depend on the
/// order of the encoders.
pub(in crate::prepare) fn without_order(channels: &Channels) -> Channels {
    let root = |step: usize| channels.values.iter().map(|values| values[step].powi(2)).sum::<f64>().sqrt();
    Channels { known: channels.known.clone(), values: vec![(0..channels.known.len()).map(root).collect()] }
}
