//! Compares each valid record with the last valid one before it, to detect a new origin of the counts. A terminal that was
//! without power counts from zero again, so all its later angles have another offset.

use shared::config::EncoderConfig;
use shared::recording::schema::{CycleRecord, MAX_ENCODERS};
use shared::time::UtcNs;

use super::events::Origin;

/// Largest speed of a joint of the ball-bar while a robot is calibrated \[rev/s\]: 120 degrees per second.
const SPEED_MAX_REV_PER_S: f64 = 1.0 / 3.0;
/// Tolerance of a count \[counts\]. It covers rounding, and the low bits, which stay constant while a joint turns fast.
const SLACK_COUNTS: f64 = 256.0;

/// Detects a new origin of the counts.
#[derive(Debug, Clone)]
pub struct Continuity {
    counts_per_rev: [f64; MAX_ENCODERS],
    last: Option<CycleRecord>,
    /// Whether a device was without power since the last valid record.
    powered_off: bool,
    /// Time at which the bus first went through INIT since the last valid record. `None` if it did not.
    reset_at: Option<UtcNs>,
    /// Number of the origin in this run.
    origin: u32,
}

impl Continuity {
    /// `encoders` are in bus order.
    pub fn new(encoders: &[EncoderConfig]) -> Self {
        let mut counts_per_rev = [f64::INFINITY; MAX_ENCODERS];
        for (counts, encoder) in counts_per_rev.iter_mut().zip(encoders) {
            *counts = encoder.scale().counts_per_revolution() as f64;
        }
        Self { counts_per_rev, last: None, powered_off: false, reset_at: None, origin: 0 }
    }

    /// Starts a run. Records before the run are not compared with records of the run.
    pub fn begin_run(&mut self) {
        self.last = None;
        (self.powered_off, self.reset_at, self.origin) = (false, None, 0);
    }

    /// Reports that a device was without power. Its next counts are unrelated to its earlier counts.
    pub fn powered_off(&mut self) {
        self.powered_off = true;
    }

    /// Reports that the bus goes through INIT at the time `at`. INIT may set counts to zero.
    pub fn bus_reset(&mut self, at: UtcNs) {
        self.reset_at.get_or_insert(at);
    }

    /// Sets the origin number of a record. If the counts may have a new origin, the first valid record gets a new
    /// number, and the reason is returned. Between a power loss or INIT and this first valid record, the origin is
    /// unknown. The counts of records in this period are marked as invalid. Such counts exist if the bus came up
    /// without some of its terminals.
    pub fn check(&mut self, record: &mut CycleRecord) -> Option<Origin> {
        record.origin = self.origin;
        if !record.is_valid() {
            if self.powered_off || self.reset_at.is_some() {
                record.encoders.iter_mut().for_each(|encoder| encoder.valid = false);
            }
            return None;
        }
        let reset_at = self.reset_at.take();
        let changed = if std::mem::take(&mut self.powered_off) {
            Some(Origin::PoweredOff)
        } else {
            self.last.as_ref().and_then(|last| self.compare(last, record, reset_at))
        };
        if changed.is_some() {
            self.origin += 1;
            record.origin = self.origin;
        }
        self.last = Some(*record);
        changed
    }

