//! Detects a clock step so large that no single shift matches the whole run.
//!
//! The run is cut into parts with equal numbers of samples. Each part is correlated with the robot's log, which gives one
//! shift for each part. At a clock step the shifts have one level before some instant and another level after it. `find` uses
//! this search if no candidate fits, or if the best one fits poorly. The result is the error [`PrepareError::ClockJump`].

use std::ops::Range;

use super::correlate::{Match, candidates};
use super::find::AlignmentSearch;
use super::speeds::{measured_speeds, without_order};
use crate::prepare::PrepareError;

/// Number of parts into which the recording is cut.
const PARTS: usize = 6;
/// Shifts that differ by more than this belong to different levels \[s\].
const DIFFERENT_S: f64 = 0.05;
/// Fraction of a part that must overlap with the robot's log.
const OVERLAP_MIN: f64 = 0.6;
/// Smallest ratio of a step to the scatter of the shifts on both sides of the step. The scatter is the largest difference
/// between the shifts of neighbouring parts on one side.
const TIMES_SCATTER: f64 = 3.0;

/// A part of the recording whose speeds match the robot's log.
struct MatchedPart {
    samples: Range<usize>,
    /// Time from the first reading of the recording to the first sample of this part \[s\].
    start_s: f64,
    matched: Match,
    /// Time since the first stamp of the robot's log minus time since the first reading of the recording, at
    /// the same instant \[s\].
    shift_s: f64,
}

impl AlignmentSearch<'_> {
    /// Returns a clock step if the shifts of the parts that match have one level before some instant and another level after
    /// it. At most one of these parts may belong to neither level. `step_s` is the step of the grid \[s\].
    ///
    /// Some parts also match if the log belongs to another robot than the configured one. In this case no step is returned,
    /// because the shifts scatter and the angles do not fit on either side.
    pub(super) fn jump_between_parts(&self, window: &Range<usize>, step_s: f64) -> Option<PrepareError> {
        let parts = self.parts(window, step_s);
        let differ = |a: &MatchedPart, b: &MatchedPart| (a.shift_s - b.shift_s).abs() > DIFFERENT_S;
        // Each side must have at least two parts, because a chance match of one part agrees with no other part.
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

    /// Whether the angles of one side fit at the shift of the first part of this side. The criterion is the same as for a
    /// run without a clock step.
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

/// Largest difference between the shifts of neighbouring parts on one side \[s\].
fn scatter_s(side: &[MatchedPart]) -> f64 {
    side.windows(2).map(|pair| (pair[1].shift_s - pair[0].shift_s).abs()).fold(0.0, f64::max)
}
