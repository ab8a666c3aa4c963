//! Collects a summary of a run: its markers, and its invalid cycles with their reasons. The summary is stored at the end of
//! the recording. Hundreds of recordings can therefore be listed without reading them completely.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::schema::{CycleRecord, EncoderSample, Event, EventKind, flags};
use crate::time::UtcNs;

/// Largest number of markers in the summary. The events of the recording contain all markers.
const MARKS_MAX: usize = 50;
/// Longest text of a marker in the summary \[characters\]. Longer texts are cut.
const MARK_CHARS_MAX: usize = 300;

/// A marker of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunMark {
    /// Time since the run began \[s\].
    pub at_s: f64,
    /// Text as it was typed, at most 300 characters.
    pub text: String,
}

/// These cycles of a run are invalid for the same reason, in one encoder or in all encoders.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Flagged {
    /// The encoder of this bar joint (1 to 5) is invalid; absent if all encoders are invalid.
    pub joint: Option<u8>,
    /// The text states why the cycles are invalid.
    pub reason: String,
    /// The first of these cycles has this number, counted from 0 at the beginning of the run.
    pub first: u64,
    /// This number of cycles is invalid for this reason, from the beginning of the run until now or until its end.
    pub cycles: u64,
    /// These cycles form this number of uninterrupted sequences.
    pub periods: u64,
}

/// Collects the summary while a run is written.
#[derive(Debug, Default)]
pub(super) struct Digest {
    marks: Vec<RunMark>,
    /// Each entry, with the number of the last cycle that it includes.
    flagged: Vec<(Flagged, u64)>,
}

impl Digest {
    pub fn take_event(&mut self, event: &Event, started: UtcNs) {
        if event.kind == EventKind::Marker && self.marks.len() < MARKS_MAX {
            let at_s = event.time.seconds_since(started).max(0.0);
            let text = event.text.chars().take(MARK_CHARS_MAX).collect();
            self.marks.push(RunMark { at_s, text });
        }
    }

    pub fn take_cycle(&mut self, record: &CycleRecord) {
        if record.is_valid() {
            return;
        }
        let encoders = record.encoders();
        let reason_of = |encoder: Option<&EncoderSample>| reason(encoder, record.flags);
        let first = reason_of(encoders.first());
        if encoders.iter().all(|encoder| !encoder.valid && reason_of(Some(encoder)) == first) {
            self.count(None, first, record.cycle);
            return;
        }
        for encoder in encoders.iter().filter(|encoder| !encoder.valid) {
            self.count(Some(encoder.joint), reason_of(Some(encoder)), record.cycle);
        }
    }

    fn count(&mut self, joint: Option<u8>, reason: &str, cycle: u64) {
        // Whether an entry of `flagged` has this joint and this reason.
        let same = |(flagged, _): &&mut (Flagged, u64)| flagged.joint == joint && flagged.reason == reason;
        if let Some((flagged, last)) = self.flagged.iter_mut().find(same) {
            flagged.periods += u64::from(cycle > *last + 1);
            flagged.cycles += 1;
            *last = cycle;
        } else {
            let flagged = Flagged { joint, reason: reason.into(), first: cycle, cycles: 1, periods: 1 };
            self.flagged.push((flagged, cycle));
        }
    }

    pub fn marks(&self) -> Vec<RunMark> {
        self.marks.clone()
    }

    pub fn flagged(&self) -> Vec<Flagged> {
        self.flagged.iter().map(|(flagged, _)| flagged.clone()).collect()
    }
}

/// Bits of an EL5021's status word (Beckhoff, index 0x6000), with their meaning. They are more specific than
/// the flags of a cycle.
const STATUS_REASONS: [(u16, &str); 2] = [(1 << 4, "signal too low"), (1 << 3, "turned too fast")];

/// Flags of a cycle with their meaning. If a cycle has several flags, the first of them in this list is the reason.
const FLAG_REASONS: [(u32, &str); 9] = [
    (flags::LOST, "cycle lost"),
    (flags::BUS_DOWN, "bus down"),
    (flags::NO_REPLY, "no reply from the bus"),
    (flags::NOT_OPERATIONAL, "terminal not in operation"),
    (flags::WORKING_COUNTER, "terminal does not answer"),
    (flags::TERMINAL_ERROR, "terminal reports an error"),
    (flags::STALE_INPUT, "no new sample"),
    (flags::DEADLINE_MISSED, "cycle too late"),
    (flags::NO_DC, "no distributed clock"),
];

/// In cycles with one of these flags, the status words may be old, because the bus did not reply.
const NO_STATUS: u32 = flags::LOST | flags::BUS_DOWN | flags::NO_REPLY;

/// The reason why a sample is invalid. The terminal's status word determines it, unless the word may be old or contains no
/// reason. Then the flags of the cycle determine it.
fn reason(encoder: Option<&EncoderSample>, flags: u32) -> &'static str {
    let status = encoder.filter(|_| flags & NO_STATUS == 0).map_or(0, |encoder| encoder.status);
    let by_status = STATUS_REASONS.iter().find(|(bit, _)| status & bit != 0).map(|(_, reason)| *reason);
    let by_flags = || FLAG_REASONS.iter().find(|(bit, _)| flags & bit != 0).map(|(_, reason)| *reason);
    by_status.or_else(by_flags).unwrap_or("not valid")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::schema::MAX_ENCODERS;

    fn record(cycle: u64, flags: u32, invalid: &[u8], status: u16) -> CycleRecord {
        let mut record =
            CycleRecord { cycle, flags, encoder_count: MAX_ENCODERS as u8, ..CycleRecord::default() };
        for (encoder, joint) in record.encoders.iter_mut().zip(1..) {
            let valid = !invalid.contains(&joint);
            let status = if valid { 0 } else { status };
            *encoder = EncoderSample { joint, valid, status, ..EncoderSample::default() };
        }
        record
    }

    #[test]
    fn invalid_cycles_are_counted_by_joint_and_reason() {
        let mut digest = Digest::default();
        for cycle in 0..100 {
            digest.take_cycle(&match cycle {
                10..20 | 50..55 => record(cycle, flags::TERMINAL_ERROR, &[3], 1 << 4),
                30..40 => record(cycle, flags::NO_REPLY, &[1, 2, 3, 4, 5], 1 << 4),
                60 => record(cycle, flags::WORKING_COUNTER, &[4, 5], 0),
                _ => record(cycle, 0, &[], 0),
            });
        }
        let flagged = |joint, reason: &str, first, cycles, periods| Flagged {
            joint,
            reason: reason.into(),
            first,
            cycles,
            periods,
        };
        let expected = [
            flagged(Some(3), "signal too low", 10, 15, 2),
            flagged(None, "no reply from the bus", 30, 10, 1),
            flagged(Some(4), "terminal does not answer", 60, 1, 1),
            flagged(Some(5), "terminal does not answer", 60, 1, 1),
        ];
        assert_eq!(digest.flagged(), expected);
    }
}
