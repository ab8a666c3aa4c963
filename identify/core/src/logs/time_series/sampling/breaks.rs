//! Finds the rows at which the clock of the stamps was set. The input is the rest of each stamp: stamp minus number times
//! period. A step is a row at which the mean of the rests changes by much more than their scatter.

use std::ops::Range;

use crate::statistics::{median, trimmed_mean};

/// Smallest number of rows on either side of a step.
pub(super) const BESIDE: usize = 25;
/// Shortest time on either side of a step \[s\]. It is longer than a delay of rows, so that a delay is not taken for a step.
const BESIDE_S: f64 = 0.5;

/// Number of rows on either side of a step, for a clock with this period.
pub(super) fn rows_beside(period_s: f64) -> usize {
    BESIDE.max((BESIDE_S / period_s) as usize)
}

/// Returns the first row after each step of more than `rounding_s` of the stamps relative to a regular clock. `None` if
/// there are too many steps.
pub(super) fn find_breaks(rest_s: &[f64], period_s: f64, rounding_s: f64) -> Option<Vec<usize>> {
    /// Smallest step of the clock that is searched for \[s\]. In this time the fastest joint of a calibration turns by 0.1
    /// mrad, which is as much as the errors of its gears.
    const STEP_S_MIN: f64 = 1e-4;
    /// Smallest step in standard deviations of the jitter of one stamp. This is ten standard deviations of the difference of
    /// two means of [`BESIDE`] rows.
    const STEP_SIGMAS: f64 = 3.0;
    /// A log with more steps has no regular clock. NTP steps a clock that it cannot slew at most once in five minutes (its
    /// step-out threshold). With this number of steps the clock was therefore not synchronised for more than three hours.
    const STEPS_MAX: usize = 40;
    /// The step may be at any row at which the difference of the means is above this fraction of the largest difference.
    const NEARLY: f64 = 0.9;
    let beside = rows_beside(period_s);
    // The mean of the middle half is used because the median of rounded stamps jumps from one multiple of the grid to the next.
    let middle_s = |range: Range<usize>| trimmed_mean(rest_s[range].to_vec(), 0.25).unwrap_or_default();
    // Size of a possible step at a row: the difference between the means on both sides.
    let step_s = |at: usize| (middle_s(at..at + beside) - middle_s(at - beside..at)).abs();
    // Mean deviation of the rests from their mean, over the `beside` rows from `from` on.
    let scatter_s = |from: usize| {
        let middle_s = middle_s(from..from + beside);
        rest_s[from..from + beside].iter().map(|rest| (rest - middle_s).abs()).sum::<f64>() / beside as f64
    };
    let end = (rest_s.len() + 1).saturating_sub(beside);
    let mut scatters: Vec<f64> = (0..end).step_by(beside).map(scatter_s).collect();
    // The mean absolute value of a normal distribution is 0.8 standard deviations.
    let limit_s = (STEP_SIGMAS * 1.25 * median(&mut scatters)?).max(STEP_S_MIN).max(rounding_s);
    let mut breaks: Vec<usize> = Vec::new();
    let mut at = beside;
    while at < end {
        if step_s(at) <= limit_s {
            at += (beside / 5).max(1);
            continue;
        }
        let sizes: Vec<(usize, f64)> = (at..(at + 2 * beside).min(end)).map(|at| (at, step_s(at))).collect();
        let largest_s = sizes.iter().map(|(_, size_s)| *size_s).fold(0.0, f64::max);
        // The means determine the row of the step only to within a few rows. Among these rows, the step is at the row at
        // which two successive rests differ most.
        let single_step_s = |at: usize| (rest_s[at] - rest_s[at - 1]).abs();
        let near = sizes.iter().filter(|(_, size_s)| *size_s > NEARLY * largest_s).map(|(at, _)| *at);
        let best = near.max_by(|a, b| single_step_s(*a).total_cmp(&single_step_s(*b)))?;
        breaks.push(best);
        if breaks.len() > STEPS_MAX {
            return None;
        }
        at = best + beside;
    }
    Some(breaks)
}
