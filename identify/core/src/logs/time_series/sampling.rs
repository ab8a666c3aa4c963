//! Estimates the regular clock by which the rows of a log were sampled, from their stamps and from the motion of the joints.
//! [`find_clock`] returns the times of the rows on this clock, for `Stream::from_stamps`.
//!
//! Controllers sample by a clock that is regular to microseconds. The stamps may come from another clock: they may be rounded,
//! read late, or shared by several rows. The model of the stamp of row `k` is `t_k = offset + n_k period + steps + jitter`,
//! rounded to a grid. A *cell* of this grid is the interval of times that are rounded to the same stamp. The row's number
//! `n_k` is a whole number of periods. It increases by more than one where rows are missing.
//!
//! The steps of the estimation are:
//!
//! 1. `grid` finds the grid, which all stamps have in common.
//! 2. `motion` counts the periods from each row to the next. If the joints move at constant speed, the motion shows this count
//!    better than the stamps do: where one row is missing, the joints move by twice the usual step. The count is `None`
//!    where the motion does not determine it.
//! 3. `numbers` estimates the period and the number of each row, and `breaks` finds the rows at which the clock was set.
//! 4. `fit` fits a smooth curve with steps to the rests `t_k - n_k period`, by least squares with a robust loss.
//!
//! Stamps whose distances are whole periods have several explanations. They may be correct, so that rows are missing; or
//! they were rounded and no row is missing; or both. The explanation with the shortest description of the log is used
//! (minimum description length, [`Numbered::description`]). Lengths are in nats: the probability that a wrong explanation is
//! shorter than the correct one by `d` nats is below `exp(-d)`.

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

/// The times of the rows of a log, and a comparison of the stamps with these times.
pub(in crate::logs) struct Sampling {
    /// Time of each row \[s\], strictly increasing. The time of the first row need not be 0.
    pub t_s: Vec<f64>,
    pub stamps: Stamps,
}

