//! Cubic splines with two continuous derivatives through unevenly spaced samples.
//!
//! The input is a [`Stream`], the result a [`CubicSpline`] with values and derivatives at any time. The alignment of two
//! logs needs smooth values and speeds, because it is a least-squares problem. Linear interpolation would give values with
//! kinks and speeds with jumps. The ends of a spline are "not-a-knot" (de Boor, A Practical Guide to Splines, ch. IV): the
//! third derivative is continuous at the first and the last inner knot, so that the ends are as accurate as the middle.
//!
//! With values `y`, second derivatives `m`, `h = t_(i+1) - t_i`, `u = (t - t_i) / h` and `w = 1 - u`, the spline between
//! two knots is `w y_i + u y_(i+1) + h^2 / 6 ((w^3 - w) m_i + (u^3 - u) m_(i+1))`.

use super::shared::Shared;
use super::stream::{Row, Stream};

/// Smallest number of rows without a gap: the not-a-knot ends need two inner knots.
pub const KNOTS_MIN: usize = 4;

/// A cubic spline through the rows of a stream, in separate parts without gaps. In a gap of the stream the spline has no value.
#[derive(Debug, Clone, PartialEq)]
pub struct CubicSpline<R> {
    knots: Shared<Stream<R>>,
    /// Second derivatives at the knots \[unit of the values/s²\], knot by knot, one for each number of the row.
    curvatures: Vec<f64>,
    /// Whether the spline has values between knots `i` and `i + 1`.
    bridged: Vec<bool>,
}

/// The interval between two knots.
struct Interval<'a> {
    width_s: f64,
    /// Values at the left and right end.
    ends: [&'a [f64]; 2],
    /// Second derivatives at the left and right end.
    curvatures: [&'a [f64]; 2],
}

/// Value and first two derivatives at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplinePoint<R> {
    /// Values.
    pub value: R,
    /// First derivatives \[1/s\].
    pub rate: R,
    /// Second derivatives \[1/s²\].
    pub acceleration: R,
}

impl<R: Row> Stream<R> {
    /// A spline through all rows, separate for each of the [`Stream::parts`]. Parts of fewer than four rows have no spline;
    /// `None` if all parts are so short.
    pub fn spline(self) -> Option<CubicSpline<R>> {
        CubicSpline::through(self.into())
    }
}

impl<R: Row> CubicSpline<R> {
    /// Like [`Stream::spline`], but for rows with several owners.
    pub fn through(knots: Shared<Stream<R>>) -> Option<Self> {
        let width = row_length(&knots);
        let mut curvatures = vec![0.0; knots.len() * width];
        let mut bridged = vec![false; knots.len().saturating_sub(1)];
        for part in knots.parts().into_iter().filter(|part| part.len() >= KNOTS_MIN) {
            bridged[part.start..part.end - 1].fill(true);
            let out = &mut curvatures[part.start * width..part.end * width];
            solve_curvatures(&knots.t_s[part.clone()], &knots.rows[part], out);
        }
        bridged.contains(&true).then_some(Self { knots, curvatures, bridged })
    }

    /// Value and derivatives `t_s` seconds after the first row; `None` before the first row, after the last row, and in gaps.
    pub fn at(&self, t_s: f64) -> Option<SplinePoint<R>> {
        let interval = self.knots.interval(t_s)?;
        let Interval { width_s, ends: [left, right], curvatures: [m_left, m_right] } =
            self.interval(interval)?;
        let u = (t_s - self.knots.t_s[interval]) / width_s;
        let w = 1.0 - u;
        let h2_over_6 = width_s * width_s / 6.0;
        let row = &self.knots[interval];
        Some(SplinePoint {
            value: row.with_numbers(|i| {
                w * left[i]
                    + u * right[i]
                    + h2_over_6 * ((w * w * w - w) * m_left[i] + (u * u * u - u) * m_right[i])
            }),
            rate: row.with_numbers(|i| {
                (right[i] - left[i]) / width_s
                    + width_s / 6.0 * ((1.0 - 3.0 * w * w) * m_left[i] + (3.0 * u * u - 1.0) * m_right[i])
            }),
            acceleration: row.with_numbers(|i| w * m_left[i] + u * m_right[i]),
        })
    }

    /// Whether [`at`](Self::at) returns a value at this time.
    pub fn covers(&self, t_s: f64) -> bool {
        self.knots.interval(t_s).is_some_and(|interval| self.bridged[interval])
    }

