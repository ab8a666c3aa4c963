//! Cubic splines with two continuous derivatives through unevenly spaced samples.
//!
//! The alignment of two logs needs the speed as much as the value, and a least-squares solve needs both without
//! kinks; linear interpolation has neither. Ends are "not-a-knot" (de Boor, A Practical Guide to Splines, ch. IV):
//! the third derivative passes the last inner knot unbroken, so that the ends are as exact as the middle.

/// Fewest samples of one continuous part: two inner knots for the not-a-knot ends.
pub const KNOTS_MIN: usize = 4;

use super::stream::{Row, Stream};

/// A spline through a row of values per stamp. Parts that are further apart than a limit are separate splines, and there
/// is no value between them.
#[derive(Debug, Clone, PartialEq)]
pub struct CubicSpline<R> {
    knots: Stream<R>,
    /// Second derivative at each knot.
    curvatures: Vec<R>,
    /// Interval `i` lies between knots `i` and `i + 1`.
    bridged: Vec<bool>,
}

/// Value and first two derivatives at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplinePoint<R> {
    /// Values.
    pub value: R,
    /// Derivatives \[1/s\].
    pub rate: R,
    /// Second derivatives \[1/s²\].
    pub acceleration: R,
}

impl<R: Row> Stream<R> {
    /// Through all rows, each of the [`Stream::parts`] by itself; none where no part has four rows.
    pub fn spline(&self) -> Option<CubicSpline<R>> {
        let mut curvatures: Vec<R> = self.iter().map(|row| row.like(|_| 0.0)).collect();
        let mut bridged = vec![false; self.len().saturating_sub(1)];
        for part in self.parts().into_iter().filter(|part| part.len() >= KNOTS_MIN) {
            bridged[part.start..part.end - 1].fill(true);
            bend(&self.t_s[part.clone()], &self.rows[part.clone()], &mut curvatures[part]);
        }
        bridged.contains(&true).then(|| CubicSpline { knots: self.clone(), curvatures, bridged })
    }
}

impl<R: Row> CubicSpline<R> {
    /// Value and derivatives at `t_s` after the first row; none outside the rows and inside gaps.
    pub fn at(&self, t_s: f64) -> Option<SplinePoint<R>> {
        let interval = self.knots.interval(t_s)?;
        let (width_s, [left, right, m_left, m_right]) = self.interval(interval)?;
        let u = (t_s - self.knots.t_s[interval]) / width_s;
        let w = 1.0 - u;
        let h2 = width_s * width_s / 6.0;
        let row = &self.knots[interval];
        Some(SplinePoint {
            value: row.like(|i| {
                w * left[i] + u * right[i] + h2 * ((w * w * w - w) * m_left[i] + (u * u * u - u) * m_right[i])
            }),
            rate: row.like(|i| {
                (right[i] - left[i]) / width_s
                    + width_s / 6.0 * ((1.0 - 3.0 * w * w) * m_left[i] + (3.0 * u * u - 1.0) * m_right[i])
            }),
            acceleration: row.like(|i| w * m_left[i] + u * m_right[i]),
        })
    }

    /// Integral from knot `interval` over the part `u` (0 to 1) of the way to the next one; none in gaps.
    pub fn integral_within(&self, interval: usize, u: f64) -> Option<R> {
        let (width_s, [left, right, m_left, m_right]) = self.interval(interval)?;
        let (w2, u2) = ((1.0 - u) * (1.0 - u), u * u);
        let (of_left, of_right) = (0.5 * (1.0 - w2), 0.5 * u2);
        let h2 = width_s * width_s / 6.0;
        let (of_m_left, of_m_right) =
            (h2 * (0.25 * (1.0 - w2 * w2) - of_left), h2 * (0.25 * u2 * u2 - of_right));
        Some(self.knots[interval].like(|i| {
            width_s
                * (of_left * left[i] + of_right * right[i] + of_m_left * m_left[i] + of_m_right * m_right[i])
        }))
    }

    /// From first to last row \[s\].
    pub fn duration_s(&self) -> f64 {
        self.knots.duration_s()
    }

    /// Width of an interval \[s\], values at its left and right end, and curvatures there; none in gaps.
    fn interval(&self, left: usize) -> Option<(f64, [&[f64]; 4])> {
        let ends = [left, left + 1];
        self.bridged.get(left)?.then(|| {
            let [a, b] = ends.map(|knot| self.knots[knot].numbers());
            let [m_a, m_b] = ends.map(|knot| self.curvatures[knot].numbers());
            (self.knots.t_s[left + 1] - self.knots.t_s[left], [a, b, m_a, m_b])
        })
    }
}

/// Second derivatives at the knots of one part (at least [`KNOTS_MIN`]): the tridiagonal system of continuous first
/// derivatives, solved by elimination without pivoting (it is diagonally dominant).
fn bend<R: Row>(t_s: &[f64], values: &[R], out: &mut [R]) {
    let last = t_s.len() - 1;
    let h: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let slope = |i: usize, n: usize| (values[i + 1].numbers()[n] - values[i].numbers()[n]) / h[i];
    let mut upper_over_diagonal = vec![0.0; t_s.len()];
    for i in 1..last {
        let (mut lower, mut diagonal, mut upper) = (h[i - 1], 2.0 * (h[i - 1] + h[i]), h[i]);
        if i == 1 {
            // The curvature at the first knot is the linear continuation of the next two.
            diagonal += h[0] * (1.0 + h[0] / h[1]);
            upper -= h[0] * h[0] / h[1];
            lower = 0.0;
        }
        if i == last - 1 {
            diagonal += h[last - 1] * (1.0 + h[last - 1] / h[last - 2]);
            lower -= h[last - 1] * h[last - 1] / h[last - 2];
            upper = 0.0;
        }
        let pivot = diagonal - lower * upper_over_diagonal[i - 1];
        upper_over_diagonal[i] = upper / pivot;
        let before = out[i - 1];
        out[i] = before.like(|n| {
            let right_side = 6.0 * (slope(i, n) - slope(i - 1, n));
            (right_side - lower * before.numbers()[n]) / pivot
        });
    }
    for i in (1..last - 1).rev() {
        let (factor, after) = (upper_over_diagonal[i], out[i + 1]);
        out[i] = after.like(|n| out[i].numbers()[n] - factor * after.numbers()[n]);
    }
    let end = |inner: R, further: R, ratio: f64| {
        let (near, far) = (inner.numbers(), further.numbers());
        inner.like(|n| near[n] + ratio * (near[n] - far[n]))
    };
    out[0] = end(out[1], out[2], h[0] / h[1]);
    out[last] = end(out[last - 1], out[last - 2], h[last - 1] / h[last - 2]);
}
