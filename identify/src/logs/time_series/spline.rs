//! Cubic splines with two continuous derivatives through unevenly spaced samples.
//!
//! The alignment of two logs needs the speed as much as the value, and a least-squares solve needs both without
//! kinks; linear interpolation has neither. Ends are "not-a-knot" (de Boor, A Practical Guide to Splines, ch. IV):
//! the third derivative passes the last inner knot unbroken, so that the ends are as exact as the middle.

/// Fewest samples of one continuous part: two inner knots for the not-a-knot ends.
pub const KNOTS_MIN: usize = 4;

use std::ops::Index;

use crate::kinematics::Joints;

/// The numbers of one stamp: an array, or one number for each axis of a robot.
pub trait Row: Copy + Index<usize, Output = f64> {
    /// Another row of the same length, from its places.
    fn like(&self, of: impl FnMut(usize) -> f64) -> Self;
}

impl<const N: usize> Row for [f64; N] {
    #[inline]
    fn like(&self, of: impl FnMut(usize) -> f64) -> Self {
        std::array::from_fn(of)
    }
}

impl Row for Joints {
    #[inline]
    fn like(&self, of: impl FnMut(usize) -> f64) -> Self {
        Self::from_fn(self.len(), of)
    }
}

/// A spline through a row of values per stamp. Parts that are further apart than a limit are separate splines, and there
/// is no value between them.
#[derive(Debug, Clone, PartialEq)]
pub struct CubicSpline<R> {
    t_s: Vec<f64>,
    values: Vec<R>,
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

impl<R: Row> CubicSpline<R> {
    /// Through `values` at `t_s`, which must increase strictly; surplus entries of the longer list are ignored.
    /// Neighbours further apart than `gap_limit_s` are not connected. None where no part has [`KNOTS_MIN`] samples.
    pub fn new(t_s: &[f64], values: &[R], gap_limit_s: f64) -> Option<Self> {
        let count = t_s.len().min(values.len());
        let (t_s, values) = (t_s.get(..count)?, values.get(..count)?);
        let mut spline = Self {
            t_s: t_s.to_vec(),
            values: values.to_vec(),
            curvatures: values.iter().map(|row| row.like(|_| 0.0)).collect(),
            bridged: vec![false; count.saturating_sub(1)],
        };
        let mut start = 0;
        for end in 1..=count {
            let part_ends = end == count || t_s[end] - t_s[end - 1] > gap_limit_s;
            if !part_ends {
                continue;
            }
            if end - start >= KNOTS_MIN {
                let part = start..end;
                curvatures(&t_s[part.clone()], &values[part.clone()], &mut spline.curvatures[part]);
                spline.bridged[start..end - 1].fill(true);
            }
            start = end;
        }
        spline.bridged.contains(&true).then_some(spline)
    }

    /// Value and derivative at `t_s`; none outside the samples and inside gaps.
    pub fn at(&self, t_s: f64) -> Option<SplinePoint<R>> {
        let after = self.t_s.partition_point(|&knot| knot <= t_s);
        // The last knot belongs to the interval before it.
        let interval =
            if self.t_s.last() == Some(&t_s) { after.checked_sub(2)? } else { after.checked_sub(1)? };
        if !*self.bridged.get(interval)? {
            return None;
        }
        let width_s = self.t_s[interval + 1] - self.t_s[interval];
        let u = (t_s - self.t_s[interval]) / width_s;
        let (left, right) = (&self.values[interval], &self.values[interval + 1]);
        let (m_left, m_right) = (&self.curvatures[interval], &self.curvatures[interval + 1]);
        let w = 1.0 - u;
        let h2 = width_s * width_s / 6.0;
        Some(SplinePoint {
            value: left.like(|i| {
                w * left[i] + u * right[i] + h2 * ((w * w * w - w) * m_left[i] + (u * u * u - u) * m_right[i])
            }),
            rate: left.like(|i| {
                (right[i] - left[i]) / width_s
                    + width_s / 6.0 * ((1.0 - 3.0 * w * w) * m_left[i] + (3.0 * u * u - 1.0) * m_right[i])
            }),
            acceleration: left.like(|i| w * m_left[i] + u * m_right[i]),
        })
    }

    /// Integral from knot `interval` over the part `u` (0 to 1) of the way to the next one; none in gaps.
    pub fn integral_within(&self, interval: usize, u: f64) -> Option<R> {
        if !*self.bridged.get(interval)? {
            return None;
        }
        let width_s = self.t_s[interval + 1] - self.t_s[interval];
        let (left, right) = (&self.values[interval], &self.values[interval + 1]);
        let (m_left, m_right) = (&self.curvatures[interval], &self.curvatures[interval + 1]);
        let (w2, u2) = ((1.0 - u) * (1.0 - u), u * u);
        let (of_left, of_right) = (0.5 * (1.0 - w2), 0.5 * u2);
        let h2 = width_s * width_s / 6.0;
        let (of_m_left, of_m_right) =
            (h2 * (0.25 * (1.0 - w2 * w2) - of_left), h2 * (0.25 * u2 * u2 - of_right));
        Some(left.like(|i| {
            width_s
                * (of_left * left[i] + of_right * right[i] + of_m_left * m_left[i] + of_m_right * m_right[i])
        }))
    }

    /// First and last stamp.
    pub fn range_s(&self) -> (f64, f64) {
        (self.t_s.first().copied().unwrap_or_default(), self.t_s.last().copied().unwrap_or_default())
    }
}

/// Second derivatives at the knots of one part (at least [`KNOTS_MIN`]): the tridiagonal system of continuous first
/// derivatives, solved by elimination without pivoting (it is diagonally dominant).
fn curvatures<R: Row>(t_s: &[f64], values: &[R], out: &mut [R]) {
    let last = t_s.len() - 1;
    let h: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let slope = |i: usize, n: usize| (values[i + 1][n] - values[i][n]) / h[i];
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
            (right_side - lower * before[n]) / pivot
        });
    }
    for i in (1..last - 1).rev() {
        let (factor, after) = (upper_over_diagonal[i], out[i + 1]);
        out[i] = after.like(|n| out[i][n] - factor * after[n]);
    }
    let end = |inner: R, further: R, ratio: f64| inner.like(|n| inner[n] + ratio * (inner[n] - further[n]));
    out[0] = end(out[1], out[2], h[0] / h[1]);
    out[last] = end(out[last - 1], out[last - 2], h[last - 1] / h[last - 2]);
}
