//! A time series on one clock: increasing times, and one row of numbers for each time.
//!
//! The robot's log, a force, a tracker's log and the bar's readings are all streams, so that each operation exists only once.
//! [`Stream::at`] and [`Stream::spline`] interpolate, [`Stream::averages`] smooths, [`Stream::unwrapped`] makes readings
//! continuous if they wrap, and [`Stream::filter_map`] selects rows. Two neighbouring rows have a gap between them if their
//! times differ by more than a limit. None of the operations extends across a gap, or across a restart of the counters.

use std::borrow::Cow;
use std::ops::{Deref, DerefMut, Range};

use nalgebra::Vector3;

use super::sampling::{Sampling, Stamps, find_clock};
use crate::kinematics::Joints;
use crate::statistics::median;

/// The numbers at one time: an array, a point, or one number for each axis of a robot.
pub trait Row: Copy {
    /// The numbers. All rows of a stream have the same count of numbers.
    fn numbers(&self) -> &[f64];

    /// A row of the same type and length whose number `i` is `number(i)`.
    fn with_numbers(&self, number: impl FnMut(usize) -> f64) -> Self;

    /// Whether the numbers continue the numbers of the row before. They do not continue them if a counter restarted
    /// between the two rows.
    fn continues(&self, _before: &Self) -> bool {
        true
    }
}

impl<const N: usize> Row for [f64; N] {
    #[inline]
    fn numbers(&self) -> &[f64] {
        self
    }

    #[inline]
    fn with_numbers(&self, number: impl FnMut(usize) -> f64) -> Self {
        std::array::from_fn(number)
    }
}

impl Row for Joints {
    #[inline]
    fn numbers(&self) -> &[f64] {
        self
    }

    #[inline]
    fn with_numbers(&self, number: impl FnMut(usize) -> f64) -> Self {
        Self::from_fn(self.len(), number)
    }
}

impl Row for Vector3<f64> {
    fn numbers(&self) -> &[f64] {
        self.as_slice()
    }

    fn with_numbers(&self, mut number: impl FnMut(usize) -> f64) -> Self {
        Self::from_fn(|axis, _| number(axis))
    }
}

/// Rows with times on one clock. A stream dereferences to the slice of its rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Stream<R> {
    /// Time of the first row \[ns on the stream's clock\]. Zero of that clock may be 1970, the start of a controller
    /// or any other time.
    pub first_stamp_ns: i64,
    /// Times since the first row \[s\]. They increase strictly from 0.
    pub t_s: Vec<f64>,
    /// One row for each time.
    pub rows: Vec<R>,
    /// There is a gap between two neighbouring rows if their times differ by more than this \[s\].
    pub gap_limit_s: f64,
}

/// Shortest gap \[s\]. If a joint swings at 1 Hz with an acceleration of 1 rad/s², a spline across 50 ms is accurate to 1
/// urad, and a straight line to 0.3 mrad.
const GAP_S_MIN: f64 = 0.05;

impl<R> Default for Stream<R> {
    fn default() -> Self {
        Self { first_stamp_ns: 0, t_s: Vec::new(), rows: Vec::new(), gap_limit_s: GAP_S_MIN }
    }
}

impl<R> Deref for Stream<R> {
    type Target = [R];

    fn deref(&self) -> &[R] {
        &self.rows
    }
}

impl<R> DerefMut for Stream<R> {
    fn deref_mut(&mut self) -> &mut [R] {
        &mut self.rows
    }
}

/// Times since the first stamp \[s\]. Differences have 128 bits, because two stamps may be more than 292 years apart.
pub fn since_first_s(stamps_ns: &[i64]) -> Vec<f64> {
    let first_ns = stamps_ns.first().copied().unwrap_or_default();
    stamps_ns.iter().map(|stamp_ns| (i128::from(*stamp_ns) - i128::from(first_ns)) as f64 * 1e-9).collect()
}

/// Median and largest difference of neighbouring times \[s\]; zeros if there are fewer than two times.
pub fn usual_and_longest_step_s(t_s: &[f64]) -> [f64; 2] {
    let mut steps_s: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let longest_s = steps_s.iter().copied().fold(0.0, f64::max);
    [median(&mut steps_s).unwrap_or_default(), longest_s]
}

/// Largest range of any of the numbers over all rows; zero if there are no rows.
pub(crate) fn travel<R: Row>(rows: &[R]) -> f64 {
    ranges(rows).into_iter().map(|[low, high]| high - low).fold(0.0, f64::max)
}

