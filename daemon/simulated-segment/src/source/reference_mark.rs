//! The reference mark on an encoder disc. It is one signal period wide and occurs once per revolution.

use super::Periods;

/// Positions of the reference mark of one encoder, in all revolutions.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReferenceMark {
    /// Position of the mark in one revolution.
    pub at: Periods,
    /// Distance from one mark to the next, in fixed point ([`Periods::ONE`]).
    revolution: i64,
}

impl ReferenceMark {
    /// Marks at `at` and at every revolution of `lines` signal periods from there.
    pub fn new(at: Periods, lines: u32) -> Self {
        Self { at, revolution: i64::from(lines).max(1) * Periods::ONE }
    }

    /// Position of the mark between two positions. `None` if no mark is between them. The positions must be
    /// less than one revolution apart.
    pub fn between(&self, from: Periods, to: Periods) -> Option<Periods> {
        let turn = |position: Periods| position.0.wrapping_sub(self.at.0).div_euclid(self.revolution);
        // A revolution begins at a mark. If the positions are in two revolutions, the mark is at the
        // beginning of the higher one.
        let upper = turn(from).max(turn(to));
        (turn(from) != turn(to)).then(|| Periods(self.at.0.wrapping_add(upper.wrapping_mul(self.revolution))))
    }

    /// Whether a position is within half a signal period of a mark.
    pub fn is_at(&self, position: Periods) -> bool {
        let from_mark = position.0.wrapping_sub(self.at.0).rem_euclid(self.revolution);
        let half = Periods::ONE / 2;
        from_mark < half || from_mark > self.revolution - half
    }
}
