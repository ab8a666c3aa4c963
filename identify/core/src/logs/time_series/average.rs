//! A centred moving average of any stream.

use super::spline::CubicSpline;
use super::stream::{Row, Stream};

impl<R: Row> Stream<R> {
    /// Mean of the spline through the rows over `width_s` about each, without what a bend of the path adds to it; none nearer
    /// than `width_s` to an end or to a gap, where a shorter average would be another filter.
    ///
    /// A plain mean of a curved motion lies inside the curve, by `width^2 / 24` times its acceleration. In both logs alike,
    /// but the bar's joints are not a linear function of the robot's: the mean of the one is not implied by the mean of the other, and where the robot is fast the two are a tenth of a millimetre apart. A mean over twice the width is off by
    /// four times as much, so `(4 mean - mean of twice the width) / 3` is not (Richardson's extrapolation), at 1.2 times the
    /// noise of the mean.
    ///
    /// A mean of splines, not of samples: eleven samples at 100 Hz and twenty-five at 250 Hz span different widths, and the
    /// difference would stay in the result wherever the motion is curved.
    pub fn averages(&self, width_s: f64) -> Vec<Option<R>> {
        let of_part = |part| {
            let part = self.slice(part);
            let integral = Integral::new(&part);
            let average = |(row, t_s): (&R, &f64)| {
                let integral = integral.as_ref()?;
                let (mean, wider) = (integral.mean(*t_s, width_s)?, integral.mean(*t_s, 2.0 * width_s)?);
                let (mean, wider) = (mean.numbers(), wider.numbers());
                Some(row.like(|i| (4.0 * mean[i] - wider[i]) / 3.0))
            };
            part.iter().zip(&part.t_s).map(average).collect::<Vec<_>>()
        };
        self.parts().into_iter().flat_map(of_part).collect()
    }

    /// The rows that have one, replaced by their [`Self::averages`].
    pub fn averaged(&self, width_s: f64) -> Self {
        let averages = self.averages(width_s);
        self.filter_map(0..self.len(), |place, _| averages[place])
    }
}

/// Integral of the spline through a part without gaps, each number about its mean so that little is lost to rounding.
struct Integral<'a, R> {
    t_s: &'a [f64],
    spline: CubicSpline<R>,
    middle: R,
    /// From the first row to each.
    until: Vec<R>,
}

impl<'a, R: Row> Integral<'a, R> {
    /// `None` if the rows are too few for a spline.
    fn new(part: &'a Stream<R>) -> Option<Self> {
        let count = part.len() as f64;
        let middle = part.first()?.like(|i| part.iter().map(|row| row.numbers()[i]).sum::<f64>() / count);
        let spline = part.map(|row| row.like(|i| row.numbers()[i] - middle.numbers()[i])).spline()?;
        let mut sum = middle.like(|_| 0.0);
        let mut until = vec![sum];
        for interval in 0..part.len() - 1 {
            let by = spline.integral_within(interval, 1.0)?;
            sum = sum.like(|i| sum.numbers()[i] + by.numbers()[i]);
            until.push(sum);
        }
        Some(Self { t_s: &part.t_s, spline, middle, until })
    }

    /// Mean over `width_s` about `t_s`; `None` if that extends beyond an end.
    fn mean(&self, t_s: f64, width_s: f64) -> Option<R> {
        let (before, after) = (self.at(t_s - 0.5 * width_s)?, self.at(t_s + 0.5 * width_s)?);
        let (before, after) = (before.numbers(), after.numbers());
        Some(self.middle.like(|i| (after[i] - before[i]) / width_s + self.middle.numbers()[i]))
    }

    /// From the first row to `t_s`; none outside.
    fn at(&self, t_s: f64) -> Option<R> {
        /// Rounding of stamps that were decimal numbers \[s\].
        const ROUNDING_S: f64 = 1e-9;
        if t_s < -ROUNDING_S || t_s > self.t_s.last()? + ROUNDING_S {
            return None;
        }
        let after = self.t_s.partition_point(|stamp| *stamp <= t_s).clamp(1, self.t_s.len() - 1);
        let from = after - 1;
        let u = (t_s - self.t_s[from]) / (self.t_s[after] - self.t_s[from]);
        let (until, within) = (self.until[from], self.spline.integral_within(from, u)?);
        Some(until.like(|i| until.numbers()[i] + within.numbers()[i]))
    }
}
