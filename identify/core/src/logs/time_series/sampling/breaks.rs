//! The rows at which the clock of the stamps was set.

use std::ops::Range;

use crate::statistics::{median, trimmed_mean};

/// Smallest number of rows on either side of a step.
pub(super) const BESIDE: usize = 25;
/// Shortest time on either side of a step \[s\]: delayed rows are late for a shorter time.
const BESIDE_S: f64 = 0.5;

/// Number of rows on either side of a step at this period.
pub(super) fn rows_beside(period_s: f64) -> usize {
    BESIDE.max((BESIDE_S / period_s) as usize)
}

/// First rows after the steps, of more than `rounding_s`, of the stamps against a regular clock; `None` if there are too many.
pub(super) fn find_breaks(rest_s: &[f64], period_s: f64, rounding_s: f64) -> Option<Vec<usize>> {
    /// Smallest step of the clock that is searched for \[s\]: the fastest joint of a calibration turns by 0.1 mrad in it, as much
    /// as the errors of its gears.
    const STEP_S_MIN: f64 = 1e-4;
    /// Smallest step in standard deviations of the jitter: of means of [`BESIDE`] rows this is ten.
    const STEP_SIGMAS: f64 = 3.0;
    /// A log with more steps has no regular clock: NTP steps a clock that it cannot slew at most once in five minutes (its
    /// step-out threshold), so that these are three hours of an unsynchronised clock.
    const STEPS_MAX: usize = 40;
    /// Part of the largest difference that places near the step have, too.
    const NEARLY: f64 = 0.9;
    let beside = rows_beside(period_s);
    // The mean of the middle half: a median of stamps that are rounded leaps from one multiple to the next.
    let middle_s = |range: Range<usize>| trimmed_mean(rest_s[range].to_vec(), 0.25).unwrap_or_default();
    let step_s = |at: usize| (middle_s(at..at + beside) - middle_s(at - beside..at)).abs();
    let scatter_s = |from: usize| {
        let middle_s = middle_s(from..from + beside);
        rest_s[from..from + beside].iter().map(|rest| (rest - middle_s).abs()).sum::<f64>() / beside as f64
    };
    let end = (rest_s.len() + 1).saturating_sub(beside);
    let mut scatters: Vec<f64> = (0..end).step_by(beside).map(scatter_s).collect();
    // Of a normal distribution the mean size is 0.8 standard deviations.
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
        // Means of many rows give the place to a few rows only; the step itself is between two.
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
