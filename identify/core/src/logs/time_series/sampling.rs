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

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use crate::kinematics::Joints;
use crate::logs::ROWS_MIN;
use crate::statistics::median;

/// The stamps of a log against the regular clock behind them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Stamps {
    /// Rows have the times of the clock, not their stamps.
    pub evened: bool,
    /// Period of the clock \[s\].
    pub period_s: f64,
    /// Root mean square of the differences of stamps and clock \[s\].
    pub jitter_s: f64,
    /// Largest of these differences \[s\].
    pub jitter_max_s: f64,
    /// Stamps are whole multiples of this \[s\], which is larger than their scatter; `None` if they are not rounded.
    pub rounded_to_s: Option<f64>,
    /// Number of rows with the stamp of the row before.
    pub equal: usize,
    /// Number of periods of the clock without a row.
    pub missing: usize,
    /// Steps of the stamps during an even motion.
    pub steps: Vec<StampStep>,
}

/// A step of the stamps that the motion does not share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampStep {
    /// Stamp of the first row after it, since the first of the log \[s\].
    pub at_s: f64,
    /// Delay of the stamps of later rows \[s\].
    pub by_s: f64,
}

/// Stamps that scatter by less than this are taken as they are \[s\]: the fastest joint of a calibration turns by 5 urad in it,
/// less than any encoder of it resolves.
const EVEN_S: f64 = 5e-6;
/// Smallest number of rows on either side of a step.
const BESIDE: usize = 25;
/// Shortest time on either side of a step \[s\]: delayed rows are late for a shorter time.
const BESIDE_S: f64 = 0.5;
/// Number of rows on either side whose joint steps determine the usual step, that of one period.
const NEIGHBOURS: usize = 6;
/// A step is a multiple of the usual one if it differs by less than this fraction of the usual one, which changes by less.
const WHOLE: f64 = 0.2;
/// Largest number of periods between two rows that the motion determines.
const PERIODS_MAX: f64 = 4.0;
/// Smallest number of neighbours with whole steps: steps from rounding alone reach it once in a thousand rows.
const NEIGHBOURS_WHOLE: usize = 10;
/// Number of rows of the segments over which the period is measured at first.
const LAG: usize = 32;
/// Part of these segments at either end, in the order of their periods, that is left out: a step of the clock may be in them.
pub(super) const STEPS_PART: f64 = 0.02;
/// Stamps are written to microseconds or better \[s\].
const WRITTEN_S: f64 = 1.5e-6;
/// Steps for each one that the motion miscounts (see [`NEIGHBOURS_WHOLE`]), and the odds that are needed to overrule it.
const MISCOUNTED: f64 = 1000.0;

/// Smallest scatter that is reported \[s\]: the fastest joint of a calibration turns by 50 urad in it.
const SCATTER_S: f64 = 5e-5;

