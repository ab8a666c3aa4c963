//! The reference mark of an encoder disc: one signal period wide, once a revolution.

use super::Periods;

/// Positions of the marks of one encoder.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReferenceMark {
    /// Position of one mark.
    pub at: Periods,
    /// Distance to the next mark.
    revolution: i64,
}

impl ReferenceMark {
    /// A mark at `at` and each revolution of `lines` signal periods from there.
    pub fn new(at: Periods, lines: u32) -> Self {
        Self { at, revolution: i64::from(lines).max(1) * Periods::ONE }
    }

    /// The mark between two positions less than a revolution apart.
    pub fn between(&self, from: Periods, to: Periods) -> Option<Periods> {
        let turn = |position: Periods| position.0.wrapping_sub(self.at.0).div_euclid(self.revolution);
        // Turns begin at marks: the mark between two turns is at the start of the upper one.
        let upper = turn(from).max(turn(to));
        (turn(from) != turn(to)).then(|| Periods(self.at.0.wrapping_add(upper.wrapping_mul(self.revolution))))
    }

    /// Whether the encoder is at a mark.
    pub fn is_at(&self, position: Periods) -> bool {
        let from_mark = position.0.wrapping_sub(self.at.0).rem_euclid(self.revolution);
        let half = Periods::ONE / 2;
        from_mark < half || from_mark > self.revolution - half
    }
}
