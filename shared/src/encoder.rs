//! Converts counts of a SinCos terminal to radians and back.
//!
//! An EL5021 counts signal periods (lines) and divides each period into `2^N` steps by interpolation. Its counter consists
//! of the low 32 bits of `periods << N | fraction`, and wraps without any message. Example: the ERN 1080 has 3600 lines.
//! With N = 12, one revolution has 14 745 600 counts, and the counter wraps after 291.27 revolutions.
//!
//! In this file, a *counter* is the wrapped 32-bit value, and *counts* are unwrapped: 64 bits, continuous over wraps.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

/// Whether counts rise or fall when the joint turns in its positive direction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// Counts rise when the joint turns in its positive direction.
    #[default]
    Positive,
    /// Counts fall when the joint turns in its positive direction.
    Negative,
}

impl Direction {
    /// +1 for `Positive`, -1 for `Negative`.
    pub const fn sign(self) -> i64 {
        match self {
            Self::Positive => 1,
            Self::Negative => -1,
        }
    }
}

/// Interpolation that an EL5021 offers (object 0x8001:11), from smallest to largest \[bits per signal period\].
pub const INTERPOLATION_BITS: std::ops::RangeInclusive<u8> = 8..=13;

/// Relation between the counts of an encoder and its joint's angle:
/// `angle = sign * 2 pi / (lines * 2^bits) * (counts - reference_counts) + offset`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EncoderScale {
    /// Signal periods per revolution.
    pub lines: u32,
    /// Interpolation, bits per signal period.
    pub interpolation_bits: u8,
    /// Whether counts rise or fall with the joint's angle.
    pub direction: Direction,
    /// Joint angle at `reference_counts` \[rad\].
    pub offset_rad: f64,
    /// Count at the reference mark, latched on input C, see [`HomingConfig`](crate::config::HomingConfig). 0 if no mark is
    /// known. In that case, angles begin at an arbitrary count of this power cycle.
    pub reference_counts: u32,
}

impl Default for EncoderScale {
    /// Heidenhain ERN 1080 at 12 bits: 3600 lines, 14 745 600 counts per revolution.
    fn default() -> Self {
        Self {
            lines: 3600,
            interpolation_bits: 12,
            direction: Direction::Positive,
            offset_rad: 0.0,
            reference_counts: 0,
        }
    }
}

impl EncoderScale {
    /// Counts in one revolution of the joint.
    pub const fn counts_per_revolution(&self) -> i64 {
        (self.lines as i64) << self.interpolation_bits
    }

    /// Angle of one count \[rad\].
    pub fn rad_per_count(&self) -> f64 {
        TAU / self.counts_per_revolution() as f64
    }

    /// Converts unwrapped counts to the joint's angle \[rad\].
    ///
    /// The counts must come from [`EncoderScale::unwrapper`], which starts at the reference mark.
    pub fn counts_to_rad(&self, counts: i64) -> f64 {
        let from_reference = counts - i64::from(self.reference_counts);
        // This is exact for any number of revolutions, because the product is an integer.
        (self.direction.sign() * from_reference) as f64 * self.rad_per_count() + self.offset_rad
    }

    /// An unwrapper that starts at the reference mark. The first count is assumed to be less than half a wrap away from the
    /// mark (146 revolutions at 12 bits).
    pub const fn unwrapper(&self) -> Unwrapper {
        Unwrapper { last: self.reference_counts, unwrapped: self.reference_counts as i64 }
    }

    /// Converts an angle \[rad\] to the nearest unwrapped count.
    pub fn rad_to_counts(&self, angle_rad: f64) -> i64 {
        let from_reference = ((angle_rad - self.offset_rad) / self.rad_per_count()).round() as i64;
        self.direction.sign() * from_reference + i64::from(self.reference_counts)
    }
}

/// Wraps a count: the low 32 bits that a terminal's counter shows.
pub const fn wrap(counts: i64) -> u32 {
    counts as u32
}

