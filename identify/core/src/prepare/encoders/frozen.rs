//! Finds an encoder whose readings are constant while others change. No geometry fits such readings, and a fit would
//! attribute the error to another cause.

use crate::kinematics::BAR_JOINTS;
use crate::logs::Stream;
use crate::prepare::{BarReading, PrepareError};

/// Shortest time of constant readings that is an error \[s\]. Shorter times are turning points of the motion.
const FROZEN_S_MIN: f64 = 1.0;
/// Constant readings at the end of the log are not followed by a step that would prove an error. They are only an error
/// if the encoder changes in more than this fraction of its other readings. The encoder of a joint that often rests
/// changes in fewer readings.
const CHANGES_MIN: f64 = 0.9;

/// Returns the error of the first encoder whose readings are constant while others change; `None` if there is no such encoder.
pub(in crate::prepare) fn constant_encoder(
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
    let constant_parts = readings.constant_ranges(is_long, changes);
    constant_parts.into_iter().enumerate().filter(|(joint, _)| measured[*joint]).find_map(|(joint, part)| {
        let part = part?;
        let (from_s, to_s) = (readings.t_s[part.start], readings.t_s[part.end - 1]);
        Some(PrepareError::EncoderFrozen { joint: joint as u8 + 1, from_s, to_s })
    })
}
