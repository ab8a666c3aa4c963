//! Estimates the period of the regular clock and the number of each row on this clock.
//!
//! The inputs are the stamps and the number of periods from row to row by the motion, which is not always known. The number of
//! a row is the number of periods since the first row. [`correct_numbers`] repairs numbers after the curve has been fitted.

use super::breaks::rows_beside;
use super::motion::{PERIODS_MAX, WHOLE};
use crate::statistics::{median, trimmed_mean};

/// Number of rows of a segment. The period is first measured over each segment.
const LAG: usize = 32;
/// Fraction of the segments that is left out at either end of their sorted periods, because the clock may be
/// set within a segment.
pub(in crate::logs) const STEPS_PART: f64 = 0.02;

/// The period \[s\], from segments in which the motion determines the number of periods. If there are too few such segments,
/// the period is estimated from the stamps alone.
pub(super) fn estimate_period(t_s: &[f64], motion: &[Option<f64>]) -> Option<f64> {
    let by_motion = |from: usize| {
        let periods: Option<f64> = motion.get(from..from + LAG)?.iter().copied().sum();
        Some((t_s[from + LAG] - t_s[from]) / periods?)
    };
    let by_motion: Vec<f64> = (0..t_s.len()).filter_map(by_motion).collect();
    let period_s = if by_motion.len() > LAG {
        trimmed_mean(by_motion, STEPS_PART)
    } else {
        let usual_s = median(&mut t_s.windows(2).map(|pair| pair[1] - pair[0]).collect::<Vec<_>>());
        let mean_s = |stamps_s: &[f64]| (stamps_s[LAG] - stamps_s[0]) / LAG as f64;
        // If most rows have the stamp of the row before, the median is zero.
        usual_s
            .filter(|usual_s| *usual_s > 0.0)
            .or_else(|| trimmed_mean(t_s.windows(LAG + 1).map(mean_s).collect(), STEPS_PART))
    };
    period_s.filter(|period_s| *period_s > 0.0)
}

/// Twice the standard deviation of the stamps relative to the clock \[s\], from segments in which the motion is known.
fn jitter_s(t_s: &[f64], motion: &[Option<f64>], period_s: f64) -> f64 {
    // Mean absolute deviation of the stamps in the segment that begins at row `from`.
    let scatter_s = |from: usize| {
        let mut number = 0.0;
        let segment = motion.get(from..from + LAG)?.iter().zip(&t_s[from + 1..]);
        let rest_s: Option<Vec<f64>> = segment
            .map(|(periods, t_s)| {
                number += (*periods)?;
                Some(t_s - period_s * number)
            })
            .collect();
        let rest_s = rest_s?;
        let mean_s = rest_s.iter().sum::<f64>() / rest_s.len() as f64;
        Some(rest_s.iter().map(|rest_s| (rest_s - mean_s).abs()).sum::<f64>() / rest_s.len() as f64)
    };
    let mut scatters: Vec<f64> = (0..t_s.len()).step_by(LAG).filter_map(scatter_s).collect();
    // The mean absolute value of a normal distribution is 0.8 standard deviations.
    2.5 * median(&mut scatters).unwrap_or_default()
}