    /// Integral over time from the knot `interval` to the fraction `u` (0 to 1) of the way to the next knot; `None` in gaps.
    pub fn integral_within(&self, interval: usize, u: f64) -> Option<R> {
        let Interval { width_s, ends: [left, right], curvatures: [m_left, m_right] } =
            self.interval(interval)?;
        // The integrals from 0 to u of w, u, h^2 / 6 (w^3 - w) and h^2 / 6 (u^3 - u).
        let (w2, u2) = ((1.0 - u) * (1.0 - u), u * u);
        let (of_left, of_right) = (0.5 * (1.0 - w2), 0.5 * u2);
        let h2_over_6 = width_s * width_s / 6.0;
        let (of_m_left, of_m_right) =
            (h2_over_6 * (0.25 * (1.0 - w2 * w2) - of_left), h2_over_6 * (0.25 * u2 * u2 - of_right));
        Some(self.knots[interval].with_numbers(|i| {
            width_s
                * (of_left * left[i] + of_right * right[i] + of_m_left * m_left[i] + of_m_right * m_right[i])
        }))
    }

    /// Time from the first to the last row \[s\].
    pub fn duration_s(&self) -> f64 {
        self.knots.duration_s()
    }

    /// The interval from the knot `left` to the next knot; `None` in gaps.
    fn interval(&self, left: usize) -> Option<Interval<'_>> {
        let ends = [left, left + 1];
        let width = row_length(&self.knots);
        self.bridged.get(left)?.then(|| {
            let width_s = self.knots.t_s[left + 1] - self.knots.t_s[left];
            let curvatures = ends.map(|knot| &self.curvatures[knot * width..(knot + 1) * width]);
            Interval { width_s, ends: ends.map(|knot| self.knots[knot].numbers()), curvatures }
        })
    }
}

/// Number of values of each row.
fn row_length<R: Row>(rows: &[R]) -> usize {
    rows.first().map_or(0, |row| row.numbers().len())
}

/// Writes the second derivatives `m` at the knots of one part (at least [`KNOTS_MIN`]) to `out`, knot by knot. At each inner
/// knot the first derivative is continuous if
/// `h_(i-1) m_(i-1) + 2 (h_(i-1) + h_i) m_i + h_i m_(i+1) = 6 (slope_i - slope_(i-1))`. This tridiagonal system is
/// diagonally dominant, so it is solved by elimination without pivoting.
fn solve_curvatures<R: Row>(t_s: &[f64], values: &[R], out: &mut [f64]) {
    let (last, width) = (t_s.len() - 1, row_length(values));
    let h = |i: usize| t_s[i + 1] - t_s[i];
    let slope = |i: usize, n: usize| (values[i + 1].numbers()[n] - values[i].numbers()[n]) / h(i);
    let mut upper_over_diagonal = vec![0.0; t_s.len()];
    // Elimination, from the first inner knot to the last.
    for i in 1..last {
        let (mut lower, mut diagonal, mut upper) = (h(i - 1), 2.0 * (h(i - 1) + h(i)), h(i));
        if i == 1 {
            // Not-a-knot: `m_0` is the linear extrapolation of `m_1` and `m_2`, `m_0 = m_1 + h_0 / h_1 (m_1 - m_2)`,
            // so it is eliminated.
            diagonal += h(0) * (1.0 + h(0) / h(1));
            upper -= h(0) * h(0) / h(1);
            lower = 0.0;
        }
        // The same condition at the other end.
        if i == last - 1 {
            diagonal += h(last - 1) * (1.0 + h(last - 1) / h(last - 2));
            lower -= h(last - 1) * h(last - 1) / h(last - 2);
            upper = 0.0;
        }
        let pivot = diagonal - lower * upper_over_diagonal[i - 1];
        upper_over_diagonal[i] = upper / pivot;
        for n in 0..width {
            let right_side = 6.0 * (slope(i, n) - slope(i - 1, n));
            out[i * width + n] = (right_side - lower * out[(i - 1) * width + n]) / pivot;
        }
    }
    // Back substitution.
    for i in (1..last - 1).rev() {
        for n in 0..width {
            out[i * width + n] -= upper_over_diagonal[i] * out[(i + 1) * width + n];
        }
    }
    // The not-a-knot conditions give the second derivatives at the two ends.
    let mut continue_to_end = |knot: usize, [inner, further]: [usize; 2], ratio: f64| {
        for n in 0..width {
            let (near, far) = (out[inner * width + n], out[further * width + n]);
            out[knot * width + n] = near + ratio * (near - far);
        }
    };
    continue_to_end(0, [1, 2], h(0) / h(1));
    continue_to_end(last, [last - 1, last - 2], h(last - 1) / h(last - 2));
}
