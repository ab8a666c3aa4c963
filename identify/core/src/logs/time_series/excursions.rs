//! Finds excursions: rows that jump away and back faster than any motion. They were not measured. A logger or an instrument
//! writes such values, mostly zeros, in place of missing values. Logs of robots, bars and trackers are searched for excursions
//! before their rows are used for anything else. [`Excursions::find`] searches, [`remark`] reports the excursions found.

use std::path::Path;

use shared::output::named;

use super::resolution::{SAMPLED_ROWS, resolutions};
use super::sampling::STEPS_PART;
use crate::logs::LogError;
use crate::statistics::{quantile, trimmed_mean};

/// Largest number of successive excursions. Even if a fraction [`SHARE_MAX`] of all rows were independent excursions, a
/// longer run would begin at only one row in a billion.
const ROWS_MAX: usize = 8;
/// An excursion exceeds this multiple of the noise of the log. The noise is the lower quartile of the second differences of
/// the log, without those that are zero, but at least the resolution. For normal noise, this limit is 9.4 standard deviations
/// beyond both neighbours, which occurs by chance in one row in 10^14. For values with a coarse resolution, this limit is
/// twelve steps of the resolution.
const NOISE_QUARTILES: f64 = 12.0;
/// A log with a larger fraction of excursions is rejected.
const SHARE_MAX: f64 = 0.1;
/// Largest number of places that are listed in a message.
const NAMED_MAX: usize = 5;

/// Upper bounds of speed and acceleration for any motion that can be measured.
#[derive(Debug, Clone, Copy)]
pub(in crate::logs) struct Fastest {
    /// Largest speed \[rad/s, m/s\].
    pub speed: f64,
    /// Largest acceleration \[rad/s², m/s²\].
    pub acceleration: f64,
}

/// Rows of a log that are searched for excursions.
pub(in crate::logs) struct Excursions<'a, S> {
    /// Times of the rows \[s\], which do not decrease.
    pub t_s: &'a [f64],
    /// Number of values of each row.
    pub columns: usize,
    pub fastest: Fastest,
    /// Change of a value from one row to another: `step(from, to, column)` \[rad, m\].
    pub step: S,
}