impl Stamps {
    /// Remarks on rows that have the times of the clock, in sentences.
    pub(in crate::logs) fn remarks(&self) -> Vec<String> {
        let Self { evened, jitter_s, rounded_to_s, equal, missing, steps, .. } = self;
        if !evened {
            return Vec::new();
        }
        let mut how = Vec::new();
        match rounded_to_s {
            Some(step_s) => how.push(format!("the stamps are rounded to {:.1} ms", step_s * 1e3)),
            None if *jitter_s > SCATTER_S => {
                how.push(format!("the stamps scatter by {:.2} ms", jitter_s * 1e3))
            }
            None => {}
        }
        for (count, what) in [(equal, "rows have the stamp of the one before"), (missing, "rows are missing")]
        {
            if *count > 0 {
                how.push(format!("{count} {what}"));
            }
        }
        let rows = (!how.is_empty()).then(|| {
            let how = how.join(", ");
            format!("{how}: rows have the times of the regular clock behind them; log the controller's sampling time if possible")
        });
        let steps = steps.iter().map(|StampStep { at_s, by_s }| {
            format!(
                "the stamps step by {:+.2} ms at {at_s:.2} s although the motion continues evenly: later rows have times \
                 without it; find out what sets the clock",
                by_s * 1e3
            )
        });
        rows.into_iter().chain(steps).collect()
    }
}

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
    // The motion is compared only where it decides: long logs have millions of rows.
    let even = already_even(t_s);
    if let Some(EvenStamps { stamps, .. }) = even.as_ref().filter(|even| even.stamps.missing == 0) {
        return Some(Sampling { stamps: stamps.clone(), t_s: stamps_s });
    }
    let motion = periods_by_motion(rows);
    // Without motion stamps cannot be compared with anything.
    let moves = motion.iter().flatten().count() >= ROWS_MIN;
    // An explanation is the number of periods from row to row. Where the motion is unknown, a row follows the one before it, or
    // the stamps are right.
    let (explanations, contradiction_nats) = match &even {
        None => (vec![motion.clone()], None),
        Some(EvenStamps { stamps, periods }) => {
            let side = ((CURVE_S / stamps.period_s).round() as usize).min(BESIDE);
            let (none_missing, _) = compare_motion(&motion, periods, rows, side, |_| 1.0);
            let (mut as_stamped, nats) = compare_motion(&motion, periods, rows, side, |stamped| stamped);
            as_stamped.iter_mut().zip(periods).for_each(|(shown, stamped)| *shown = shown.or(Some(*stamped)));
            (vec![none_missing, as_stamped], Some(nats))
        }
    };
    let grid_s = find_grid(t_s);
    // Where joints rest, a row that is missing and a clock that passes from cell to cell look the same: they decide nothing.
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

/// Periods from row to row by the motion, and how strongly it contradicts the `periods` of the stamps \[nats\]. Where the stamps
/// have missing rows, a curve through `side` rows on either side decides. `if_unknown` turns the periods of the stamps into those
/// that are assumed where the motion is unknown.
fn compare_motion(
    motion: &[Option<f64>],
    periods: &[f64],
    rows: &[Joints],
    side: usize,
    if_unknown: impl Fn(f64) -> f64,
) -> (Vec<Option<f64>>, f64) {
    let mut numbers = vec![0.0];
    for (shown, stamped) in motion.iter().zip(periods) {
        let before = numbers.last().copied().unwrap_or_default();
        numbers.push(before + shown.unwrap_or_else(|| if_unknown(*stamped)));
    }
    let mut motion = motion.to_vec();
    let mut contradictions_nats = Vec::new();
    let mut tests = 0;
    for (row, (shown, &stamped)) in motion.iter_mut().zip(periods).enumerate() {
        if *shown == Some(stamped) {
            continue;
        }
        let is_open = stamped > 1.0 && stamped <= PERIODS_MAX;
        tests += usize::from(is_open);
        let by_curve =
            if is_open { periods_by_curve(rows, side, &numbers, row, stamped as usize) } else { None };
        *shown = by_curve.map(|(periods, _)| periods).or(*shown);
        if shown.is_some_and(|shown| shown != stamped) {
            contradictions_nats.push(by_curve.map_or(MISCOUNTED.ln(), |(_, nats)| nats));
        }
    }
    // Among many places one contradicts by chance.
    let by_chance_nats = f64::ln(tests.max(1) as f64);
    (motion, contradictions_nats.iter().map(|nats| (nats - by_chance_nats).max(0.0)).sum())
}