/// Estimates the regular clock from stamps that do not decrease. `None` if no regular clock explains the stamps.
pub(in crate::logs) fn find_clock(stamps_s: Vec<f64>, rows: &[Joints]) -> Option<Sampling> {
    /// Time on either side of a row over which a cubic polynomial approximates the motion of the joints \[s\].
    const CURVE_S: f64 = 0.1;
    /// The times of the clock are used if the motion at these times is at most this factor rougher than at the stamps. In
    /// 2400 simulated logs (50 to 1000 Hz, joints with 0.1 to 300 urad of noise, stamps off by 6 to 500 us), no log with a
    /// regular clock had a factor above 1.001. If the stamps are correct, a wrong regular clock that displaces the joints by
    /// half of their noise already has a factor of 1.1.
    const AS_SMOOTH: f64 = 1.1;
    let t_s = &*stamps_s;
    // Regular stamps without missing rows are used as they are. A comparison with the motion would take long
    // for millions of rows.
    let even = already_even(t_s);
    if let Some(EvenStamps { stamps, .. }) = even.as_ref().filter(|even| even.stamps.missing == 0) {
        return Some(Sampling { stamps: stamps.clone(), t_s: stamps_s });
    }
    let motion = periods_by_motion(rows);
    // Stamps can be compared with the motion only if the motion determines the number of periods at enough rows.
    let moves = motion.iter().flatten().count() >= ROWS_MIN;
    // An explanation is the number of periods from each row to the next. Where the motion determines this number, it is used.
    // Elsewhere the first explanation assumes that no row is missing, and the second assumes that the stamps are correct.
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
    // While the joints rest, a missing row cannot be distinguished from a stamp that is rounded to the next cell of the
    // grid. Missing rows are therefore only counted where the joints move.
    let known: Vec<bool> = explanations[0].iter().map(Option::is_some).collect();
    let missing_by_stamps = even.as_ref().map_or(0, |even| missing(even.periods.iter().copied(), &known));
    let candidates = explanations.iter().filter(|_| moves).filter_map(|periods| {
        let numbered = Numbered::new(t_s, periods, grid_s)?;
        // The length of the description is only needed if there are two explanations to compare.
        let description_nats = if even.is_some() { numbered.description(&known) } else { 0.0 };
        Some((numbered, description_nats))
    });
    let shortest = candidates.min_by(|(_, a_nats), (_, b_nats)| a_nats.total_cmp(b_nats));
    // The third explanation: the stamps are correct everywhere.
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

/// Number of missing rows, from the number of periods between rows. Rows at which the motion is not `known` do not count.
fn missing(periods: impl Iterator<Item = f64>, known: &[bool]) -> usize {
    periods.zip(known).map(|(periods, known)| if *known { periods - 1.0 } else { 0.0 }).sum::<f64>() as usize
}

/// Length of a list that names `count` of all `rows` \[nats\]. It is the logarithm of the number of possible
/// lists, by Stirling's approximation.
fn nats_of_places(count: usize, rows: usize) -> f64 {
    let (count, rows) = (count as f64, rows as f64);
    if count > 0.0 { count * ((rows / count).ln() + 1.0) } else { 0.0 }
}

/// Rows with their numbers on a regular clock, and the curve that describes the stamps.
struct Numbered {
    /// The grid to which stamps are rounded \[s\], if there is one.
    grid_s: Option<f64>,
    period_s: f64,
    /// Number of periods from the first row to each row.
    numbers: Vec<f64>,
    /// The rests: stamp minus number times period \[s\].
    rest_s: Vec<f64>,
    /// For each step of the clock, the first row after this step.
    breaks_at: Vec<usize>,
    fit: StampFit,
}

impl Numbered {
    /// Numbers the rows and fits the clock. The number of a row is one more than the number of the row before it, unless the
    /// motion shows that rows are missing, or the stamp is later than rounding and jitter explain. `None` if no clock fits.
    fn new(t_s: &[f64], motion: &[Option<f64>], grid_s: Option<f64>) -> Option<Self> {
        /// Largest difference between two stamps and the clock by rounding, in cells of the grid. Rounding contributes up to
        /// one cell, and the phase of the clock is known to a quarter of a cell.
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

    /// Stamp minus fitted time, of each row \[s\].
    fn late_s(&self) -> impl Iterator<Item = f64> {
        self.rest_s.iter().zip(&self.fit.with_steps_s).map(|(rest_s, fitted_s)| rest_s - fitted_s)
    }

    /// Length of the description of the stamps \[nats\]. The description contains:
    ///
    /// - which rows are missing, counted only where the motion is `known`,
    /// - the cell of the grid, for stamps that rounding does not explain,
    /// - the row and the size of each step of the stamps' clock,
    /// - the phase and the rate of the clock by which the stamps were rounded, if it is not the regular clock.
    ///
    /// The regular clock itself is not included, because all explanations share it.
    fn description(&self, known: &[bool]) -> f64 {
        /// `sqrt(2 pi e)`: its logarithm is the differential entropy of a normal distribution of unit deviation, here in cells.
        const CELLS: f64 = 4.13;
        /// Largest deviation of a stamp by rounding, in cells: half a cell, and a tenth for the error of the fitted curve.
        const HALF: f64 = 0.6;
        /// Phases of the clock that are tried, in cells. If the clock passes from cell to cell a few times, the fit
        /// determines the phase to a quarter of a cell.
        const PHASES: [f64; 7] = [-0.25, -0.15, -0.05, 0.0, 0.05, 0.15, 0.25];
        let rows = self.numbers.len() as f64;
        let cell_s = self.grid_s.unwrap_or(WRITTEN_S);
        // Root mean square of the deviations beyond those that rounding explains, in cells.
        let excess = |phase: f64| {
            let excess_s = self.late_s().map(|late_s| (late_s - phase * cell_s).abs() - HALF * cell_s);
            rms(excess_s.map(|excess_s| excess_s.max(0.0))) / cell_s
        };
        let least_excess = PHASES.into_iter().map(excess).fold(f64::INFINITY, f64::min);
        let cells_nats = rows * (1.0 + CELLS * least_excess).ln();
        let missing = missing(self.numbers.windows(2).map(|pair| pair[1] - pair[0]), known);
        // Each step has two parameters, row and size. If the stamps were rounded by another clock, phase and rate of that
        // clock are two more parameters. Such stamps typically deviate by a quarter of a cell.
        let usual_late_s = median(&mut self.late_s().map(f64::abs).collect::<Vec<_>>()).unwrap_or_default();
        let parameters = 2 * (self.breaks_at.len() + usize::from(usual_late_s > WRITTEN_S));
        nats_of_places(missing, self.numbers.len()) + cells_nats + parameters as f64 * rows.ln()
    }

    /// Computes the times of all rows on the clock, and compares the stamps with these times. Steps at which the motion is
    /// unknown remain in the times.
    fn times(&self, t_s: &[f64], motion: &[Option<f64>]) -> (Vec<f64>, Stamps) {
        /// Stamps count as rounded if their root mean square deviation is above this limit, in cells of the grid.
        /// Rounded stamps deviate by 0.29 cells (`1 / sqrt(12)`). Stamps of a clock whose period is a multiple of the
        /// grid do not deviate.
        const ROUNDED_SIGMA: f64 = 0.1;
        let Self { grid_s, period_s, numbers, breaks_at, fit, .. } = self;
        // The row of a step is only known to within a few rows, so the motion must be known in all rows near it.
        let has_motion = |row: usize| {
            let near = motion.get(row.saturating_sub(NEIGHBOURS)..row + NEIGHBOURS);
            near.is_some_and(|near| near.iter().all(Option::is_some))
        };
        // `steps` are removed from the times, `kept_steps_s` remain in the times (0 for a removed step).
        let (mut steps, mut kept_steps_s) = (Vec::new(), vec![0.0; breaks_at.len()]);
        for ((&row, &by_s), kept_s) in breaks_at.iter().zip(&fit.steps_s).zip(&mut kept_steps_s) {
            // Where the motion is unknown, the robot may stand still. Only the stamps then show the duration of this
            // standstill, so the step is kept.
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

/// Root mean square distance of each row from the straight line between its neighbours. If the neighbours have the same
/// time, it is the distance from the middle between them.
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

    /// Length of the description of stamps on a grid of 4 ms. Rows are `period_s` apart, and the clock of the stamps is set
    /// by `step_s` in the middle.
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
