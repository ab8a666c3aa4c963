//! Joint speeds on a uniform grid, without signs: what both logs can be compared by before anything is known.

use std::f64::consts::TAU;

use super::predict::Predictor;
use super::{BarSegment, Channels};
use crate::kinematics::BAR_JOINTS;
use crate::logs::CubicSpline;

/// Step of the grid \[s\].
pub(super) const STEP_S: f64 = 0.01;
/// Speeds are differences over this many steps to either side: noise of the readings is divided by their time.
const REACH: usize = 2;
/// Bar samples further apart are not bridged \[s\].
const GAP_LIMIT_S: f64 = 0.05;

/// Angle at each grid point, or none where it is not known.
type Angles = Vec<Option<[f64; BAR_JOINTS]>>;

/// Measured speeds, from the segment's first sample on. None where the samples are too far apart.
pub(super) fn measured_speeds(segment: &BarSegment, measured: &[bool; BAR_JOINTS]) -> Option<Channels> {
    let first = *segment.times.first()?;
    let t_s: Vec<f64> = segment.times.iter().map(|time| time.seconds_since(first)).collect();
    let spline = CubicSpline::new(&t_s, &segment.angles_rad, GAP_LIMIT_S)?;
    let steps = (t_s.last()? / STEP_S) as usize + 1;
    let angles: Angles =
        (0..steps).map(|step| spline.at(step as f64 * STEP_S).map(|point| point.value)).collect();
    Some(speeds(&angles, measured))
}

/// Predicted speeds, from the robot log's first stamp to `duration_s`. Unknown nearer to singular poses than
/// `margin_rad`, where errors of the nominal geometry are amplified.
pub(super) fn predicted_speeds(
    predictor: &Predictor<'_>,
    duration_s: f64,
    measured: &[bool; BAR_JOINTS],
    margin_rad: f64,
) -> Channels {
    let steps = (duration_s / STEP_S) as usize + 1;
    let angles: Angles = (0..steps)
        .map(|step| predictor.at(step as f64 * STEP_S))
        .map(|bar| bar.filter(|bar| bar.margin_rad > margin_rad).map(|bar| bar.joints_rad))
        .collect();
    speeds(&angles, measured)
}

fn speeds(angles: &Angles, measured: &[bool; BAR_JOINTS]) -> Channels {
    let joints: Vec<usize> = (0..BAR_JOINTS).filter(|&joint| measured[joint]).collect();
    let mut channels =
        Channels { known: vec![false; angles.len()], values: vec![vec![0.0; angles.len()]; joints.len()] };
    for step in REACH..angles.len().saturating_sub(REACH) {
        let around = (&angles[step - REACH], &angles[step + REACH]);
        let (Some(before), Some(after)) = around else { continue };
        channels.known[step] = true;
        for (channel, &joint) in channels.values.iter_mut().zip(&joints) {
            let turned = after[joint] - before[joint];
            let turned = turned - (turned / TAU).round() * TAU;
            channel[step] = turned.abs() / (2.0 * REACH as f64 * STEP_S);
        }
    }
    channels
}