/// Periods, 1 to `most`, from `row` to the next one for which `side` rows on both sides are on the smoothest curve, with the
/// log-likelihood ratio to the second best; `None` if that is too small.
fn periods_by_curve(
    rows: &[Joints],
    side: usize,
    numbers: &[f64],
    row: usize,
    most: usize,
) -> Option<(f64, f64)> {
    /// Rows of each side that determine a cubic.
    const SIDE_MIN: usize = 8;
    const TERMS: usize = 4;
    let first = (row + 1).saturating_sub(side);
    let end = (row + 1 + side).min(rows.len());
    if row + 1 < first + SIDE_MIN || end < row + 1 + SIDE_MIN {
        return None;
    }
    let (count, axes) = (end - first, rows[row].len());
    let joints = DMatrix::from_fn(count, axes, |i, axis| rows[first + i][axis] - rows[row][axis]);
    // Squared distances from the best cubic if this number of periods is between `row` and the next one.
    let squares = |periods: usize| {
        let longer = periods as f64 - (numbers[row + 1] - numbers[row]);
        let time = |i: usize| {
            let since = numbers[first + i] - numbers[row];
            (if first + i > row { since + longer } else { since }) / side as f64
        };
        let powers = DMatrix::from_fn(count, TERMS, |i, power| time(i).powi(power as i32));
        let basis = powers.qr().q();
        (&joints - &basis * (basis.transpose() * &joints)).norm_squared()
    };
    let mut fits: Vec<(usize, f64)> = (1..=most).map(|periods| (periods, squares(periods))).collect();
    fits.sort_by(|(_, a_squares), (_, b_squares)| a_squares.total_cmp(b_squares));
    let [(best, least), (_, second), ..] = fits[..] else { return None };
    let variance = least / (axes * (count - TERMS)) as f64;
    // Residuals of the cubic are correlated from row to row: two rows count as one.
    let nats = 0.25 * (second - least) / variance;
    (nats > MISCOUNTED.ln()).then_some((best as f64, nats))
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
    fit: Fit,
}