/// Number of each row on the clock, from 0. Where the motion is known, it determines the number, and a late stamp is a step
/// of the clock. Where the motion is unknown, the number is one more than the number of the row before. It is increased
/// further if this row and the rows after it are later than jitter and rounding (up to `rounding_s`) explain.
pub(super) fn number_rows(t_s: &[f64], motion: &[Option<f64>], period_s: f64, rounding_s: f64) -> Vec<f64> {
    /// Number of rows over which the phase follows the stamps. The period is known to a thousandth, so the phase lags by
    /// less than half a period. The phase follows so slowly that missing rows do not change it.
    const PHASE_ROWS: f64 = 200.0;
    /// Time after a row \[s\]. The number of the row is only increased if three quarters of the rows in this time are late.
    /// The delay of single rows is shorter than this time.
    const LASTS_S: f64 = 0.1;
    let lasting_rows = ((LASTS_S / period_s) as usize).max(5);
    let explained_periods = (jitter_s(t_s, motion, period_s).max(rounding_s) / period_s).max(0.5);
    // The phase is the time of the row with number 0.
    let first =
        t_s.iter().take(lasting_rows).zip(0..).map(|(t_s, number)| t_s - period_s * f64::from(number));
    let mut phase_s = median(&mut first.collect::<Vec<_>>()).unwrap_or_default();
    let mut numbers = vec![0.0];
    for (row, motion) in (1..t_s.len()).zip(motion) {
        let before = numbers.last().copied().unwrap_or_default();
        // Number of periods by which this row and three quarters of the rows after it are late (negative: early), if this
        // row has the given `number`.
        let lasting_delay = |number: f64| {
            let next = t_s[row..].iter().take(lasting_rows).zip(0..);
            let mut delays: Vec<f64> =
                next.map(|(t_s, after)| (t_s - phase_s) / period_s - number - f64::from(after)).collect();
            if delays.len() < lasting_rows {
                return 0.0;
            }
            let of_row = delays.first().copied().unwrap_or_default();
            delays.sort_by(f64::total_cmp);
            let [lower, upper] = [1, 3].map(|quarter| delays[quarter * delays.len() / 4]);
            if of_row > 0.0 { lower.clamp(0.0, of_row) } else { upper.clamp(of_row, 0.0) }
        };
        let number = match motion {
            Some(periods) => {
                let number = before + periods;
                // If more rows than `lasting_rows` seem to be missing in a motion at constant speed, the clock was set here.
                // After a smaller deviation the phase is kept, because the number of periods by the motion may be wrong.
                if ((t_s[row] - phase_s) / period_s - number).abs() > lasting_rows as f64 {
                    let delay = lasting_delay(number);
                    phase_s += if delay.abs() > lasting_rows as f64 { delay * period_s } else { 0.0 };
                }
                number
            }
            None => {
                let delay = lasting_delay(before + 1.0);
                before + 1.0 + if delay > explained_periods { delay.round() } else { 0.0 }
            }
        };
        let error_s = t_s[row] - phase_s - period_s * number;
        phase_s += error_s.clamp(-explained_periods * period_s, explained_periods * period_s) / PHASE_ROWS;
        numbers.push(number);
    }
    numbers
}

/// Corrects the numbers of rows after steps of whole periods. `steps_s` are the steps of the stamps relative to the clock at
/// the rows `breaks`. If a step is a number of whole periods and the motion is unknown near it, then rows are missing there,
/// or rows were wrongly assumed to be missing. Returns whether a number changed.
pub(super) fn correct_numbers(
    numbers: &mut [f64],
    t_s: &[f64],
    motion: &[Option<f64>],
    breaks: &[usize],
    steps_s: &[f64],
    period_s: f64,
) -> bool {
    let near = rows_beside(period_s);
    let mut is_changed = false;
    for (&at, step_s) in breaks.iter().zip(steps_s) {
        let periods = (step_s / period_s).round();
        if periods == 0.0 || (step_s / period_s - periods).abs() > WHOLE {
            continue;
        }
        // If many periods are missing, the stamps must increase by about this time at the row. Otherwise the clock was set.
        let stamps_step =
            |row: usize| periods <= PERIODS_MAX || t_s[row] - t_s[row - 1] > 0.5 * periods * period_s;
        let possible = (at.saturating_sub(near).max(1)..(at + near).min(numbers.len())).filter(|row| {
            let is_motion_unknown = motion[row - 1].is_none();
            is_motion_unknown && numbers[*row] - numbers[row - 1] + periods >= 1.0 && stamps_step(*row)
        });
        if let Some(nearest) = possible.min_by_key(|row| row.abs_diff(at)) {
            numbers[nearest..].iter_mut().for_each(|number| *number += periods);
            is_changed = true;
        }
    }
    is_changed
}
