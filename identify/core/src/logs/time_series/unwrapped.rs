//! Makes readings continuous if they wrap after a turn or at the width of a counter. An [`Unwrapped`] contains a segment of
//! the readings as in the file and after unwrapping, for a picture in a report.

use std::borrow::Cow;
use std::ops::Range;

use serde::Serialize;

use super::stream::{Row, Stream};

/// Largest number of wraps in one picture.
const WRAPS_SHOWN: usize = 8;
/// Approximate number of readings that a picture spans.
const READINGS_SHOWN: usize = 2000;
/// Largest number of readings that are drawn. The two readings at each wrap are always drawn and do not count.
const POINTS_MAX: usize = 250;

/// One reading before and after unwrapping.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct UnwrappedPoint {
    /// Time since the first reading \[s\].
    pub t_s: f64,
    /// Reading as in the file \[rad\].
    pub shown_rad: f64,
    /// Reading made continuous, as it is used \[rad\].
    pub continuous_rad: f64,
}

/// Readings of one encoder or joint that wrapped, before and after unwrapping.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Unwrapped {
    /// Name such as `b1` for an encoder of the bar, numbered by the joint in its file, or `q6` for a joint of the robot.
    pub name: String,
    /// Range of the readings \[rad\]. A reading wraps when it leaves this range.
    pub period_rad: f64,
    /// Number of wraps in the log.
    pub wraps: usize,
    /// Largest change from one reading to the next, as a fraction of half a period. At 1 and above, the direction of
    /// a change is ambiguous.
    pub step_part: f64,
    /// The segment of the log with the most wraps, thinned.
    pub points: Vec<UnwrappedPoint>,
}

impl Unwrapped {
    /// Finds the wraps among `count` readings in the order of time; `None` without wraps.
    pub fn find(
        name: impl Into<String>,
        period_rad: f64,
        count: usize,
        reading: impl Fn(usize) -> UnwrappedPoint,
    ) -> Option<Self> {
        let pair = |index: usize| (reading(index - 1), reading(index));
        let is_wrap = |index: usize| {
            let (before, after) = pair(index);
            (after.shown_rad - before.shown_rad).abs() > 0.5 * period_rad
        };
        let wraps: Vec<usize> = (1..count).filter(|index| is_wrap(*index)).collect();
        let range = range_of_most_wraps(&wraps)?;
        let shown = range.start..range.end.min(count);
        let steps_rad = (1..count).map(pair).map(|(a, b)| (b.continuous_rad - a.continuous_rad).abs());
        let every = shown.len().div_ceil(POINTS_MAX).max(1);
        let is_drawn = |index: &usize| {
            let is_beside_wrap = [*index, index + 1].iter().any(|index| wraps.binary_search(index).is_ok());
            (index - shown.start).is_multiple_of(every) || is_beside_wrap
        };
        Some(Self {
            name: name.into(),
            period_rad,
            wraps: wraps.len(),
            step_part: 2.0 * steps_rad.fold(0.0, f64::max) / period_rad,
            points: shown.clone().filter(is_drawn).map(reading).collect(),
        })
    }

    /// Combines the results for the parts of a log of one encoder. The part with the most wraps is shown. `None` without wraps.
    pub fn of_parts(parts: impl IntoIterator<Item = Option<Self>>) -> Option<Self> {
        let parts: Vec<Self> = parts.into_iter().flatten().collect();
        let wraps = parts.iter().map(|part| part.wraps).sum();
        let step_part = parts.iter().map(|part| part.step_part).fold(0.0, f64::max);
        let shown = parts.into_iter().max_by_key(|part| part.wraps)?;
        Some(Self { wraps, step_part, ..shown })
    }
}

impl<R: Row> Stream<R> {
    /// The stream with continuous numbers, if numbers wrap after a `period`. The result is borrowed if no number wraps.
    ///
    /// A number that differs from the row before by more than half a period is moved by whole periods to the value nearest
    /// to that row. Across a gap the number of periods cannot be determined, so it is assumed not to change.
    pub fn unwrapped(&self, period: f64) -> Cow<'_, Self> {
        let mut continuous = Cow::Borrowed(self);
        let mut periods = vec![0.0; self.first().map_or(0, |row| row.numbers().len())];
        for part in self.parts() {
            for row in part.clone() {
                let (before, here) = (self[row.max(part.start + 1) - 1], self[row]);
                for (column, periods) in periods.iter_mut().enumerate() {
                    *periods -= ((here.numbers()[column] - before.numbers()[column]) / period).round();
                }
                if periods.iter().any(|periods| *periods != 0.0) {
                    continuous.to_mut()[row] = here.with_numbers(|i| here.numbers()[i] + periods[i] * period);
                }
            }
        }
        continuous
    }
}

/// The range of readings with the most wraps that fit into one picture. `wraps` are the first readings after each wrap.
fn range_of_most_wraps(wraps: &[usize]) -> Option<Range<usize>> {
    let wraps_from = |first: usize| {
        let near = wraps[first..].iter().take(WRAPS_SHOWN);
        near.take_while(|wrap| **wrap < wraps[first] + READINGS_SHOWN).count()
    };
    let span = |first: usize| wraps[first + wraps_from(first) - 1] - wraps[first];
    // Among ranges with the same number of wraps, the shortest is used.
    let first = (0..wraps.len()).max_by_key(|&first| (wraps_from(first), std::cmp::Reverse(span(first))))?;
    let margin = match wraps_from(first) {
        1 => READINGS_SHOWN / 2,
        several => (span(first) / (several - 1)).max(2),
    };
    Some(wraps[first].saturating_sub(margin)..wraps[first] + span(first) + margin)
}
