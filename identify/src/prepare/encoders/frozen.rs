//! An encoder that says the same while the others move: no geometry fits it, and whatever is fitted blames another part.

use crate::kinematics::BAR_JOINTS;
use crate::logs::{Stream, ranges};
use crate::prepare::{BarReading, PrepareError};

/// Shorter ones are turning points \[s\].
const FROZEN_S_MIN: f64 = 1.0;
/// How far another joint moves meanwhile \[rad\].
const OTHERS_RAD: f64 = 0.1;
/// An encoder that stood goes on from where it stood, a dead one leaps to where its joint is by now \[rad\].
const LEAP_RAD: f64 = 0.02;
/// What never leaps, since the log ends, is dead only where it changes with so many of the other readings: a joint may stand through
/// a whole motion, but not in this one then.
const CHANGES_MIN: f64 = 0.9;

/// The first encoder that is dead for a while.
pub(in crate::prepare) fn frozen(
    readings: &Stream<BarReading>,
    measured: &[bool; BAR_JOINTS],
) -> Option<PrepareError> {
    let joints = || (0..BAR_JOINTS).filter(|joint| measured[*joint]);
    joints().find_map(|joint| {
        let differ = |pair: &&[BarReading]| pair[0].recorded_rad[joint] != pair[1].recorded_rad[joint];
        let changes = readings.windows(2).filter(differ).count();
        let mut first = 0;
        let same = |a: &BarReading, b: &BarReading| {
            a.origin == b.origin && a.recorded_rad[joint] == b.recorded_rad[joint]
        };
        readings.chunk_by(same).find_map(|part| {
            let (from, to) = (first, first + part.len());
            first = to;
            let (from_s, to_s) = (readings.t_s[from], readings.t_s[to - 1]);
            if to_s - from_s < FROZEN_S_MIN {
                return None;
            }
            let ranges = ranges(part);
            let moves = |other: usize| ranges[other][1] - ranges[other][0] > OTHERS_RAD;
            let leaps = match readings.get(to) {
                // Counters that started anew begin anywhere.
                Some(after) if after.origin != part[0].origin => false,
                Some(after) => (after.recorded_rad[joint] - part[0].recorded_rad[joint]).abs() > LEAP_RAD,
                None => changes as f64 > CHANGES_MIN * (readings.len() - part.len()) as f64,
            };
            let is_dead = leaps && joints().any(|other| other != joint && moves(other));
            is_dead.then_some(PrepareError::EncoderFrozen { joint: joint as u8 + 1, from_s, to_s })
        })
    })
}
