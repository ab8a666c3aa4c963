//! Searches for the reference mark of one joint in the records of the bus. [`Sequence`](super::Sequence) passes the records
//! one by one. The first encoder that turns by 5 degrees is the encoder of this joint. When its terminal reports a latched
//! count, this is the count at the mark.

use shared::config::EncoderConfig;
use shared::recording::schema::{CycleRecord, MAX_ENCODERS, flags};
use shared::time::UtcNs;

use super::{FoundMark, HomingError, PATIENCE_S, SIGNAL_LOST_MAX_S};
use crate::devices::el5021::StatusWord;

/// An encoder counts as turned if it has moved by this angle \[rad\]. The joint and the direction are then known.
const TURNED_MIN_RAD: f64 = 5.0 * std::f64::consts::PI / 180.0;
/// Largest angle by which another encoder may have moved until then \[rad\].
const OTHERS_MAX_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;

/// Result of the search after one record.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Detection {
    Nothing,
    /// The encoder passed its mark in the wrong direction, so this latch is not used.
    MarkPassedBackwards {
        /// Number of the encoder, in bus order from 0.
        encoder: usize,
    },
    /// The encoder of the joint, its direction and its mark.
    Found(FoundMark),
}

/// Start of a search: time of its first record, and counts of its first valid record.
#[derive(Debug, Clone, Copy)]
struct Start {
    time: UtcNs,
    counts: [u32; MAX_ENCODERS],
}

/// Motion of one encoder since the search for this joint began.
#[derive(Debug, Clone, Copy, Default)]
struct EncoderMotion {
    /// Distance from the count at the start \[counts\].
    moved: i64,
    /// Smallest distance so far \[counts\]. The next field is the largest distance.
    lowest: i64,
    highest: i64,
    /// Whether counts were increasing when the latch became valid. `None` while the latch is not valid.
    latched: Option<bool>,
}

/// State of the search for the mark of one joint.
#[derive(Default)]
pub(super) struct Search {
    encoders: Vec<EncoderConfig>,
    joint: u8,
    /// Marks of the joints whose search has finished.
    earlier: Vec<FoundMark>,
    start: Option<Start>,
    motions: [EncoderMotion; MAX_ENCODERS],
    /// The encoder that has turned far enough, and whether its counts increase. `None` if no encoder
    /// has turned far enough yet.
    mover: Option<(usize, bool)>,
    /// Time from the first record of the search to the current record \[s\].
    elapsed_s: f64,
    /// Time from the first record of the search to the last valid record \[s\]. 0 before the first valid record.
    valid_last_s: f64,
}

impl Search {
    /// Begins to search for the mark of `joint`. `earlier` are the marks that were found for other joints. The terminals
    /// must have been armed just before.
    pub fn new(encoders: Vec<EncoderConfig>, joint: u8, earlier: Vec<FoundMark>) -> Self {
        Self { encoders, joint, earlier, ..Self::default() }
    }

    /// Time from the first record to the last one \[s\].
    pub fn elapsed_s(&self) -> f64 {
        self.elapsed_s
    }

    /// The joint that must be turned, and the angle of the encoder that has turned farthest \[rad\].
    pub fn progress(&self) -> (u8, f64) {
        let moves = self.mover.map(|(encoder, _)| encoder).or_else(|| self.farthest(None));
        (self.joint, moves.map_or(0.0, |encoder| self.turned_rad(encoder)))
    }

    /// Processes the next record of the bus.
    pub fn observe(&mut self, record: &CycleRecord) -> Result<Detection, HomingError> {
        let start = *self.start.get_or_insert_with(|| Start {
            time: record.sample_time,
            counts: record.encoders.map(|encoder| encoder.count),
        });
        self.elapsed_s = record.sample_time.seconds_since(start.time);
        if !record.is_valid() {
            // When the bus is brought up again, the counters may have restarted and the terminals are no longer armed.
            let is_down = record.flags & flags::BUS_DOWN != 0;
            if is_down || self.elapsed_s - self.valid_last_s > SIGNAL_LOST_MAX_S {
                return Err(HomingError::NoSignal(self.joint));
            }
            return Ok(Detection::Nothing);
        }
        if self.valid_last_s == 0.0 {
            // Distances are counted from the first valid counts.
            let counts = record.encoders.map(|encoder| encoder.count);
            self.start = Some(Start { counts, ..start });
        }
        self.valid_last_s = self.elapsed_s.max(f64::MIN_POSITIVE);
        self.follow(record);
        self.find_mover()?;
        if let Some((encoder, counts_rise)) = self.mover {
            let seen = self.check_mark(record, encoder, counts_rise)?;
            if seen != Detection::Nothing {
                return Ok(seen);
            }
        }
        if self.elapsed_s > PATIENCE_S {
            let (joint, turned_rad) = self.progress();
            return Err(HomingError::NoMark { joint, turned_deg: turned_rad.to_degrees() });
        }
        Ok(Detection::Nothing)
    }