    /// Compares a valid record with the last valid one, and returns the reason if the counts may have a new origin. A
    /// terminal that restarts when the bus comes up counts from zero. If a count is close to zero, the terminal may have
    /// restarted, or the joint may really be there. Such a count is treated as a new origin. An unnecessary origin adds a
    /// few parameters to the calibration, but a missed one would corrupt it.
    fn compare(&self, last: &CycleRecord, record: &CycleRecord, reset_at: Option<UtcNs>) -> Option<Origin> {
        let turns_since = |at: UtcNs| SPEED_MAX_REV_PER_S * record.sample_time.seconds_since(at).max(0.0);
        let turns = turns_since(last.sample_time);
        let turns_from_zero = reset_at.map(turns_since);
        let pairs = last.encoders().iter().zip(record.encoders()).zip(&self.counts_per_rev);
        pairs.into_iter().find_map(|((before, now), counts_per_rev)| {
            let counts_max = |turns: f64| turns * counts_per_rev + SLACK_COUNTS;
            let from_zero = f64::from(now.count as i32).abs();
            let turned = f64::from(now.count.wrapping_sub(before.count) as i32).abs();
            if turned > counts_max(turns) {
                Some(Origin::Jumped { joint: now.joint })
            } else if turns_from_zero.is_some_and(|turns| from_zero <= counts_max(turns)) {
                Some(Origin::NearZero { joint: now.joint })
            } else {
                None
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use shared::recording::schema::EncoderSample;

    use super::*;

    fn continuity() -> Continuity {
        Continuity::new(&[1, 2].map(EncoderConfig::ern_1080))
    }

    fn record(ms: i64, counts: [u32; 2], valid: bool) -> CycleRecord {
        let mut record =
            CycleRecord { sample_time: UtcNs(ms * 1_000_000), encoder_count: 2, ..CycleRecord::default() };
        for (encoder, (joint, count)) in record.encoders.iter_mut().zip([1, 2].into_iter().zip(counts)) {
            *encoder = EncoderSample { joint, count, valid, ..EncoderSample::default() };
        }
        record
    }

    const FAR: u32 = 900_000_000;

    #[test]
    fn a_joint_that_turns_through_the_wrap_of_its_counter_goes_on() {
        let mut continuity = continuity();
        for (ms, count) in [(0, u32::MAX - 20_000), (10, 10_000), (20, 50_000)] {
            let mut record = record(ms, [count, FAR], true);
            assert_eq!(continuity.check(&mut record), None);
            assert_eq!(record.origin, 0);
        }
    }

    #[test]
    fn more_than_a_joint_can_turn_is_a_new_origin_once_and_only_valid_counts_are_asked() {
        let mut continuity = continuity();
        assert_eq!(continuity.check(&mut record(0, [FAR, FAR], true)), None);
        assert_eq!(continuity.check(&mut record(10, [0, 0], false)), None);
        let mut jumped = record(20, [FAR, FAR + 200_000], true);
        assert_eq!(continuity.check(&mut jumped), Some(Origin::Jumped { joint: 2 }));
        assert_eq!(jumped.origin, 1);
        // The first valid record of the new origin returned the reason. Later records keep its number, even if
        // one of them is lost.
        for (ms, valid) in [(30, true), (40, false)] {
            let mut next = record(ms, [FAR, FAR + 201_000], valid);
            assert_eq!((continuity.check(&mut next), next.origin), (None, 1));
        }
        // Within a second, the joint can turn by this distance.
        assert_eq!(continuity.check(&mut record(1030, [FAR + 4_000_000, FAR], true)), None);
    }

    #[test]
    fn a_power_cycle_is_a_new_origin_wherever_the_count_is() {
        let mut continuity = continuity();
        continuity.check(&mut record(0, [FAR, FAR], true));
        continuity.powered_off();
        assert_eq!(continuity.check(&mut record(10, [FAR, FAR], false)), None);
        assert_eq!(continuity.check(&mut record(20, [FAR, FAR], true)), Some(Origin::PoweredOff));
        assert_eq!(continuity.check(&mut record(30, [FAR, FAR], true)), None);
    }

    #[test]
    fn until_the_origin_is_known_again_no_count_is_used() {
        let mut continuity = continuity();
        continuity.check(&mut record(0, [FAR, FAR], true));
        continuity.powered_off();
        let mut partly = record(10, [FAR, FAR], true);
        partly.encoders[1].valid = false;
        assert_eq!(continuity.check(&mut partly), None);
        assert!(!partly.encoders[0].valid);
        assert_eq!(continuity.check(&mut record(20, [FAR, FAR], true)), Some(Origin::PoweredOff));
        partly.encoders[0].valid = true;
        assert_eq!(continuity.check(&mut partly), None);
        assert!(partly.encoders[0].valid, "known since");
    }

    #[test]
    fn a_count_near_zero_after_the_bus_came_up_again_may_have_started_there() {
        let mut continuity = continuity();
        continuity.check(&mut record(0, [FAR, 3000], true));
        assert_eq!(continuity.check(&mut record(10, [FAR, 2000], true)), None);
        continuity.bus_reset(UtcNs(20_000_000));
        let near = Origin::NearZero { joint: 2 };
        assert_eq!(continuity.check(&mut record(700, [FAR, 1000], true)), Some(near));
        assert_eq!(continuity.check(&mut record(710, [FAR, 0], true)), None);
    }
}
