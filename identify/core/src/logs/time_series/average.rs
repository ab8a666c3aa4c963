//! A centred moving average of any stream.

use super::spline::CubicSpline;
use super::stream::{Row, Stream};

impl<R: Row> Stream<R> {
    /// Average of each row over the time `width_s` around it, without the bias from the curvature of the motion. `None` for
    /// rows nearer than `width_s` to an end or a gap, because an average over a shorter time would be another filter.
    ///
    /// The mean over a curved motion is biased by `width^2 / 24` times its acceleration. Both the robot's log and the bar's
    /// log would have this bias. It would not cancel, because the bar's joints are not a linear function of the robot's
    /// joints. For a fast robot, the resulting contradiction between the logs reaches a tenth of a millimetre. The mean over
    /// twice the width has four times the bias, so `(4 mean - mean over twice the width) / 3` has no bias (Richardson's
    /// extrapolation). The noise of this result is 1.2 times the noise of the mean.
    ///
    /// The mean is an integral of the spline through all rows, not a mean of samples, because logs differ in rate:
    /// eleven samples at 100 Hz and twenty-five at 250 Hz span different times. If the motion is curved, means of
    /// samples would therefore differ between the logs.
    pub fn averages(&self, width_s: f64) -> Vec<Option<R>> {
        let averages_of = |part| {
            let part = self.slice(part);
            let integral = Integral::new(&part);
            let average = |(row, t_s): (&R, &f64)| {
                let integral = integral.as_ref()?;
                let mean = integral.mean(*t_s, width_s)?;
                let wider_mean = integral.mean(*t_s, 2.0 * width_s)?;
                Some(row.with_numbers(|i| (4.0 * mean.numbers()[i] - wider_mean.numbers()[i]) / 3.0))
            };
            part.iter().zip(&part.t_s).map(average).collect::<Vec<_>>()
        };
        self.parts().into_iter().flat_map(averages_of).collect()
    }

    /// The [`Self::averages`] as a stream. Rows without an average are left out.
    pub fn averaged(&self, width_s: f64) -> Self {
        let averages = self.averages(width_s);
        self.filter_map(0..self.len(), |row, _| averages[row])
    }
}

/// Integral over time of the spline through a segment without gaps. The mean of each number is subtracted first,
/// to reduce rounding errors.
struct Integral<'a, R> {
    /// Times of the rows \[s\].
    t_s: &'a [f64],
    /// Spline through the rows minus `centre`.
    spline: CubicSpline<R>,
    /// Mean of each number over all rows.
    centre: R,
    /// Integral of `spline` from the first row to each row.
    until_row: Vec<R>,
}

impl<'a, R: Row> Integral<'a, R> {
    /// Integrates the spline through `part`. `None` if it has too few rows for a spline.
    fn new(part: &'a Stream<R>) -> Option<Self> {
        let count = part.len() as f64;
        let centre = part.first()?.with_numbers(|i| part.iter().map(|r| r.numbers()[i]).sum::<f64>() / count);
        let spline = part.map(|row| row.with_numbers(|i| row.numbers()[i] - centre.numbers()[i])).spline()?;
        let mut sum = centre.with_numbers(|_| 0.0);
        let mut until_row = vec![sum];
        for interval in 0..part.len() - 1 {
            let within = spline.integral_within(interval, 1.0)?;
            sum = sum.with_numbers(|i| sum.numbers()[i] + within.numbers()[i]);
            until_row.push(sum);
        }
        Some(Self { t_s: &part.t_s, spline, centre, until_row })
    }

    /// Mean of the spline over `width_s` around `t_s`; `None` if this interval extends beyond an end.
    fn mean(&self, t_s: f64, width_s: f64) -> Option<R> {
        let (until_start, until_end) = (self.until(t_s - 0.5 * width_s)?, self.until(t_s + 0.5 * width_s)?);
        let (start, end) = (until_start.numbers(), until_end.numbers());
        Some(self.centre.with_numbers(|i| (end[i] - start[i]) / width_s + self.centre.numbers()[i]))
    }

    /// Integral of `spline` from the first row to `t_s`; `None` outside the segment.
    fn until(&self, t_s: f64) -> Option<R> {
        /// Rounding error of stamps that were written as decimal numbers \[s\].
        const ROUNDING_S: f64 = 1e-9;
        if t_s < -ROUNDING_S || t_s > self.t_s.last()? + ROUNDING_S {
            return None;
        }
        let after = self.t_s.partition_point(|stamp| *stamp <= t_s).clamp(1, self.t_s.len() - 1);
        let from = after - 1;
        let fraction = (t_s - self.t_s[from]) / (self.t_s[after] - self.t_s[from]);
        let (until_row, within) = (self.until_row[from], self.spline.integral_within(from, fraction)?);
        Some(until_row.with_numbers(|i| until_row.numbers()[i] + within.numbers()[i]))
    }
}
