//! The regular clock behind the stamps of a log: [`find_clock`] gives the times of the rows on it, for `Stream::from_stamps`.
//!
//! Controllers sample by a clock that is even to microseconds, and stamp by one that may be rounded, read late, or once for
//! several rows. The stamp of row `k` is `t_k = offset + n_k period + steps + jitter`, rounded to a grid. The whole number `n_k`
//! of a row increases by more than one where rows are missing. The grid is estimated first: it is common to all stamps. While
//! the robot moves evenly, the motion shows the number of periods between two rows better than the stamps do: a missing row
//! leaves a step of the joints of twice the usual size (`motion` has this number from each row to the next, `None` where it is
//! unknown). Then the rest `t_k - n_k period` is fitted by a smooth curve with steps, by least squares with a robust loss.
//!
//! Stamps that are whole periods apart have several explanations: they are right and rows are missing, or they were rounded and no
//! row is missing, or both. The explanation with the shortest description of the log is used (minimum description length,
//! [`Numbered::description`]), in nats: a wrong one that is shorter by `d` nats has a probability below `exp(-d)`.

mod breaks;
mod even;
mod fit;
mod grid;
mod motion;
mod numbers;
mod stamps;

use breaks::{BESIDE, find_breaks};
use even::{EVEN_S, EvenStamps, already_even};
use fit::StampFit;
use grid::{WRITTEN_S, find_grid};
use motion::{NEIGHBOURS, compare_motion, periods_by_motion};
pub(super) use numbers::STEPS_PART;
use numbers::{correct_numbers, estimate_period, number_rows};
pub use stamps::{StampStep, Stamps};

use crate::kinematics::Joints;
use crate::logs::ROWS_MIN;
use crate::statistics::{mean, median, rms};

/// The times of a log.
pub(in crate::logs) struct Sampling {
    /// Time of each row \[s\], strictly increasing; the first need not be 0.
    pub t_s: Vec<f64>,
    pub stamps: Stamps,
}

/// The regular clock behind the stamps, which must not decrease; `None` if there is none.
pub(in crate::logs) fn find_clock(stamps_s: Vec<f64>, rows: &[Joints]) -> Option<Sampling> {
    /// A cubic follows joints for this time to either side \[s\].
    const CURVE_S: f64 = 0.1;
    /// Even times are right where they make the motion as smooth as the stamps do, but for this factor. Of 2400 simulated logs
    /// (50 to 1000 Hz, joints with 0.1 to 300 urad of noise, stamps off by 6 to 500 us) none whose clock is even comes above
    /// 1.001; where the stamps are right, even times come to 1.1 and more as soon as they move joints by half of their noise.
    const AS_SMOOTH: f64 = 1.1;
    let t_s = &*stamps_s;
    // Even stamps without missing rows need no comparison with the motion, which takes long for millions of rows.
    let even = already_even(t_s);
    if let Some(EvenStamps { stamps, .. }) = even.as_ref().filter(|even| even.stamps.missing == 0) {
        return Some(Sampling { stamps: stamps.clone(), t_s: stamps_s });
    }
    let motion = periods_by_motion(rows);
    // Without motion stamps cannot be compared with anything.
    let moves = motion.iter().flatten().count() >= ROWS_MIN;
    // An explanation is the number of periods from row to row, by the motion where it is known. Elsewhere each row follows the
    // one before it (the first explanation), or the stamps are right (the second).
    let (explanations, contradiction_nats) = match &even {
        None => (vec![motion.clone()], None),
        Some(EvenStamps { stamps, periods }) => {
            let side = ((CURVE_S / stamps.period_s).round() as usize).min(BESIDE);
            let (none_missing, _) = compare_motion(&motion, periods, rows, side, |_| 1.0);
            let (mut as_stamped, contradiction_nats) =
                compare_motion(&motion, periods, rows, side, |stamped| stamped);
            as_stamped.iter_mut().zip(periods).for_each(|(shown, stamped)| *shown = shown.or(Some(*stamped)));
            (vec![none_missing, as_stamped], Some(contradiction_nats))
        }
    };
    let grid_s = find_grid(t_s);
    // Where joints rest, a missing row and a clock that passes from one cell of the grid to the next look the same: they decide
    // nothing.
    let known: Vec<bool> = explanations[0].iter().map(Option::is_some).collect();
    let missing_by_stamps = even.as_ref().map_or(0, |even| missing(even.periods.iter().copied(), &known));
    let candidates = explanations.iter().filter(|_| moves).filter_map(|periods| {
        let numbered = Numbered::new(t_s, periods, grid_s)?;
        // One explanation alone is compared with nothing.
        let description_nats = if even.is_some() { numbered.description(&known) } else { 0.0 };
        Some((numbered, description_nats))
    });
    let shortest = candidates.min_by(|(_, a_nats), (_, b_nats)| a_nats.total_cmp(b_nats));
    // The third explanation: the stamps are right everywhere.
    if let Some((EvenStamps { stamps, periods }, contradiction_nats)) = even.zip(contradiction_nats) {
        let stamps_nats = nats_of_places(missing_by_stamps, periods.len()) + contradiction_nats;
        if shortest.as_ref().is_none_or(|(_, description_nats)| stamps_nats <= *description_nats) {
            return Some(Sampling { stamps, t_s: stamps_s });
        }
    }
    let (numbered, _) = shortest?;
    let (even_s, stamps) = numbered.times(t_s, &motion);
    if !stamps.evened {
        return Some(Sampling { stamps, t_s: stamps_s });
    }
    let increases = even_s.windows(2).all(|pair| pair[1] > pair[0]);
    let is_right = increases && roughness(&even_s, rows) <= AS_SMOOTH * roughness(t_s, rows);
    is_right.then_some(Sampling { t_s: even_s, stamps })
}

