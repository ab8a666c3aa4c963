//! A clock step so large that no single shift matches the whole run. The run is cut into parts, each is correlated with the
//! robot's log, and the shifts have two levels. Used by `find` when no candidate fits, or the best one fits
//! poorly, for the message of the refusal.

use std::ops::Range;

use super::correlate::{Match, candidates};
use super::find::AlignmentSearch;
use super::speeds::{measured_speeds, without_order};
use crate::prepare::PrepareError;

/// Number of parts of the recording that are matched one by one.
const PARTS: usize = 6;
/// Shifts that differ by this much are different \[s\].
const DIFFERENT_S: f64 = 0.05;
/// Share of a part that must lie in the robot's log.
const OVERLAP_MIN: f64 = 0.6;
/// Smallest ratio of a step to the largest difference of neighbouring shifts on either side of it.
const TIMES_SCATTER: f64 = 3.0;

/// A part of the recording that matches the robot's log.
struct MatchedPart {
    samples: Range<usize>,
    /// Time of its first sample since the first reading \[s\].
    start_s: f64,
    matched: Match,
    /// Time since the first stamp of the robot's log less time since the first reading \[s\].
    shift_s: f64,
}

impl AlignmentSearch<'_> {
    /// A clock step, if each part of `window` matches, at shifts that agree before and after some instant.
    ///
    /// If the robot is not the configured one parts match, too, but their shifts scatter and the angles fit on neither side.
    pub(super) fn jump_between_parts(&self, window: &Range<usize>, step_s: f64) -> Option<PrepareError> {
        let parts = self.parts(window, step_s);
        let differ = |a: &MatchedPart, b: &MatchedPart| (a.shift_s - b.shift_s).abs() > DIFFERENT_S;
        // Each side has two parts or more: a chance match of one part agrees with no other.
        let mut sides = parts.chunk_by(|a, b| !differ(a, b)).filter(|side| side.len() >= 2);
        let (before, after) = (sides.next()?, sides.next()?);
        if sides.next().is_some() || before.len() + after.len() + 1 < parts.len() {
            return None;
        }
        let by_s = after.first()?.shift_s - before.last()?.shift_s;
        let is_step = by_s.abs() > DIFFERENT_S.max(TIMES_SCATTER * scatter_s(before).max(scatter_s(after)));
        let fits = |side: &[MatchedPart]| self.side_fits(side, step_s);
        let at_s = after.first()?.start_s;
        (is_step && fits(before) && fits(after))
            .then_some(PrepareError::ClockJump { at_s, by_ms: 1e3 * by_s })
    }

    fn parts(&self, window: &Range<usize>, step_s: f64) -> Vec<MatchedPart> {
        let joints = self.joints();
        let from_robot = without_order(&self.predicted(step_s));
        let length = window.len().div_ceil(PARTS).max(1);
        let part = |start: usize| {
            let samples = start..(start + length).min(window.end);
            let start_s = *self.readings.t_s.get(start)?;
            let part = self.readings.slice(samples.clone());
            let overlap_min = (OVERLAP_MIN * part.duration_s() / step_s) as usize;
            let from_bar = without_order(&measured_speeds(&part, &joints, step_s, 0.0));
            let matched = candidates(&from_robot, &from_bar, overlap_min, 1).pop()?;
            let is_high = matched.correlation >= self.options.correlation_min;
            let shift_s = matched.shift * step_s - start_s;
            is_high.then_some(MatchedPart { samples, start_s, matched, shift_s })
        };
        window.clone().step_by(length).filter_map(part).collect()
    }

    /// Whether the angles of a side fit at its shift, as those of a run without a step do.
    fn side_fits(&self, side: &[MatchedPart], step_s: f64) -> bool {
        let (Some(first), Some(last)) = (side.first(), side.last()) else { return false };
        let window = first.samples.start..last.samples.end;
        let fit = self.hypothesis(&window, (0.0, first.matched), step_s);
        matches!(
            fit,
            Ok(_) | Err(PrepareError::AmbiguousEncoderMap { .. } | PrepareError::OtherEncoderMap { .. })
        )
    }
}

/// Largest difference of the shifts of neighbouring parts \[s\].
fn scatter_s(side: &[MatchedPart]) -> f64 {
    side.windows(2).map(|pair| (pair[1].shift_s - pair[0].shift_s).abs()).fold(0.0, f64::max)
}
