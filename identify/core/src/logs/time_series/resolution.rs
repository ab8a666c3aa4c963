//! Estimates the resolution of a log: the step of which all values of a column are multiples.
//!
//! If values are rounded, a slow motion consists of equal rows and of changes by one step. The searches for excursions and for
//! repeated rows therefore tolerate a number of steps. The remark of a robot's log states the step if it is coarse.

use super::stream::{Row, Stream};
use crate::statistics::mean;

/// A row that is equal to the row before was not measured if a column changes by more than this number of steps before and
/// after it. A joint that stops and continues with a constant acceleration `a` moves by `a T^2 / 4` in the period `T` of the
/// stop, and by `a T^2` in the next period. If it moves by less than one step at the stop, so that the rounded values may be
/// equal, it moves by less than four steps beside it.
pub const RESOLUTION_STEPS: f64 = 4.0;
/// Approximate number of rows of a long log from which its properties are estimated.
pub(super) const SAMPLED_ROWS: usize = 100_000;

impl<R: Row> Stream<R> {
    /// The step of each number, of which all values are multiples; zero if there is no such step.
    pub fn resolutions(&self) -> Vec<f64> {
        let columns = self.first().map_or(0, |row| row.numbers().len());
        let step =
            |from: usize, to: usize, column: usize| self[to].numbers()[column] - self[from].numbers()[column];
        resolutions(self.len(), columns, step)
    }
}

/// The resolution of each column \[rad, m\]; zero if the values are not rounded, or rounded so finely that it has no effect.
/// `step(from, to, column)` is the change of a value from one row to another.
pub(in crate::logs) fn resolutions(
    rows: usize,
    columns: usize,
    step: impl Fn(usize, usize, usize) -> f64,
) -> Vec<f64> {
    (0..columns).map(|column| resolution(rows, |from, to| step(from, to, column))).collect()
}

/// The resolution of one column. The fourth differences of a smooth motion are almost zero. If they are not zero, the reason
/// is noise or rounding. If it is rounding, these differences and the changes beside them are multiples of one step.
fn resolution(rows: usize, step: impl Fn(usize, usize) -> f64) -> f64 {
    /// Smaller differences are neglected \[rad, m\]: the noise of a robot's joints is larger.
    const FINE: f64 = 1e-5;
    /// Smallest number of differences. Fewer of them could be multiples of one step by chance.
    const DIFFERENCES_MIN: usize = 100;
    /// A multiple differs from a whole number of steps by less than this fraction of a step, because angles may be rounded
    /// again after a conversion.
    const WHOLE: f64 = 0.1;
    /// Smallest fraction of differences that are multiples. Of differences without a step, 0.2 are multiples by chance.
    /// Excursions need not be multiples of the step.
    const MULTIPLES_MIN: f64 = 0.75;
    /// Largest resolution \[rad, m\]. If a joint at rest has excursions to one value, their size is not a resolution.
    const COARSEST: f64 = 0.02;
    let every = rows.div_ceil(SAMPLED_ROWS).max(1);
    let differences = |row: usize| {
        let [first, second, third, last]: [f64; 4] =
            std::array::from_fn(|index| step(row + index, row + index + 1));
        [first, second, third, last, last - 3.0 * third + 3.0 * second - first].map(f64::abs)
    };
    let sizes: Vec<f64> = (0..rows.saturating_sub(4))
        .step_by(every)
        .map(differences)
        .filter(|[.., fourth_difference]| *fourth_difference > FINE)
        .flatten()
        .filter(|size| *size > FINE)
        .collect();
    if sizes.len() < DIFFERENCES_MIN {
        return 0.0;
    }
    let smallest = sizes.iter().copied().fold(f64::INFINITY, f64::min);
    let resolution = mean(sizes.iter().filter(|size| **size < 1.5 * smallest));
    let is_multiple = |size: f64| (size / resolution - (size / resolution).round()).abs() < WHOLE;
    let multiples = sizes.iter().filter(|size| is_multiple(**size)).count();
    let is_resolution = resolution < COARSEST && multiples as f64 > MULTIPLES_MIN * sizes.len() as f64;
    if is_resolution { resolution } else { 0.0 }
}