/// Number of missing rows where the motion is known, from the periods between rows.
fn missing(periods: impl Iterator<Item = f64>, known: &[bool]) -> usize {
    periods.zip(known).map(|(periods, known)| if *known { periods - 1.0 } else { 0.0 }).sum::<f64>() as usize
}

/// Length of the description of which `count` of the `rows` are meant \[nats\]: about the logarithm of their combinations.
fn nats_of_places(count: usize, rows: usize) -> f64 {
    let (count, rows) = (count as f64, rows as f64);
    if count > 0.0 { count * ((rows / count).ln() + 1.0) } else { 0.0 }
}

/// Rows with their numbers on a regular clock.
struct Numbered {
    grid_s: Option<f64>,
    period_s: f64,
    /// Number of periods from the first row to each row.
    numbers: Vec<f64>,
    /// Stamps minus number times period \[s\].
    rest_s: Vec<f64>,
    /// First rows after a step of the clock.
    breaks_at: Vec<usize>,
    fit: StampFit,
}

impl Numbered {
    /// Numbers the rows and fits the clock. Each row follows the one before it, unless the motion, or a deviation beyond rounding
    /// and jitter, shows otherwise. `None` if no clock fits.
    fn new(t_s: &[f64], motion: &[Option<f64>], grid_s: Option<f64>) -> Option<Self> {
        /// Rounding moves two stamps by up to one grid against each other; the phase of the clock is known to a quarter of it.
        const ROUNDED: f64 = 1.25;
        let rounding_s = ROUNDED * grid_s.unwrap_or_default();
        let period_s = estimate_period(t_s, motion)?;
        let mut numbers = number_rows(t_s, motion, period_s, rounding_s);
        let rests_s = |numbers: &[f64]| -> Vec<f64> {
            t_s.iter().zip(numbers).map(|(t_s, number)| t_s - period_s * number).collect()
        };
        let mut rest_s = rests_s(&numbers);
        let mut breaks_at = find_breaks(&rest_s, period_s, rounding_s)?;
        let mut fit = StampFit::new(&rest_s, &numbers, period_s, &breaks_at, grid_s)?;
        if correct_numbers(&mut numbers, t_s, motion, &breaks_at, &fit.steps_s, period_s) {
            rest_s = rests_s(&numbers);
            breaks_at = find_breaks(&rest_s, period_s, rounding_s)?;
            fit = StampFit::new(&rest_s, &numbers, period_s, &breaks_at, grid_s)?;
        }
        Some(Self { grid_s, period_s, numbers, rest_s, breaks_at, fit })
    }

    /// Number of missing rows.
    fn missing(&self) -> usize {
        self.numbers.windows(2).map(|pair| pair[1] - pair[0] - 1.0).sum::<f64>() as usize
    }

    /// Stamp minus time of the clock, of each row \[s\].
    fn late_s(&self) -> impl Iterator<Item = f64> {
        self.rest_s.iter().zip(&self.fit.with_steps_s).map(|(rest_s, fitted_s)| rest_s - fitted_s)
    }

    /// Length of the description of even stamps \[nats\], beyond that of their own clock, which all explanations share: which rows
    /// are missing, in which cell of the grid a stamp is where rounding does not explain it, where the stamps' clock was set and by
    /// how much, and phase and rate of another clock, if rows have one that passes from cell to cell. Missing rows count where
    /// the motion is `known`.
    fn description(&self, known: &[bool]) -> f64 {
        /// `sqrt(2 pi e)`: its logarithm is the differential entropy of a normal distribution of unit deviation, here in cells.
        const CELLS: f64 = 4.13;
        /// Largest deviation of a stamp by rounding: half a cell, and a tenth for the error of the fitted line.
        const HALF: f64 = 0.6;
        /// Tried phases of the clock, in cells: a few passes from cell to cell determine the phase to a quarter.
        const PHASES: [f64; 7] = [-0.25, -0.15, -0.05, 0.0, 0.05, 0.15, 0.25];
        let rows = self.numbers.len() as f64;
        let cell_s = self.grid_s.unwrap_or(WRITTEN_S);
        // What rounding does not explain of the deviations, in cells.
        let excess = |phase: f64| {
            let excess_s = self.late_s().map(|late_s| (late_s - phase * cell_s).abs() - HALF * cell_s);
            rms(excess_s.map(|excess_s| excess_s.max(0.0))) / cell_s
        };
        let least_excess = PHASES.into_iter().map(excess).fold(f64::INFINITY, f64::min);
        let cells_nats = rows * (1.0 + CELLS * least_excess).ln();
        let missing = missing(self.numbers.windows(2).map(|pair| pair[1] - pair[0]), known);
        // Of each step place and size, of another clock phase and rate: rounding moves the stamps of one by a quarter of a cell.
        let usual_late_s = median(&mut self.late_s().map(f64::abs).collect::<Vec<_>>()).unwrap_or_default();
        let parameters = 2 * (self.breaks_at.len() + usize::from(usual_late_s > WRITTEN_S));
        nats_of_places(missing, self.numbers.len()) + cells_nats + parameters as f64 * rows.ln()
    }

