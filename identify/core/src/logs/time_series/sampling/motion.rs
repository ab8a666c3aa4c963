//! Counts the periods of the clock from each row to the next by the motion of the joints.
//!
//! A joint step is the change of the joints from one row to the next. If the joints move at constant speed, all joint steps
//! are equal. A step of `m` times the usual size therefore shows that `m` periods passed ([`periods_by_motion`]). Where the
//! stamps have missing rows, [`compare_motion`] also fits a curve to the rows on either side, which is more accurate.

use std::ops::Range;

use nalgebra::DMatrix;

use crate::kinematics::Joints;
use crate::statistics::median;

/// Number of rows on either side whose joint steps determine the usual step, which is the joint step in one period.
pub(super) const NEIGHBOURS: usize = 6;
/// A step is a multiple of the usual step if it differs from that multiple by less than this fraction of the usual step. The
/// usual steps on both sides must also differ by less than this fraction.
pub(super) const WHOLE: f64 = 0.2;
/// Largest number of periods between two rows that is determined from the motion.
pub(super) const PERIODS_MAX: f64 = 4.0;
/// Smallest number of neighbouring steps that must be multiples of the usual step. If the steps contain only rounding
/// errors, one row in a thousand reaches this number by chance.
const NEIGHBOURS_WHOLE: usize = 10;
/// The count by joint steps is wrong for one step in this number (see [`NEIGHBOURS_WHOLE`]). A curve overrules it only
/// with odds above this number.
const MISCOUNTED: f64 = 1000.0;

/// Number of periods from each row to the next, where the motion determines it.
pub(super) fn periods_by_motion(rows: &[Joints]) -> Vec<Option<f64>> {
    /// Number of passes. If many rows are missing, the usual step is only known at some rows. Each pass determines more
    /// periods, and with them the usual steps of the next pass.
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

/// Number of periods of the joint step `at`: the multiple `m` of `step = m usual`. The usual step is the mean of the usual
/// steps on both sides. The usual step of a side is the median of the steps divided by their `periods`. Steps whose
/// periods are not yet known are left out.
fn periods_of_step(steps: &[Joints], periods: &[Option<f64>], at: usize) -> Option<f64> {
    /// If the usual step is smaller, the robot stands still \[rad, m\].
    const STEP_RAD_MIN: f64 = 50e-6;
    let sides = [at.checked_sub(NEIGHBOURS)?..at, at + 1..at + 1 + NEIGHBOURS];
    // The usual step on one side, if enough steps of that side have known periods.
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
    // The multiple, if `step` is a whole multiple of `usual` in size and direction.
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

/// Compares two counts of the periods between rows: `motion`, from the joint steps, and `periods`, from the stamps. If rows
/// are missing according to the stamps, a curve through `side` rows on either side determines the count instead, if the
/// curve is accurate enough. The curve needs the numbers of these rows on the clock. If the motion is unknown, `if_unknown`
/// converts the count from the stamps to the count that the curve assumes.
///
/// Returns the counts from the motion, corrected by the curves, and how strongly they contradict the stamps \[nats\].
pub(super) fn compare_motion(
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
        let rows_missing = stamped > 1.0 && stamped <= PERIODS_MAX;
        tests += usize::from(rows_missing);
        let by_curve =
            if rows_missing { periods_by_curve(rows, side, &numbers, row, stamped as usize) } else { None };
        *shown = by_curve.map(|(periods, _)| periods).or(*shown);
        if shown.is_some_and(|shown| shown != stamped) {
            contradictions_nats.push(by_curve.map_or(MISCOUNTED.ln(), |(_, nats)| nats));
        }
    }
    // Among many tested rows, the largest contradiction is large by chance. The logarithm of the number of
    // tests corrects for this.
    let by_chance_nats = f64::ln(tests.max(1) as f64);
    (motion, contradictions_nats.iter().map(|nats| (nats - by_chance_nats).max(0.0)).sum())
}

/// Finds the number of periods from `row` to the next row, between 1 and `most`. It is the number with which the `side` rows
/// on both sides are nearest to a cubic curve. Returns this number and its log-likelihood ratio to the second-best number.
/// `None` if the ratio is too small. `numbers` are the numbers of the rows on the clock.
fn periods_by_curve(
    rows: &[Joints],
    side: usize,
    numbers: &[f64],
    row: usize,
    most: usize,
) -> Option<(f64, f64)> {
    /// Smallest number of rows on each side from which a cubic is estimated.
    const SIDE_MIN: usize = 8;
    const TERMS: usize = 4;
    let first = (row + 1).saturating_sub(side);
    let end = (row + 1 + side).min(rows.len());
    if row + 1 < first + SIDE_MIN || end < row + 1 + SIDE_MIN {
        return None;
    }
    let (count, axes) = (end - first, rows[row].len());
    let joints = DMatrix::from_fn(count, axes, |i, axis| rows[first + i][axis] - rows[row][axis]);
    // Sum of squared distances of the rows from the best cubic, if the next row is `periods` after `row`.
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
    // Residuals of the cubic are correlated from row to row, so two rows count as one: the factor is 1/4 instead of 1/2.
    let nats = 0.25 * (second - least) / variance;
    (nats > MISCOUNTED.ln()).then_some((best as f64, nats))
}