/// Smallest and largest value of each number over all rows.
pub fn ranges<R: Row>(rows: &[R]) -> Vec<[f64; 2]> {
    let mut ranges =
        vec![[f64::INFINITY, f64::NEG_INFINITY]; rows.first().map_or(0, |row| row.numbers().len())];
    // The rows are the outer loop because a long log does not fit into a cache.
    for row in rows {
        for ([low, high], value) in ranges.iter_mut().zip(row.numbers()) {
            (*low, *high) = (low.min(*value), high.max(*value));
        }
    }
    ranges
}

/// Remark on the rows that [`Stream::from_stamps`] did not keep, if there are any. `row` is the name of a row in the file.
pub(in crate::logs) fn remark_equal(is_kept: &[bool], row: &str) -> Option<String> {
    let dropped = is_kept.iter().filter(|is_kept| !**is_kept).count();
    (dropped > 0).then(|| {
        format!("{dropped} {row}s have the stamp of the one before, and no regular clock is behind the stamps; they are left out")
    })
}

/// Keeps the elements whose entry in `is_kept` is true, and all elements beyond the end of that list.
pub(in crate::logs) fn retain<T>(all: &mut Vec<T>, is_kept: &[bool]) {
    let mut is_kept = is_kept.iter();
    all.retain(|_| is_kept.next().copied().unwrap_or(true));
}

impl<R> Stream<R> {
    /// A stream of `rows` at the times `t_s` \[s\], which increase strictly from 0. The longer list is cut to the length of
    /// the shorter list. Gaps are longer than 50 ms and longer than 3.5 periods.
    pub fn new(first_stamp_ns: i64, mut t_s: Vec<f64>, mut rows: Vec<R>) -> Self {
        t_s.truncate(rows.len());
        rows.truncate(t_s.len());
        let stream = Self { first_stamp_ns, t_s, rows, gap_limit_s: GAP_S_MIN };
        let gap_limit_s = GAP_S_MIN.max(3.5 * stream.period_s());
        stream.with_gap_limit(gap_limit_s)
    }

    /// A stream of `rows`. Their times are those of the regular clock, if one is found from the stamps and the `motion`.
    /// Otherwise the times are the stamps, and of rows with equal stamps only the first is kept. `stamps_ns` must not decrease.
    ///
    /// Returns the stream, the clock if one was found, and for each row whether it was kept (empty if all were kept).
    pub(in crate::logs) fn from_stamps(
        mut stamps_ns: Vec<i64>,
        mut rows: Vec<R>,
        motion: impl FnOnce(&[R]) -> Cow<'_, [Joints]>,
    ) -> (Self, Option<Stamps>, Vec<bool>) {
        let first_ns = stamps_ns.first().copied().unwrap_or_default();
        let Some(Sampling { mut t_s, stamps }) = find_clock(since_first_s(&stamps_ns), &motion(&rows)) else {
            let mut last_ns = None;
            let is_new = |stamp_ns: &i64| last_ns.replace(*stamp_ns) != Some(*stamp_ns);
            let is_new: Vec<bool> = stamps_ns.iter().map(is_new).collect();
            retain(&mut rows, &is_new);
            stamps_ns.dedup();
            return (Self::new(first_ns, since_first_s(&stamps_ns), rows), None, is_new);
        };
        let begins_s = t_s.first().copied().unwrap_or_default();
        t_s.iter_mut().for_each(|t_s| *t_s -= begins_s);
        (Self::new(later_ns(first_ns, begins_s), t_s, rows), Some(stamps), Vec::new())
    }

    /// The stream with another limit above which there is a gap \[s\].
    pub fn with_gap_limit(self, gap_limit_s: f64) -> Self {
        Self { gap_limit_s, ..self }
    }

    /// Appends a row. Its stamp \[ns\] must be later than that of the last row.
    pub fn push(&mut self, stamp_ns: i64, row: R) {
        if self.rows.is_empty() {
            self.first_stamp_ns = stamp_ns;
        }
        let since_first_ns = i128::from(stamp_ns) - i128::from(self.first_stamp_ns);
        self.t_s.push(since_first_ns as f64 * 1e-9);
        self.rows.push(row);
    }

    /// Time from the first to the last row \[s\].
    pub fn duration_s(&self) -> f64 {
        self.t_s.last().copied().unwrap_or(0.0)
    }

    /// Median time between neighbouring rows \[s\].
    pub fn period_s(&self) -> f64 {
        usual_and_longest_step_s(&self.t_s)[0]
    }

    /// Time of row `index` on the stream's clock \[ns\], if there is such a row.
    pub fn stamp_ns(&self, index: usize) -> Option<i64> {
        self.t_s.get(index).map(|t_s| later_ns(self.first_stamp_ns, *t_s))
    }

