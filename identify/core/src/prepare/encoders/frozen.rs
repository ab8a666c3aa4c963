//! An encoder with constant readings while the others move: no geometry fits it, and a fit would blame another part.

use crate::kinematics::BAR_JOINTS;
use crate::logs::Stream;
use crate::prepare::{BarReading, PrepareError};

/// Shorter ones are turning points \[s\].
const FROZEN_S_MIN: f64 = 1.0;
/// Constant readings up to the end of the log have no leap behind them. The encoder is dead only if it changes in at least this share
/// of the other readings: a joint that rests through a motion does not.
const CHANGES_MIN: f64 = 0.9;

/// The first encoder that is constant for a while.
pub(in crate::prepare) fn frozen(
    readings: &Stream<BarReading>,
    measured: &[bool; BAR_JOINTS],
) -> Option<PrepareError> {
    let is_long =
        |part: &std::ops::Range<usize>| readings.t_s[part.end - 1] - readings.t_s[part.start] >= FROZEN_S_MIN;
    let changes = |joint: usize, part: &std::ops::Range<usize>| {
        let differ = |pair: &&[BarReading]| pair[0].recorded_rad[joint] != pair[1].recorded_rad[joint];
        let changes = readings.windows(2).filter(differ).count();
        changes as f64 > CHANGES_MIN * (readings.len() - part.len()) as f64
    };
    let of_joints = readings.frozen(is_long, changes).into_iter().zip(measured).enumerate();
    of_joints.filter(|(_, (_, measured))| **measured).find_map(|(joint, (part, _))| {
        let part = part?;
        let (from_s, to_s) = (readings.t_s[part.start], readings.t_s[part.end - 1]);
        Some(PrepareError::EncoderFrozen { joint: joint as u8 + 1, from_s, to_s })
    })
}