/// Unwraps a 32-bit counter.
///
/// The difference of two successive counter values is taken modulo 2^32 as a signed number. This is correct as long as the
/// joint turns less than half a wrap (146 revolutions at 12 bits) between two samples.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Unwrapper {
    last: u32,
    unwrapped: i64,
}

impl Unwrapper {
    /// Signed distance from the last counter value to this one \[counts\].
    pub const fn distance(&self, counter: u32) -> i32 {
        counter.wrapping_sub(self.last) as i32
    }

    /// Takes the next counter value and returns the unwrapped counts.
    pub fn next(&mut self, counter: u32) -> i64 {
        self.unwrapped += i64::from(self.distance(counter));
        self.last = counter;
        self.unwrapped
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn any_scale() -> impl Strategy<Value = EncoderScale> {
        (1u32..20_000, INTERPOLATION_BITS, any::<bool>(), -10.0..10.0, any::<u32>()).prop_map(
            |(lines, interpolation_bits, negative, offset_rad, reference_counts)| EncoderScale {
                lines,
                interpolation_bits,
                direction: if negative { Direction::Negative } else { Direction::Positive },
                offset_rad,
                reference_counts,
            },
        )
    }

    #[test]
    fn an_ern_1080_at_12_bits_has_14_745_600_counts_and_wraps_after_291_revolutions() {
        let scale = EncoderScale::default();
        assert_eq!(scale.counts_per_revolution(), 14_745_600);
        let revolutions = 2f64.powi(32) / scale.counts_per_revolution() as f64;
        assert!((revolutions - 291.27).abs() < 0.01);
        let fine = EncoderScale { interpolation_bits: 13, ..scale };
        assert_eq!(fine.counts_per_revolution(), 2 * 14_745_600);
    }

    #[test]
    fn a_quarter_turn_backwards_through_zero_is_minus_90_degrees() {
        let scale = EncoderScale::default();
        let mut unwrapper = Unwrapper::default();
        let start = unwrapper.next(1000);
        let end = unwrapper.next(1000u32.wrapping_sub(14_745_600 / 4));
        let turned = scale.counts_to_rad(end) - scale.counts_to_rad(start);
        assert!((turned + std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    }

    #[test]
    fn the_reference_mark_reads_the_offset() {
        let scale = EncoderScale { reference_counts: 777, offset_rad: 0.25, ..EncoderScale::default() };
        assert_eq!(scale.counts_to_rad(777), 0.25);
        // The result is also correct if the counter wraps between the mark and the first count.
        let near_wrap = EncoderScale { reference_counts: u32::MAX - 2, ..scale };
        let turned_rad = near_wrap.counts_to_rad(near_wrap.unwrapper().next(3)) - 0.25;
        assert!((turned_rad - 6.0 * scale.rad_per_count()).abs() < 1e-15);
        let reversed = EncoderScale { direction: Direction::Negative, ..scale };
        assert!(reversed.counts_to_rad(778) < 0.25 && scale.counts_to_rad(778) > 0.25);
    }

    proptest! {
        #[test]
        fn counts_survive_the_way_to_radians_and_back(scale in any_scale(), counts in -(1i64 << 40)..(1i64 << 40)) {
            prop_assert_eq!(scale.rad_to_counts(scale.counts_to_rad(counts)), counts);
        }

        #[test]
        fn any_motion_below_half_a_wrap_a_sample_is_followed(
            start in any::<i32>(), steps in prop::collection::vec(-(1i64 << 31) + 1..(1i64 << 31), 1..50)
        ) {
            let mut unwrapper = Unwrapper::default();
            let mut truth = i64::from(start);
            prop_assert_eq!(unwrapper.next(wrap(truth)), truth);
            for step in steps {
                truth += step;
                prop_assert_eq!(unwrapper.next(wrap(truth)), truth);
            }
        }
    }
}
