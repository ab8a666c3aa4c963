//! Speeds on a uniform grid, without signs or directions: what two logs can be compared by before anything is known.

use super::find::Raw;
use super::predict::Predictor;
use crate::kinematics::BAR_JOINTS;
use crate::logs::CubicSpline;
use crate::prepare::Channels;
use crate::prepare::encoders::circular::wrapped;

/// Finest step of the grid \[s\].
const STEP_S: f64 = 0.01;
/// Grid points that the robot's log takes at most.
const GRID_MAX: f64 = 1e6;
/// Speeds are differences over this many steps to either side: noise of the readings is divided by their time.
pub(in crate::prepare) const REACH: usize = 2;
/// Bar samples further apart are not bridged \[s\].
const GAP_LIMIT_S: f64 = 0.05;
/// Faster than a bar ever turns \[rad/s\]: a jump of the counters or of the robot's log.
const SPEED_RAD_S_MAX: f64 = 4.0;

/// Angle at each grid point, or none where it is not known.
type Angles = Vec<Option<[f64; BAR_JOINTS]>>;

/// Measured speeds of `joints` (from 0), from the first sample on, at least every `step_s`.
pub(in crate::prepare) fn measured_speeds(samples: &[Raw], joints: &[usize], step_s: f64) -> Channels {
    let (Some(first), Some(last)) = (samples.first(), samples.last()) else {
        return Channels { known: Vec::new(), values: vec![Vec::new(); joints.len()] };
    };
    let steps = ((last.t_s - first.t_s) / step_s) as usize + 1;
    let mut angles: Angles = vec![None; steps];
    for of_origin in samples.chunk_by(|a, b| a.origin == b.origin) {
        let t_s: Vec<f64> = of_origin.iter().map(|raw| raw.t_s - first.t_s).collect();
        let values: Vec<[f64; BAR_JOINTS]> = of_origin.iter().map(|raw| raw.recorded_rad).collect();
        let Some(spline) = CubicSpline::new(&t_s, &values, GAP_LIMIT_S) else { continue };
        let (from_s, to_s) = spline.range_s();
        let grid = (from_s / step_s).ceil() as usize..=(to_s / step_s) as usize;
        for step in grid {
            if let Some(slot) = angles.get_mut(step) {
                *slot = spline.at(step as f64 * step_s).map(|point| point.value);
            }
        }
    }
    of_joints(&angles, joints, step_s)
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
    let angles: Angles = (0..steps)
        .map(|step| predictor.at(step as f64 * step_s))
        .map(|bar| bar.filter(|bar| bar.margin_rad > margin_rad).map(|bar| bar.joints_rad))
        .collect();
    of_joints(&angles, joints, step_s)
}

fn of_joints(angles: &Angles, joints: &[usize], step_s: f64) -> Channels {
    let apart = |before: &[f64; BAR_JOINTS], after: &[f64; BAR_JOINTS], channel: usize| {
        wrapped(after[joints[channel]] - before[joints[channel]]).abs()
    };
    speeds(angles, joints.len(), REACH, step_s, SPEED_RAD_S_MAX, apart)
}

/// Speeds of points on a grid, in so many channels, from `reach` steps before to as many after: `apart` says how far two points
/// are in each. Unknown where a point is, or a speed is more than `most`.
pub(in crate::prepare) fn speeds<T>(
    points: &[Option<T>],
    channels: usize,
    reach: usize,
    step_s: f64,
    most: f64,
    apart: impl Fn(&T, &T, usize) -> f64,
) -> Channels {
    let mut found =
        Channels { known: vec![false; points.len()], values: vec![vec![0.0; points.len()]; channels] };
    for step in reach..points.len().saturating_sub(reach) {
        let around = (&points[step - reach], &points[step + reach]);
        let (Some(before), Some(after)) = around else { continue };
        let speed = |channel: usize| apart(before, after, channel) / (2.0 * reach as f64 * step_s);
        if (0..channels).any(|channel| speed(channel) > most) {
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
    let sum = |step: usize| channels.values.iter().map(|values| values[step].powi(2)).sum::<f64>().sqrt();
    Channels { known: channels.known.clone(), values: vec![(0..channels.known.len()).map(sum).collect()] }
}