impl<S: Fn(usize, usize, usize) -> f64> Excursions<'_, S> {
    /// The indices of the excursions, in increasing order. The *neighbours* of a row are the nearest rows before and after
    /// it that are not excursions. A row is an excursion if a value is beyond the values of both neighbours by more than
    /// each of these limits:
    ///
    /// - the distance that the fastest motion can go and come back between the neighbours,
    /// - the noise of the log ([`NOISE_QUARTILES`]),
    /// - the difference between the neighbours.
    ///
    /// The fastest motion must also be able to reach one neighbour from the other. Rows that could be
    /// motion are therefore kept.
    pub fn find(&self) -> Vec<usize> {
        // Period and noise of the log, from a sample of its rows.
        let every = self.t_s.len().div_ceil(SAMPLED_ROWS).max(1);
        let sampled_s: Vec<f64> = self.t_s.iter().step_by(every).copied().collect();
        let steps_s = sampled_s.windows(2).map(|pair| (pair[1] - pair[0]) / every as f64);
        let period_s = trimmed_mean(steps_s.collect(), STEPS_PART).unwrap_or_default();
        // Rounding errors of a conversion make equal second differences unequal, so that the quartile may be far below
        // the resolution.
        let noise: Vec<f64> = (0..)
            .zip(resolutions(self.t_s.len(), self.columns, &self.step))
            .map(|(column, resolution)| {
                NOISE_QUARTILES * self.second_difference(column, every).max(resolution)
            })
            .collect();
        let (mut excursions, mut before) = (Vec::new(), 0);
        // Change of each value per row: from the last accepted row to the row `before`, and from `before` to the next row.
        let (mut last_step, mut next_step) = (vec![0.0; self.columns], vec![0.0; self.columns]);
        let step_per_row = |from: usize, to: usize, per_row: &mut [f64]| {
            for (column, per_row) in per_row.iter_mut().enumerate() {
                *per_row = (self.step)(from, to, column) / (to - from) as f64;
            }
        };
        while before + 2 < self.t_s.len() {
            step_per_row(before, before + 1, &mut next_step);
            // A row that continues the motion is not checked, to save time. At an excursion, the change per row differs from
            // the change before it.
            let leaves_motion = (0..self.columns)
                .any(|column| (next_step[column] - last_step[column]).abs() > 0.5 * noise[column]);
            // The longest run is tried first. With a shorter run, another row of the same excursion would be taken for the
            // first row after it.
            let run = (1..=ROWS_MAX)
                .rev()
                .filter(|_| leaves_motion)
                .find(|rows| self.is_excursion(before, *rows, period_s, &noise));
            let after = before + 1 + run.unwrap_or_default();
            if run.is_some() {
                step_per_row(before, after, &mut next_step);
            }
            std::mem::swap(&mut last_step, &mut next_step);
            excursions.extend(before + 1..after);
            before = after;
        }
        excursions
    }

    /// Whether the `rows` rows after the row `before` are an excursion. Their neighbours are the row `before` and the
    /// first row after them. A motion with acceleration `a` that turns back within the time `T` between the neighbours
    /// goes beyond them by at most `a T^2 / 8`.
    fn is_excursion(&self, before: usize, rows: usize, period_s: f64, noise: &[f64]) -> bool {
        let after = before + rows + 1;
        let Some(after_s) = self.t_s.get(after) else { return false };
        // Stamps may be late, or equal for several rows, so the time is at least that of the regular clock.
        let apart_s = (after_s - self.t_s[before]).max((rows + 1) as f64 * period_s);
        let distance_max = self.fastest.speed * apart_s;
        let turning_max = self.fastest.acceleration * apart_s.powi(2) / 8.0;
        let to_after = |column: usize| (self.step)(before, after, column);
        let distance = (0..self.columns).map(|column| to_after(column).abs()).fold(0.0, f64::max);
        let is_beyond = |row: usize, column: usize| {
            let (to_row, to_after) = ((self.step)(before, row, column), to_after(column));
            let beyond = (to_row - to_after.max(0.0)).max(to_after.min(0.0) - to_row);
            // The row `after` may itself be an excursion. In this case `distance` is large, so the correct rows between the
            // neighbours are not taken for excursions.
            beyond > turning_max.max(noise[column]).max(distance)
        };
        distance <= distance_max
            && (before + 1..after).all(|row| (0..self.columns).any(|column| is_beyond(row, column)))
    }

    /// Lower quartile of the second differences other than zero, as a measure of noise. Most second differences come from
    /// resolution and noise, because excursions are rare and each contributes only three.
    fn second_difference(&self, column: usize, every: usize) -> f64 {
        let rows = (1..self.t_s.len().saturating_sub(1)).step_by(every);
        let sizes = rows.map(|row| (self.step)(row, row + 1, column) - (self.step)(row - 1, row, column));
        let mut sizes: Vec<f64> = sizes.map(f64::abs).filter(|size| *size > 0.0).collect();
        quantile(&mut sizes, 0.25)
    }
}

/// The remark on excursions in the file `path`; `None` without excursions. `places` are their places, such as line numbers.
/// `what` is the word for a row, and `done` is how the excursions are treated.
///
/// # Errors
/// [`LogError::Content`] if more than a tenth of all `rows` are excursions.
pub(in crate::logs) fn remark(
    places: &[u64],
    rows: usize,
    (path, what): (&Path, &str),
    done: &str,
) -> Result<Option<String>, LogError> {
    let count = places.len();
    if count == 0 {
        return Ok(None);
    }
    let named = named(places, NAMED_MAX);
    let whose = "jump away from those before and after them, faster than anything moves";
    if count as f64 > SHARE_MAX * rows as f64 {
        let problem = format!("{count} of {rows} {what}s {whose} ({what} {named})");
        let remedy = "find out what writes these values, remove them, or log again";
        return Err(LogError::content(path, problem, remedy));
    }
    Ok(Some(format!(
        "{count} of {rows} {what}s {whose} ({what} {named}): {done}; find out what writes these values, often zeros for a missing one"
    )))
}