    /// A stream of the results of `convert` on each row, at the same times.
    pub fn map<S>(&self, convert: impl FnMut(&R) -> S) -> Stream<S> {
        Stream {
            first_stamp_ns: self.first_stamp_ns,
            t_s: self.t_s.clone(),
            rows: self.rows.iter().map(convert).collect(),
            gap_limit_s: self.gap_limit_s,
        }
    }

    /// A stream of the results of `convert` on the rows with these indices. Rows for which `convert` returns
    /// `None` are left out.
    pub fn filter_map<S>(
        &self,
        indices: Range<usize>,
        mut convert: impl FnMut(usize, &R) -> Option<S>,
    ) -> Stream<S> {
        let mut kept = Stream { gap_limit_s: self.gap_limit_s, ..Stream::default() };
        let mut begins_s = 0.0;
        for index in indices.start..indices.end.min(self.rows.len()) {
            let Some(row) = convert(index, &self.rows[index]) else { continue };
            if kept.rows.is_empty() {
                begins_s = self.t_s[index];
                kept.first_stamp_ns = later_ns(self.first_stamp_ns, begins_s);
            }
            kept.t_s.push(self.t_s[index] - begins_s);
            kept.rows.push(row);
        }
        kept
    }

    /// Index of the first row of the interval between two rows that contains the time; `None` outside the stream.
    pub(super) fn interval(&self, t_s: f64) -> Option<usize> {
        // Most rows are evenly spaced, so the interval is near the row that is estimated from the time. A search through all
        // of a long log would be slow, because the log is not in the cache.
        let guess = (t_s / self.duration_s() * self.t_s.len().saturating_sub(1) as f64) as usize;
        let near = guess.saturating_sub(1)..guess.saturating_add(3).min(self.t_s.len());
        let around = self.t_s.get(near.clone()).unwrap_or_default();
        let is_within = around.first().is_some_and(|from_s| *from_s <= t_s)
            && around.last().is_some_and(|to_s| t_s < *to_s);
        let (times_s, before) = if is_within { (around, near.start) } else { (&*self.t_s, 0) };
        let after = before + times_s.partition_point(|stamp_s| *stamp_s <= t_s);
        // The last row belongs to the interval before it.
        let row = if self.t_s.last() == Some(&t_s) { after.checked_sub(2)? } else { after.checked_sub(1)? };
        (row + 1 < self.rows.len()).then_some(row)
    }
}

impl<R: Row> Stream<R> {
    /// The parts of the stream without gaps in which the numbers are continuous from row to row, in the order of
    /// time. No part is empty.
    pub fn parts(&self) -> Vec<Range<usize>> {
        self.parts_within(self.gap_limit_s)
    }

    /// Like [`Self::parts`], but with another limit above which there is a gap \[s\].
    pub fn parts_within(&self, gap_limit_s: f64) -> Vec<Range<usize>> {
        let mut parts = Vec::new();
        let mut start = 0;
        for end in 1..=self.rows.len() {
            if end == self.rows.len() || !self.is_continued(end - 1, gap_limit_s) {
                parts.push(start..end);
                start = end;
            }
        }
        parts
    }

    /// Whether there is neither a gap nor a restart of counters between this row and the next one.
    fn is_continued(&self, row: usize, gap_limit_s: f64) -> bool {
        self.t_s[row + 1] - self.t_s[row] <= gap_limit_s && self.rows[row + 1].continues(&self.rows[row])
    }

    /// A stream of the rows with these indices.
    pub fn slice(&self, indices: Range<usize>) -> Self {
        self.filter_map(indices, |_, row| Some(*row))
    }

    /// The numbers at a time after the first row \[s\], by linear interpolation between two rows, because a spline would
    /// overshoot at jumps. `None` outside the stream and in gaps.
    pub fn at(&self, t_s: f64) -> Option<R> {
        let row = self.interval(t_s)?;
        let (from, to) = (&self.rows[row], &self.rows[row + 1]);
        let part = (t_s - self.t_s[row]) / (self.t_s[row + 1] - self.t_s[row]);
        if part == 0.0 {
            return Some(*from);
        }
        let (a, b) = (from.numbers(), to.numbers());
        self.is_continued(row, self.gap_limit_s).then(|| from.with_numbers(|i| a[i] + part * (b[i] - a[i])))
    }
}

/// The stamp plus a number of seconds \[ns\].
fn later_ns(stamp_ns: i64, by_s: f64) -> i64 {
    stamp_ns.saturating_add((by_s * 1e9).round() as i64)
}
