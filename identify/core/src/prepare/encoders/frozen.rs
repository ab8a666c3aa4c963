//! An encoder that says the same while the others move: no geometry fits it, and whatever is fitted blames another part.

use crate::kinematics::BAR_JOINTS;
use crate::logs::Stream;
use crate::prepare::{BarReading, PrepareError};

/// Shorter ones are turning points \[s\].
const FROZEN_S_MIN: f64 = 1.0;
/// What never leaps, since the log ends, is dead only where it changes with so many of the other readings: a joint may stand through
/// a whole motion, but not in this one then.
const CHANGES_MIN: f64 = 0.9;

/// The first encoder that is dead for a while.
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