    /// Times of the clock for all rows, and the stamps against it. Steps at which the motion is unknown stay in the times.
    fn times(&self, t_s: &[f64], motion: &[Option<f64>]) -> (Vec<f64>, Stamps) {
        /// Rounded stamps are off by 0.29 of their grid, root mean square; those of a clock that keeps to the grid are exact.
        const ROUNDED_SIGMA: f64 = 0.1;
        let Self { grid_s, period_s, numbers, breaks_at, fit, .. } = self;
        // The place of a step is known to some rows only, and near a gap the motion is unknown.
        let has_motion = |row: usize| {
            let near = motion.get(row.saturating_sub(NEIGHBOURS)..row + NEIGHBOURS);
            near.is_some_and(|near| near.iter().all(Option::is_some))
        };
        let (mut steps, mut kept_steps_s) = (Vec::new(), vec![0.0; breaks_at.len()]);
        for ((&row, &by_s), kept_s) in breaks_at.iter().zip(&fit.steps_s).zip(&mut kept_steps_s) {
            // Only the stamps show how long the robot stands still.
            if has_motion(row) { steps.push(StampStep { at_s: t_s[row], by_s }) } else { *kept_s = by_s }
        }
        let clock_time_s = |row: usize| {
            let kept = breaks_at.iter().zip(&kept_steps_s).filter(|(first, _)| **first <= row);
            let kept_s: f64 = kept.map(|(_, by_s)| by_s).sum();
            period_s * numbers[row] + fit.without_steps_s[row] + kept_s
        };
        let even_s: Vec<f64> = (0..t_s.len()).map(clock_time_s).collect();
        let scatter_s: Vec<f64> = self.late_s().map(f64::abs).collect();
        let jitter_s = rms(&scatter_s);
        let equal = t_s.windows(2).filter(|pair| pair[1] <= pair[0]).count();
        let stamps = Stamps {
            evened: jitter_s > EVEN_S || equal > 0 || !steps.is_empty(),
            period_s: period_s + fit.slope_s,
            jitter_s,
            jitter_max_s: scatter_s.into_iter().fold(0.0, f64::max),
            rounded_to_s: grid_s.filter(|grid_s| jitter_s > ROUNDED_SIGMA * grid_s),
            equal,
            missing: self.missing(),
            steps,
        };
        (even_s, stamps)
    }
}

/// How far rows are from the straight lines between their neighbours, root mean square; at equal times from the middle.
fn roughness(t_s: &[f64], rows: &[Joints]) -> f64 {
    let off_squared = |(t, q): (&[f64], &[Joints])| -> f64 {
        let span_s = t[2] - t[0];
        let part = if span_s > 0.0 { (t[1] - t[0]) / span_s } else { 0.5 };
        (0..q[0].len()).map(|axis| (q[1][axis] - (1.0 - part) * q[0][axis] - part * q[2][axis]).powi(2)).sum()
    };
    mean(t_s.windows(3).zip(rows.windows(3)).map(off_squared)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stamps on a grid of 4 ms, of rows that are `period_s` apart, by a clock that is set by `step_s` in the middle.
    fn description_nats(period_s: f64, step_s: f64) -> f64 {
        const GRID_S: f64 = 0.004;
        let stamp = |row: usize| {
            let set_s = if row < ROWS / 2 { 0.0 } else { step_s };
            (row as f64 * period_s / GRID_S).round() * GRID_S + set_s
        };
        let t_s: Vec<f64> = (0..ROWS).map(stamp).collect();
        let Some(numbered) = Numbered::new(&t_s, &[Some(1.0); ROWS - 1], Some(GRID_S)) else {
            panic!("no clock")
        };
        numbered.description(&[true; ROWS - 1])
    }

    const ROWS: usize = 5000;

    #[test]
    fn steps_of_a_clock_and_another_clock_each_have_two_numbers() {
        let numbers = |period_s, step_s| description_nats(period_s, step_s) / (ROWS as f64).ln();
        for ((period_s, step_s), expected) in
            [((0.004, 0.0), 0.0), ((0.004, 0.04), 2.0), ((0.004_008, 0.0), 2.0), ((0.004_008, 0.04), 4.0)]
        {
            let numbers = numbers(period_s, step_s);
            assert!((numbers - expected).abs() < 0.1, "{numbers} of {expected}");
        }
    }
}
