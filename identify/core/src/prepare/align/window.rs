//! What the search for the clock of a recording (`find`) and that of a tracker's log (`tracker`) share: the window, the part of
//! the log that is compared first; the selection among fits; the extension of a fit to the whole log.

use std::ops::Range;

use super::correlate::{Match, longest_overlap};
use crate::prepare::{ComparedLog, PrepareError, PrepareOptions};

/// Longest window \[s\]: over a longer one clocks of different rates drift apart.
pub(in crate::prepare) const WINDOW_S: f64 = 900.0;
/// The window grows by this factor from fit to fit.
const GROWTH: f64 = 4.0;
/// Number of shifts by each kind of correlation at which more than speeds are compared.
pub(in crate::prepare) const CANDIDATES: usize = 6;
/// Two fits whose residuals differ by less than this factor are equally good: the motion repeats.
const TIE: f64 = 1.2;

/// The part with the most motion of samples at `t_s`; `travel` is the travel between two neighbours.
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

/// How long two logs of these lengths must overlap \[s\].
pub(in crate::prepare) fn overlap_min_s(options: &PrepareOptions, one_s: f64, other_s: f64) -> f64 {
    options.overlap_min_s.max(options.overlap_min_part * one_s.min(other_s))
}

/// The best of several fits.
#[derive(Debug)]
pub(in crate::prepare) struct Best<F> {
    /// How the speeds match at its shift.
    pub matched: Match,
    /// Another shift fits as well.
    pub ambiguous: bool,
    pub fit: F,
}

/// Among the fits with the smallest residuals the one whose logs overlap longest: if several fit equally well the motion
/// repeats, and the longest overlap is the most likely. `are_apart` is true for two fits with different shifts.
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

/// Extends a fit from its window to the whole log, step by step: clocks that are known over a quarter of an hour are known well
/// enough for an hour.
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

/// The window, [`GROWTH`] times as long about the same middle.
fn wider(t_s: &[f64], window: &Range<usize>) -> Range<usize> {
    let time_s = |index: usize| t_s.get(index).copied().unwrap_or_default();
    let (from_s, to_s) = (time_s(window.start), time_s(window.end.saturating_sub(1)));
    let added_s = 0.5 * (GROWTH - 1.0) * (to_s - from_s).max(1.0);
    let from = t_s.partition_point(|t_s| *t_s < from_s - added_s);
    let to = t_s.partition_point(|t_s| *t_s <= to_s + added_s);
    from..to
}

/// The refusal of two logs whose speeds match nowhere: with the highest correlation that was found, and the overlap there \[s\].
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
