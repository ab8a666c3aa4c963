//! Makes the readings of counters and robot joints continuous if they wrap, and describes the wraps for reports.

use std::borrow::Cow;
use std::f64::consts::TAU;
use std::ops::Range;

use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::bar_angles::{BarAngles, BarReading};
use crate::logs::{RobotLog, Unwrapped, UnwrappedPoint};

/// Number of values of a terminal's 32-bit counter.
const COUNTER_VALUES: f64 = 4_294_967_296.0;

/// Describes the encoders whose counters wrapped between two samples, by recorded joint. `angles` is the result of
/// [`bar_angles`](super::bar_angles::bar_angles()) for these cycles.
pub fn unwrapped_counters(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    angles: &BarAngles,
) -> Vec<Unwrapped> {
    let readings = &angles.readings;
    let of_encoder = |(place, encoder): (usize, &EncoderInfo)| {
        let rad_per_count = encoder.scale.rad_per_count();
        let joint = usize::from(encoder.joint).checked_sub(1)?;
        let of_origin = |part: Range<usize>| {
            let reading = |at: usize| {
                let BarReading { cycle, recorded_rad, .. } = readings[part.start + at];
                UnwrappedPoint {
                    t_s: readings.t_s[part.start + at],
                    shown_rad: f64::from(cycles[cycle].encoders[place].count) * rad_per_count,
                    continuous_rad: recorded_rad[joint],
                }
            };
            let period_rad = COUNTER_VALUES * rad_per_count;
            Unwrapped::find(format!("b{}", encoder.joint), period_rad, part.len(), reading)
        };
        Unwrapped::of_parts(readings.parts_within(f64::INFINITY).into_iter().map(of_origin))
    };
    encoders.iter().enumerate().filter_map(of_encoder).collect()
}

/// Makes the angles of joints continuous if they wrap after each turn. Returns the log and a description of the joints that
/// wrapped. Without this step, a spline or an average across a wrap would pass through a whole turn.
pub fn unwrapped_log(log: &RobotLog) -> (Cow<'_, RobotLog>, Vec<Unwrapped>) {
    let Cow::Owned(q_rad) = log.q_rad.unwrapped(TAU) else { return (Cow::Borrowed(log), Vec::new()) };
    let has_wrapped = |joint: &usize| q_rad.iter().zip(log.q_rad.iter()).any(|(a, b)| a[*joint] != b[*joint]);
    let of_joint = |joint: usize| {
        let reading = |row: usize| UnwrappedPoint {
            t_s: q_rad.t_s[row],
            shown_rad: log.q_rad[row][joint],
            continuous_rad: q_rad[row][joint],
        };
        Unwrapped::find(format!("q{}", joint + 1), TAU, q_rad.len(), reading)
    };
    let unwrapped = (0..log.axes()).filter(has_wrapped).filter_map(of_joint).collect();
    (Cow::Owned(RobotLog { q_rad: q_rad.into(), ..log.clone() }), unwrapped)
}