impl Numbered {
    /// Each row follows the one before it, unless the motion, or a deviation beyond rounding and jitter, shows otherwise.
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
        let mut fit = Fit::new(&rest_s, &numbers, period_s, &breaks_at, grid_s)?;
        if correct_numbers(&mut numbers, t_s, motion, &breaks_at, &fit.steps_s, period_s) {
            rest_s = rests_s(&numbers);
            breaks_at = find_breaks(&rest_s, period_s, rounding_s)?;
            fit = Fit::new(&rest_s, &numbers, period_s, &breaks_at, grid_s)?;
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
    /// are missing, in which cell of the grid a stamp is if not in that of rounding, and either where the stamps' clock was set and
    /// by how much, or phase and rate of another clock, which decide where it passes from cell to cell. Missing rows count where
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
            rms(&excess_s.map(|excess_s| excess_s.max(0.0)).collect::<Vec<_>>()) / cell_s
        };
        let least_excess = PHASES.into_iter().map(excess).fold(f64::INFINITY, f64::min);
        let cells_nats = rows * (1.0 + CELLS * least_excess).ln();
        let missing = missing(self.numbers.windows(2).map(|pair| pair[1] - pair[0]), known);
        // Of each step place and size; without steps phase and rate of another clock.
        let parameters = 2 * self.breaks_at.len().max(1);
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

/// Stamps whose distances are all whole multiples of the usual one.
struct EvenStamps {
    stamps: Stamps,
    /// These multiples, from each row to the next.
    periods: Vec<f64>,
}

/// The stamps, if they are those of a regular clock as they are.
fn already_even(t_s: &[f64]) -> Option<EvenStamps> {
    let mut steps_s: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let usual_s = median(&mut steps_s)?;
    let pairs = t_s.windows(2).map(|pair| pair[1] - pair[0]);
    let periods: Vec<f64> = pairs.clone().map(|step_s| (step_s / usual_s).round()).collect();
    let mut off_s = steps_s;
    off_s.clear();
    off_s.extend(pairs.zip(&periods).map(|(step_s, periods)| (step_s - periods * usual_s).abs()));
    let is_even = periods.iter().all(|periods| *periods >= 1.0) && off_s.iter().all(|off_s| *off_s <= EVEN_S);
    let missing = periods.iter().map(|periods| periods - 1.0).sum::<f64>();
    // If most periods have no row, the usual distance is not the period of a clock.
    (is_even && missing < periods.len() as f64).then(|| {
        let jitter_max_s = off_s.iter().copied().fold(0.0, f64::max);
        let (jitter_s, missing) = (rms(&off_s), missing as usize);
        let stamps = Stamps { period_s: usual_s, jitter_s, jitter_max_s, missing, ..Stamps::default() };
        EvenStamps { stamps, periods }
    })
}

/// The grid of the stamps \[s\]: all are whole multiples of it plus an offset, which changes only where the clock is set.
fn find_grid(t_s: &[f64]) -> Option<f64> {
    /// Finer grids come from the format \[s\].
    const GRID_S_MIN: f64 = 2e-4;
    /// Largest number of cells in the smallest distance of stamps.
    const PARTS_MAX: u32 = 32;
    /// Grids are multiples of this \[s\], or whole parts of a second: a clock that is even is on no grid, but for a rare rate.
    const ROUND_S: f64 = 1e-5;
    /// Largest number of changes of the offset.
    const CHANGES_MAX: usize = 3;
    let steps_s = t_s.windows(2).map(|pair| pair[1] - pair[0]).filter(|step_s| *step_s > WRITTEN_S);
    let least_s = steps_s.fold(f64::INFINITY, f64::min);
    let is_grid = |grid_s: &f64| {
        let (mut offset_s, mut changes) = (t_s[0], 0);
        t_s.iter().all(|t_s| {
            let off_s = t_s - offset_s - ((t_s - offset_s) / grid_s).round() * grid_s;
            if off_s.abs() > WRITTEN_S {
                (offset_s, changes) = (*t_s, changes + 1);
            }
            changes <= CHANGES_MAX
        })
    };
    let parts_s = (1..=PARTS_MAX).map(|part| least_s / f64::from(part));
    let round_s = |part_s: f64| [(part_s / ROUND_S).round() * ROUND_S, 1.0 / (1.0 / part_s).round()];
    let rounded_s = parts_s.take_while(|part_s| *part_s > GRID_S_MIN).flat_map(round_s);
    rounded_s.filter(|grid_s| grid_s.is_finite()).find(is_grid)
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// Number of periods from each row to the next, where the motion determines it.
fn periods_by_motion(rows: &[Joints]) -> Vec<Option<f64>> {
    /// Where many rows are missing, periods known from one pass determine the usual step for others in the next.
    const PASSES: usize = 3;
    let steps: Vec<Joints> = rows.windows(2).map(|pair| difference(&pair[1], &pair[0])).collect();
    let mut periods = vec![Some(1.0); steps.len()];
    for _ in 0..PASSES {
        periods = (0..steps.len()).map(|at| periods_of_step(&steps, &periods, at)).collect();
    }
    periods
}

fn difference(a: &Joints, b: &Joints) -> Joints {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

fn norm_squared(step: &Joints) -> f64 {
    step.iter().map(|value| value * value).sum()
}

/// Number of usual steps in the joint step `at`: the multiple `m` of `step = m usual`. The usual step is the mean of those of
/// both sides, each the median of its steps divided by their `periods`, where these are known so far.
fn periods_of_step(steps: &[Joints], periods: &[Option<f64>], at: usize) -> Option<f64> {
    /// Smaller steps of all joints are standstill \[rad, m\].
    const STEP_RAD_MIN: f64 = 50e-6;
    let sides = [at.checked_sub(NEIGHBOURS)?..at, at + 1..at + 1 + NEIGHBOURS];
    let usual_on = |side: &Range<usize>| -> Option<Joints> {
        let known = steps.get(side.clone())?.iter().zip(&periods[side.clone()]);
        let known: Vec<(&Joints, f64)> =
            known.filter_map(|(step, periods)| Some((step, (*periods)?))).collect();
        let usual_of_axis = |axis: usize| {
            median(&mut known.iter().map(|(step, periods)| step[axis] / periods).collect::<Vec<_>>())
        };
        (known.len() > NEIGHBOURS / 2)
            .then(|| Joints::from_fn(steps[at].len(), |axis| usual_of_axis(axis).unwrap_or_default()))
    };
    let [before, after] = [usual_on(&sides[0])?, usual_on(&sides[1])?];
    let usual: Joints = before.iter().zip(&after).map(|(a, b)| 0.5 * (a + b)).collect();
    let usual_squared = norm_squared(&usual);
    let whole_multiple = |step: &Joints| {
        let multiple = step.iter().zip(&usual).map(|(a, b)| a * b).sum::<f64>() / usual_squared;
        let across_squared = norm_squared(&difference(step, &usual.map(|usual| multiple * usual)));
        let is_whole = (1.0 - WHOLE..PERIODS_MAX + WHOLE).contains(&multiple)
            && (multiple - multiple.round()).abs() < WHOLE;
        (is_whole && across_squared < WHOLE * WHOLE * norm_squared(step)).then(|| multiple.round())
    };
    let is_even = usual_squared > STEP_RAD_MIN.powi(2)
        && norm_squared(&difference(&before, &after)) < WHOLE * WHOLE * usual_squared;
    let whole_neighbours = || {
        let neighbours = sides.iter().flat_map(|side| &steps[side.clone()]);
        neighbours.filter(|step| whole_multiple(step).is_some()).count()
    };
    if is_even && whole_neighbours() >= NEIGHBOURS_WHOLE { whole_multiple(&steps[at]) } else { None }
}

/// Mean of the values without this fraction of them at either end.
pub(super) fn trimmed_mean(mut values: Vec<f64>, part: f64) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let ends = (part * values.len() as f64) as usize;
    let kept = values.get(ends..values.len() - ends).filter(|kept| !kept.is_empty())?;
    Some(kept.iter().sum::<f64>() / kept.len() as f64)
}

/// The period \[s\], from segments in which the motion determines the number of periods; without motion from the stamps alone.
fn estimate_period(t_s: &[f64], motion: &[Option<f64>]) -> Option<f64> {
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

/// Number of each row on the clock, from 0. Where the motion is unknown, the number is the next one, unless this row and those
/// after it are later than jitter and rounding, up to `rounding_s`, explain. Where the motion is known, that is a clock step.
fn number_rows(t_s: &[f64], motion: &[Option<f64>], period_s: f64, rounding_s: f64) -> Vec<f64> {
    /// Number of rows over which the phase follows the stamps: the period is known to a thousandth, so that it lags by less than half
    /// of one, and missing rows do not change it.
    const PHASE_ROWS: f64 = 200.0;
    /// A row is further away if three quarters of the rows in this time after it are, too \[s\]: delayed rows are late for a shorter
    /// time.
    const LASTS_S: f64 = 0.1;
    let lasting_rows = ((LASTS_S / period_s) as usize).max(5);
    // Mean deviation of the stamps in a segment of known motion.
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
    // Twice the standard deviation: of a normal distribution the mean size is 0.8 of it.
    let explained_periods = (2.5 * median(&mut scatters).unwrap_or_default()).max(rounding_s) / period_s;
    let explained_periods = explained_periods.max(0.5);
    let first =
        t_s.iter().take(lasting_rows).zip(0..).map(|(t_s, number)| t_s - period_s * f64::from(number));
    let mut phase_s = median(&mut first.collect::<Vec<_>>()).unwrap_or_default();
    let mut numbers = vec![0.0];
    for (row, motion) in (1..t_s.len()).zip(motion) {
        let before = numbers.last().copied().unwrap_or_default();
        // By how many periods this row and three quarters of those after it are late (negative: early) if it has this number.
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
                // Too many rows to be missing in an even motion: the clock was set here. With fewer the motion may be wrong.
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

/// First rows after the steps, of more than `rounding_s`, of the stamps against a regular clock; `None` if there are too many.
fn find_breaks(rest_s: &[f64], period_s: f64, rounding_s: f64) -> Option<Vec<usize>> {
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
    let beside = BESIDE.max((BESIDE_S / period_s) as usize);
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

/// Corrects the numbers at steps of whole periods near rows with unknown motion: rows are missing there, or were wrongly taken as
/// missing. Returns whether a number changed.
fn correct_numbers(
    numbers: &mut [f64],
    t_s: &[f64],
    motion: &[Option<f64>],
    breaks: &[usize],
    steps_s: &[f64],
    period_s: f64,
) -> bool {
    let near = BESIDE.max((BESIDE_S / period_s) as usize);
    let mut is_changed = false;
    for (&at, step_s) in breaks.iter().zip(steps_s) {
        let periods = (step_s / period_s).round();
        if periods == 0.0 || (step_s / period_s - periods).abs() > WHOLE {
            continue;
        }
        // The stamps step where these rows are missing; a step elsewhere is one of the clock.
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

/// A fit to the rests `t_k - n_k period`: a line with a bend at each knot, and a step at each break.
struct Fit {
    /// The fit without the steps, row by row \[s\].
    without_steps_s: Vec<f64>,
    /// The fit with the steps, row by row \[s\].
    with_steps_s: Vec<f64>,
    /// The step at each break \[s\].
    steps_s: Vec<f64>,
    /// Estimated minus assumed period \[s\].
    slope_s: f64,
}

impl Fit {
    /// Minimises the Huber loss of the residuals plus `bend_weight` times the squared second differences at the knots, by
    /// reweighted least squares. The unknowns `x` are the values at the knots, then the steps. Rounded stamps need a smooth fit:
    /// those of one cell of the grid share their error.
    fn new(
        rest_s: &[f64],
        numbers: &[f64],
        period_s: f64,
        breaks: &[usize],
        grid_s: Option<f64>,
    ) -> Option<Self> {
        /// Limit of the Huber loss in standard deviations.
        const HUBER: f64 = 1.345;
        const ROUNDS: usize = 8;
        /// The rate of a clock follows temperature over minutes: it is free to change at this distance \[s\].
        const KNOTS_S: f64 = 60.0;
        /// Largest number of pieces between knots.
        const PIECES_MAX: usize = 200;
        /// From one knot to the next the rate of a clock changes by this, one standard deviation: a quartz that warms up by 1 K.
        const RATE_CHANGE: f64 = 2e-6;
        /// Where a row is: the knot before it, the fraction of the way to the next one, and the number of steps so far.
        #[derive(Clone, Copy)]
        struct Place {
            knot: usize,
            fraction: f64,
            steps: usize,
        }
        // Steps may be an hour: only their remainder is fitted, in which rounding is small.
        let middle_s = |range: Range<usize>| median(&mut rest_s.get(range)?.to_vec());
        let rough_step_s = |at: usize| {
            let end = (at + BESIDE).min(rest_s.len());
            Some(middle_s(at..end)? - middle_s(at.saturating_sub(BESIDE)..at)?)
        };
        let rough_s: Vec<f64> = breaks.iter().map(|&at| rough_step_s(at).unwrap_or_default()).collect();
        let roughly_stepped_s = |row: usize| -> f64 {
            breaks.iter().zip(&rough_s).filter(|(first, _)| **first <= row).map(|(_, by_s)| by_s).sum()
        };
        let rest_s: Vec<f64> =
            rest_s.iter().enumerate().map(|(row, rest)| rest - roughly_stepped_s(row)).collect();
        let last_number = numbers.last()?.max(1.0);
        let pieces = ((last_number * period_s / KNOTS_S).ceil() as usize).clamp(1, PIECES_MAX);
        let first_step = pieces + 1;
        let unknowns = first_step + breaks.len();
        let place_of = |row: usize| {
            let along = numbers[row] / last_number * pieces as f64;
            let knot = (along as usize).min(pieces - 1);
            Place {
                knot,
                fraction: along - knot as f64,
                steps: breaks.partition_point(|first| *first <= row),
            }
        };
        let without_steps = |x: &DVector<f64>, Place { knot, fraction, .. }: Place| {
            (1.0 - fraction) * x[knot] + fraction * x[knot + 1]
        };
        let with_steps =
            |x: &DVector<f64>, place: Place| without_steps(x, place) + x.rows(first_step, place.steps).sum();
        let mut x = DVector::<f64>::zeros(unknowns);
        let mut sigma_s = f64::INFINITY;
        for _ in 0..ROUNDS {
            let (mut matrix, mut right_side) =
                (DMatrix::<f64>::zeros(unknowns, unknowns), DVector::<f64>::zeros(unknowns));
            for (row, rest) in rest_s.iter().enumerate() {
                let place = place_of(row);
                let weight = (HUBER * sigma_s / (rest - with_steps(&x, place)).abs()).min(1.0);
                let weight = if weight.is_finite() { weight } else { 1.0 };
                let Place { knot, fraction, steps } = place;
                let mut coefficients = vec![(knot, 1.0 - fraction), (knot + 1, fraction)];
                coefficients.extend((0..steps).map(|step| (first_step + step, 1.0)));
                for &(i, a) in &coefficients {
                    right_side[i] += weight * a * rest;
                    coefficients.iter().for_each(|&(j, b)| matrix[(i, j)] += weight * a * b);
                }
            }
            let rounding_variance =
                grid_s.unwrap_or_default().powi(2) / 12.0 * rest_s.len() as f64 / pieces as f64;
            let scatter_variance = if sigma_s.is_finite() { sigma_s * sigma_s } else { 0.0 };
            let bend_s = RATE_CHANGE * last_number * period_s / pieces as f64;
            let bend_weight = (scatter_variance + rounding_variance) / (bend_s * bend_s);
            for first in 0..pieces.saturating_sub(1) {
                let bend = [(first, 1.0), (first + 1, -2.0), (first + 2, 1.0)];
                for (i, a) in bend {
                    bend.iter().for_each(|&(j, b)| matrix[(i, j)] += bend_weight * a * b);
                }
            }
            // Makes the matrix regular for pieces without rows.
            (0..unknowns).for_each(|i| matrix[(i, i)] += 1e-9 * (1.0 + matrix[(i, i)]));
            x = matrix.cholesky()?.solve(&right_side);
            let residual_s = |(row, rest): (usize, &f64)| (rest - with_steps(&x, place_of(row))).abs();
            let mut residuals_s: Vec<f64> = rest_s.iter().enumerate().map(residual_s).collect();
            // Of a normal distribution the median size is 0.675 standard deviations.
            sigma_s = (1.48 * median(&mut residuals_s)?).max(1e-9);
        }
        let rows = 0..rest_s.len();
        let steps = x.rows(first_step, breaks.len());
        Some(Self {
            without_steps_s: rows.clone().map(|row| without_steps(&x, place_of(row))).collect(),
            with_steps_s: rows.map(|row| with_steps(&x, place_of(row)) + roughly_stepped_s(row)).collect(),
            steps_s: steps.iter().zip(&rough_s).map(|(remainder, rough_s)| remainder + rough_s).collect(),
            slope_s: (x[pieces] - x[0]) / last_number,
        })
    }
}

/// How far rows are from the straight lines between their neighbours, root mean square; at equal times from the middle.
fn roughness(t_s: &[f64], rows: &[Joints]) -> f64 {
    let off_squared = |(t, q): (&[f64], &[Joints])| -> f64 {
        let span_s = t[2] - t[0];
        let part = if span_s > 0.0 { (t[1] - t[0]) / span_s } else { 0.5 };
        (0..q[0].len()).map(|axis| (q[1][axis] - (1.0 - part) * q[0][axis] - part * q[2][axis]).powi(2)).sum()
    };
    let squares: Vec<f64> = t_s.windows(3).zip(rows.windows(3)).map(off_squared).collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}
