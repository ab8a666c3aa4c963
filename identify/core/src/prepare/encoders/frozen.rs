//! An encoder with constant readings while the others move: no geometry fits it, and a fit would blame another part.

use crate::kinematics::BAR_JOINTS;
use crate::logs::Stream;
use crate::prepare::{BarReading, PrepareError};

/// Shortest time of constant readings \[s\]; shorter ones are turning points.
const FROZEN_S_MIN: f64 = 1.0;
/// Constant readings at the end of the log are not followed by a step. They are then an error only if the encoder changes in at
/// least this share of the other readings: that of a joint that rests through a motion does not.
const CHANGES_MIN: f64 = 0.9;

/// The error of the first encoder whose readings are constant while others move; `None` without one.
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
