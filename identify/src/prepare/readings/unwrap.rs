//! Counters and joints that begin anew are made continuous.

use std::borrow::Cow;
use std::f64::consts::{PI, TAU};

use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::bar_angles::{BarAngles, BarSegment};
use crate::logs::{RobotLog, Unwrapped, UnwrappedPoint, default_gap_limit_s};

/// Values of a terminal's counter.
const COUNTER_VALUES: f64 = 4_294_967_296.0;

/// The encoders whose 32-bit counters began anew between two samples, by the joints of the recording: what
/// [`bar_angles`](super::bar_angles::bar_angles()) followed.
pub fn unwrapped_counters(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    angles: &BarAngles,
) -> Vec<Unwrapped> {
    let first =
        angles.segments.first().and_then(|segment| segment.times.first().copied()).unwrap_or_default();
    let of_encoder = |(place, encoder): (usize, &EncoderInfo)| {
        let rad_per_count = encoder.scale.rad_per_count();
        let joint = usize::from(encoder.joint).checked_sub(1)?;
        let of_segment = |segment: &BarSegment| {
            let reading = |at: usize| UnwrappedPoint {
                t_s: segment.times[at].seconds_since(first),
                shown_rad: f64::from(cycles[segment.cycles[at]].encoders[place].count) * rad_per_count,
                continuous_rad: segment.angles_rad[at][joint],
            };
            let period_rad = COUNTER_VALUES * rad_per_count;
            Unwrapped::of(format!("b{}", encoder.joint), period_rad, segment.times.len(), reading)
        };
        Unwrapped::of_parts(angles.segments.iter().map(of_segment))
    };
    encoders.iter().enumerate().filter_map(of_encoder).collect()
}

/// The log with joints that begin anew after each turn made continuous, and what was done: a spline or an average across
/// such a jump would swing through the whole turn.
///
/// Of two rows more than half a turn apart the second is moved by whole turns until it is nearest to the first. Across a hole
/// nobody can tell whether the joint moved so far.
pub fn unwrapped_log(log: &RobotLog) -> (Cow<'_, RobotLog>, Vec<Unwrapped>) {
    let gap_s = default_gap_limit_s(log);
    // From the row before it to each row, joint by joint.
    let steps = |joint: usize| {
        let times = log.t_s.windows(2).map(move |pair| pair[1] - pair[0] <= gap_s);
        let steps = log.q_rad.windows(2).map(move |pair| pair[1][joint] - pair[0][joint]);
        times.zip(steps).map(|(follows, step_rad)| if follows { step_rad } else { 0.0 })
    };
    let jumps = |joint: &usize| steps(*joint).any(|step_rad| step_rad.abs() > PI);
    let joints: Vec<usize> = (0..log.axes()).filter(jumps).collect();
    if joints.is_empty() {
        return (Cow::Borrowed(log), Vec::new());
    }
    let mut continuous = log.clone();
    for &joint in &joints {
        let mut turns = 0.0;
        for (step_rad, q) in steps(joint).zip(continuous.q_rad.iter_mut().skip(1)) {
            turns -= (step_rad / TAU).round();
            q[joint] += turns * TAU;
        }
    }
    let of_joint = |&joint: &usize| {
        let reading = |at: usize| UnwrappedPoint {
            t_s: log.t_s[at],
            shown_rad: log.q_rad[at][joint],
            continuous_rad: continuous.q_rad[at][joint],
        };
        Unwrapped::of(format!("q{}", joint + 1), TAU, log.t_s.len().min(log.q_rad.len()), reading)
    };
    let unwrapped = joints.iter().filter_map(of_joint).collect();
    (Cow::Owned(continuous), unwrapped)
}