    fn follow(&mut self, record: &CycleRecord) {
        let Some(start) = self.start else { return };
        for ((motion, encoder), start) in self.motions.iter_mut().zip(record.encoders()).zip(start.counts) {
            let before = motion.moved;
            motion.moved = i64::from(encoder.count.wrapping_sub(start) as i32);
            motion.lowest = motion.lowest.min(motion.moved);
            motion.highest = motion.highest.max(motion.moved);
            let is_latched = StatusWord(encoder.status).latch_valid();
            let rising = motion.moved > before;
            motion.latched = is_latched.then(|| motion.latched.unwrap_or(rising));
        }
    }

    /// Determines the encoder of the joint, which is the first encoder that has turned far enough. Fails if another encoder
    /// has also turned, or if the encoder belongs to a joint whose search has finished.
    fn find_mover(&mut self) -> Result<(), HomingError> {
        if self.mover.is_some() {
            return Ok(());
        }
        let far = |encoder: usize| self.turned_rad(encoder).abs();
        let Some(mover) = self.farthest(None).filter(|mover| far(*mover) >= TURNED_MIN_RAD) else {
            return Ok(());
        };
        if let Some(other) = self.farthest(Some(mover)).filter(|other| far(*other) > OTHERS_MAX_RAD) {
            return Err(HomingError::Together { asked: self.joint, terminals: [mover + 1, other + 1] });
        }
        if let Some(finished) = self.earlier.iter().find(|found| found.encoder == mover) {
            let (asked, terminal, joint) = (self.joint, mover + 1, finished.joint);
            return Err(HomingError::Again { asked, terminal, joint });
        }
        self.mover = Some((mover, self.turned_rad(mover) > 0.0));
        Ok(())
    }

    fn check_mark(
        &mut self,
        record: &CycleRecord,
        encoder: usize,
        counts_rise: bool,
    ) -> Result<Detection, HomingError> {
        let (joint, reference_counts) = (self.joint, record.encoders[encoder].latch);
        match self.motions[encoder].latched {
            None => Ok(Detection::Nothing),
            Some(rising) if rising != counts_rise => {
                self.motions[encoder].latched = None;
                Ok(Detection::MarkPassedBackwards { encoder })
            }
            Some(_) if !self.was_passed(encoder, reference_counts) => {
                Err(HomingError::Implausible { joint, latch: reference_counts })
            }
            Some(_) => Ok(Detection::Found(FoundMark { joint, encoder, counts_rise, reference_counts })),
        }
    }

    /// Whether the joint has passed the position with this count. The tolerance is one signal period.
    fn was_passed(&self, encoder: usize, count: u32) -> bool {
        let period = 1i64 << self.encoders[encoder].interpolation_bits;
        let EncoderMotion { lowest, highest, .. } = self.motions[encoder];
        let start = self.start.map_or(count, |start| start.counts[encoder]);
        let distance = i64::from(count.wrapping_sub(start) as i32);
        (lowest - period..=highest + period).contains(&distance)
    }

    /// Angle by which an encoder has turned \[rad\], positive if its counts have increased.
    fn turned_rad(&self, encoder: usize) -> f64 {
        self.motions[encoder].moved as f64 * self.encoders[encoder].scale().rad_per_count()
    }

    /// The encoder that has turned farthest. `except` is not considered.
    fn farthest(&self, except: Option<usize>) -> Option<usize> {
        let others = (0..self.encoders.len().min(MAX_ENCODERS)).filter(|encoder| Some(*encoder) != except);
        others.max_by(|one, other| self.turned_rad(*one).abs().total_cmp(&self.turned_rad(*other).abs()))
    }
}
