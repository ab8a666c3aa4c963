//! Finds numbers that are constant while other numbers change, because the value was not read, and rows that repeat in
//! the middle of a motion.
//!
//! `prepare` and `identify inspect` search for constant numbers. Logs of robots and bars are searched for repeated
//! rows when they are read.

use std::ops::Range;

use super::resolution::{RESOLUTION_STEPS, resolutions};
use super::stream::{Row, Stream, ranges};

/// While a number is constant, another number must change by more than this \[rad, m\].
const OTHER_CHANGE_MIN: f64 = 0.1;
/// A number that was not read changes by more than this when it is read again. A number that was really constant changes
/// gradually from its value \[rad, m\].
const LEAP_MIN: f64 = 0.02;

impl<R: Row> Stream<R> {
    /// For each number, the first range of rows in which it is constant although another number changes. The number must
    /// jump after the range. `is_long` decides whether a range is long enough. After a range at the end of the log there is
    /// no jump, so `at_end` decides whether it counts.
    pub fn constant_ranges(
        &self,
        is_long: impl Fn(&Range<usize>) -> bool,
        at_end: impl Fn(usize, &Range<usize>) -> bool,
    ) -> Vec<Option<Range<usize>>> {
        let width = self.first().map_or(0, |row| row.numbers().len());
        let (mut starts, mut constant) = (vec![0; width], vec![None; width]);
        for row in 1..=self.len() {
            for column in 0..width {
                let before = &self[row - 1];
                let next = self.get(row).filter(|next| next.continues(before));
                if next.is_some_and(|next| next.numbers()[column] == before.numbers()[column]) {
                    continue;
                }
                let range = std::mem::replace(&mut starts[column], row)..row;
                if constant[column].is_some() || !is_long(&range) {
                    continue;
                }
                let leaps = match next {
                    Some(next) => (next.numbers()[column] - before.numbers()[column]).abs() > LEAP_MIN,
                    None => row == self.len() && at_end(column, &range),
                };
                let mut others =
                    (0..).zip(ranges(&self[range.clone()])).filter(|(other, _)| *other != column);
                let others_change = |[low, high]: [f64; 2]| high - low > OTHER_CHANGE_MIN;
                let is_fault = leaps && others.any(|(_, range)| others_change(range));
                constant[column] = is_fault.then_some(range);
            }
        }
        constant
    }
}

/// Largest change of a number from one row to the next at standstill \[rad, m\]. Repeated rows are only found between changes
/// that are larger by [`RESOLUTION_STEPS`], which are a motion.
const REPEATED_STEP_RAD: f64 = 1e-4;

/// Indices of rows that repeat the row before in the middle of a motion, in runs of at most `run_max`. A logger that
/// polls faster than its source updates writes the same row several times. In the middle of a motion, some number
/// changes in the same direction before and after these rows. `step(from, to, column)` is the change of a number.
pub(in crate::logs) fn repeated_rows(
    rows: usize,
    columns: usize,
    run_max: usize,
    step: impl Fn(usize, usize, usize) -> f64,
) -> Vec<usize> {
    let limits: Vec<f64> = resolutions(rows, columns, &step)
        .into_iter()
        .map(|resolution| REPEATED_STEP_RAD + RESOLUTION_STEPS * resolution)
        .collect();
    let (mut repeated, mut last_change) = (Vec::new(), 0);
    // Steps of the last two rows that differ from the row before.
    let (mut before, mut after) = (vec![0.0_f64; columns], vec![0.0_f64; columns]);
    for row in 1..rows {
        after.iter_mut().enumerate().for_each(|(column, after)| *after = step(row - 1, row, column));
        if after.iter().all(|after| *after == 0.0) {
            continue;
        }
        let moves = |column: usize| {
            let is_motion = before[column].abs().min(after[column].abs()) > limits[column];
            is_motion && before[column] * after[column] > 0.0
        };
        if row - last_change - 1 <= run_max && (0..columns).any(moves) {
            repeated.extend(last_change + 1..row);
        }
        std::mem::swap(&mut before, &mut after);
        last_change = row;
    }
    repeated
}
