//! Common functions of two searches: the search for the clock of a recording (`find`), and the search for the clock of
//! a tracker's log (`tracker`).
//!
//! Both searches first compare a section of the log of limited length, the *window* ([`liveliest`]). They choose the best of
//! several fits in the window ([`best`]), and extend this fit step by step to the whole log ([`extended`]).

use std::ops::Range;

use super::correlate::{Match, longest_overlap};
use crate::prepare::{ComparedLog, PrepareError, PrepareOptions};

/// Longest window \[s\]. In a longer window, clocks with different rates would drift too far apart.
pub(in crate::prepare) const WINDOW_S: f64 = 900.0;
/// Factor by which the window grows from one fit to the next.
const GROWTH: f64 = 4.0;
/// Largest number of shifts that are taken from each correlation of speeds. At each of these shifts, the angles or
/// positions are then compared.
pub(in crate::prepare) const CANDIDATES: usize = 6;
/// Two fits whose residuals differ by less than this factor count as equally good. This occurs if the motion repeats.
const TIE: f64 = 1.2;

/// Returns the window with the most motion, as a range of the samples at the times `t_s` \[s\]. `travel` returns the travel
/// between two neighbouring samples. A log that is not longer than [`WINDOW_S`] is one window.
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

/// Smallest overlap that two logs with the durations `one_s` and `other_s` must have \[s\].
pub(in crate::prepare) fn overlap_min_s(options: &PrepareOptions, one_s: f64, other_s: f64) -> f64 {
    options.overlap_min_s.max(options.overlap_min_part * one_s.min(other_s))
}

/// The best of several fits.
#[derive(Debug)]
pub(in crate::prepare) struct Best<F> {
    /// Match of the speeds at the shift of this fit.
    pub matched: Match,
    /// Whether another shift fits equally well.
    pub ambiguous: bool,
    pub fit: F,
}

/// Chooses, among the fits with the smallest residuals, the one with the longest overlap of the logs. If the motion
/// repeats, several fits are equally good. The fit with the longest overlap is then the most likely. `are_apart` returns
/// whether two fits have different shifts.
pub(in crate::prepare) fn best<F>(
    mut fits: Vec<(Match, F)>,
    spread: impl Fn(&F) -> f64,
    are_apart: impl Fn(&F, &F) -> bool,
) -> Option<Best<F>> {
    let least = fits.iter().map(|(_, fit)| spread(fit)).fold(f64::INFINITY, f64::min);
    fits.retain(|(_, fit)| spread(fit) <= TIE * least);
    let differs_from_earlier =
        |index: usize| fits[..index].iter().any(|(_, other)| are_apart(&fits[index].1, other));
    let ambiguous = (0..fits.len()).any(differs_from_earlier);
    let (matched, fit) = longest_overlap(fits, |(matched, _)| matched)?;
    Some(Best { matched, ambiguous, fit })
}

/// Extends a fit from its window to the whole log, step by step. A clock that was fitted to a quarter of an hour is accurate
/// enough as start value for a fit to a whole hour.
///
/// # Errors
/// [`PrepareError::NothingToFit`] if `refit` returns `None`.
pub(in crate::prepare) fn extended<F>(
    t_s: &[f64],
    mut window: Range<usize>,
    mut fit: F,
    refit: impl Fn(&Range<usize>, &F) -> Option<F>,
) -> Result<F, PrepareError> {
    while window != (0..t_s.len()) {
        window = wider(t_s, &window);
        fit = refit(&window, &fit).ok_or(PrepareError::NothingToFit)?;
    }
    Ok(fit)
}

/// Makes the window [`GROWTH`] times as long, with the same middle.
fn wider(t_s: &[f64], window: &Range<usize>) -> Range<usize> {
    let time_s = |index: usize| t_s.get(index).copied().unwrap_or_default();
    let (from_s, to_s) = (time_s(window.start), time_s(window.end.saturating_sub(1)));
    let added_s = 0.5 * (GROWTH - 1.0) * (to_s - from_s).max(1.0);
    let from = t_s.partition_point(|t_s| *t_s < from_s - added_s);
    let to = t_s.partition_point(|t_s| *t_s <= to_s + added_s);
    from..to
}

/// The error for two logs whose speeds match at no shift. `highest` is the highest correlation that was found and the
/// overlap at its shift \[s\]; `None` if no shift has speeds in both logs for `overlap_min_s`.
pub(in crate::prepare) fn no_match(
    other: ComparedLog,
    highest: Option<(f64, f64)>,
    overlap_min_s: f64,
    options: &PrepareOptions,
) -> PrepareError {
    match highest {
        Some((correlation, overlap_s)) => {
            PrepareError::NoMatch { other, correlation, overlap_s, needed: options.correlation_min }
        }
        None => PrepareError::NoSpeeds { other, needed_s: overlap_min_s },
    }
}
