//! The part of a log by which it is searched for, and how it grows to the whole.

use std::ops::Range;

use crate::prepare::PrepareOptions;

/// A log is searched for by its liveliest part of at most this length \[s\]: over a longer one clocks of different rate drift
/// apart.
pub(in crate::prepare) const WINDOW_S: f64 = 900.0;
/// The window grows by this factor from fit to fit.
const GROWTH: f64 = 4.0;
/// Shifts by each kind of correlation at which more than speeds are compared.
pub(in crate::prepare) const CANDIDATES: usize = 6;

/// The part with the most motion of samples at `t_s`; `travel` is that between two neighbours.
pub(in crate::prepare) fn liveliest(t_s: &[f64], travel: impl Fn([usize; 2]) -> f64) -> Range<usize> {
    let duration_s = t_s.last().zip(t_s.first()).map_or(0.0, |(last, first)| last - first);
    if duration_s <= WINDOW_S {
        return 0..t_s.len();
    }
    let first_s = t_s.first().copied().unwrap_or_default();
    let index_at = |since_first_s: f64| t_s.partition_point(|t_s| *t_s < first_s + since_first_s);
    let windows =
        (0..).map(|half| 0.5 * WINDOW_S * f64::from(half)).take_while(|from_s| *from_s < duration_s);
    let travel = |range: &Range<usize>| -> f64 {
        (range.start + 1..range.end).map(|sample| travel([sample - 1, sample])).sum()
    };
    windows
        .map(|from_s| index_at(from_s)..index_at(from_s + WINDOW_S))
        .max_by(|a, b| travel(a).total_cmp(&travel(b)))
        .unwrap_or(0..t_s.len())
}

/// The next larger part: clocks that are known over a quarter of an hour are known well enough for an hour.
pub(in crate::prepare) fn wider(t_s: &[f64], window: &Range<usize>) -> Range<usize> {
    let at = |index: usize| t_s.get(index).copied().unwrap_or_default();
    let (from_s, to_s) = (at(window.start), at(window.end.saturating_sub(1)));
    let more_s = 0.5 * (GROWTH - 1.0) * (to_s - from_s).max(1.0);
    let from = t_s.partition_point(|t_s| *t_s < from_s - more_s);
    let to = t_s.partition_point(|t_s| *t_s <= to_s + more_s);
    from..to
}

/// How long two logs of these lengths must overlap \[s\].
pub(in crate::prepare) fn overlap_min_s(options: &PrepareOptions, one_s: f64, other_s: f64) -> f64 {
    options.overlap_min_s.max(options.overlap_min_part * one_s.min(other_s))
}
