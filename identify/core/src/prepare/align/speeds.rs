//! Unsigned speeds on a uniform grid, `|x(t + h) - x(t - h)| / 2 h`, from the encoders (measured) or the robot's log (predicted).
//! They do not depend on offsets and signs: two logs can be correlated (`correlate`) before these are known.

use super::predict::Predictor;
use crate::kinematics::{BAR_JOINTS, wrapped};
use crate::logs::Stream;
use crate::prepare::{BarReading, Channels};
use crate::threads::rows;

/// Finest step of the grid \[s\].
const STEP_S: f64 = 0.01;
/// Largest number of grid points of the robot's log.
const GRID_MAX: f64 = 1e6;
/// Speeds are differences over this many steps to either side: noise of the readings is divided by their time.
pub(in crate::prepare) const REACH: usize = 2;
/// No bar turns faster \[rad/s\]: a higher speed is a jump of the counters or of the robot's log.
const SPEED_RAD_S_MAX: f64 = 4.0;

/// Angles at each grid point; `None` where they are not known.
type Angles = Vec<Option<[f64; BAR_JOINTS]>>;

/// Measured speeds of `joints` (from 0), from the first reading on, every `step_s` of a clock that is faster by `rate`.
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

/// Step of the grid for a robot's log of this length \[s\].
pub(in crate::prepare) fn grid_step_s(log_duration_s: f64) -> f64 {
    STEP_S.max(log_duration_s / GRID_MAX)
}

/// Predicted speeds, from the robot log's first stamp to `duration_s`. Unknown nearer to singular poses than
/// `margin_rad`, where errors of the nominal geometry are amplified.
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

/// Speeds of points on a grid, in a number of channels, from `reach` steps before to as many after; `distance` is that of two
/// points in a channel. A speed is unknown if one of its points is, or if it is more than `speed_max`.
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

/// All channels as one, the root of the sum of their squares: the same whichever encoder is called which.
pub(in crate::prepare) fn without_order(channels: &Channels) -> Channels {
    let root = |step: usize| channels.values.iter().map(|values| values[step].powi(2)).sum::<f64>().sqrt();
    Channels { known: channels.known.clone(), values: vec![(0..channels.known.len()).map(root).collect()] }
}
