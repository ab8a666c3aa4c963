//! A centred moving average, the same for both logs.

use super::bar_angles::BarSegment;
use crate::kinematics::Joints;
use crate::logs::{CubicSpline, RobotLog, Row};

/// Bar samples further apart are not averaged across \[s\].
pub(in crate::prepare) const BAR_GAP_S: f64 = 0.05;

/// The segments with every angle replaced by its average ([`moving_average`]). Samples whose time is not covered on both sides
/// are left out: a shorter average would be another filter.
pub(in crate::prepare) fn smoothed_segments(segments: &[BarSegment], width_s: f64) -> Vec<BarSegment> {
    let smoothed = segments.iter().map(|segment| {
        let Some(first) = segment.times.first() else { return BarSegment::default() };
        let t_s: Vec<f64> = segment.times.iter().map(|time| time.seconds_since(*first)).collect();
        let averages = moving_average(&t_s, &segment.angles_rad, width_s, BAR_GAP_S);
        let mut smoothed = BarSegment::default();
        for ((cycle, time), average) in segment.cycles.iter().zip(&segment.times).zip(averages) {
            let Some(average) = average else { continue };
            smoothed.cycles.push(*cycle);
            smoothed.times.push(*time);
            smoothed.angles_rad.push(average);
        }
        smoothed
    });
    smoothed.filter(|segment| !segment.times.is_empty()).collect()
}

/// The robot's log in the same way.
pub(in crate::prepare) fn smoothed_log(log: &RobotLog, width_s: f64, gap_s: f64) -> RobotLog {
    let averages = moving_average(&log.t_s, &log.q_rad, width_s, gap_s);
    let kept: Vec<(f64, Joints)> =
        log.t_s.iter().zip(averages).filter_map(|(t_s, average)| Some((*t_s, average?))).collect();
    let first_s = kept.first().map_or(0.0, |(t_s, _)| *t_s);
    RobotLog {
        first_stamp_ns: log.first_stamp_ns.saturating_add((first_s * 1e9).round() as i64),
        t_s: kept.iter().map(|(t_s, _)| t_s - first_s).collect(),
        q_rad: kept.iter().map(|(_, q_rad)| *q_rad).collect(),
        ..log.clone()
    }
}

/// Mean of the spline through the values over `width_s` about each stamp, without what a bend of the path adds to it; none
/// nearer than `width_s` to an end or to a hole longer than `gap_s`.
///
/// A plain mean of a curved motion lies inside the curve, by `width^2 / 24` times its acceleration. In both logs alike,
/// but the bar's joints are no linear function of the robot's: the mean of the one is not what the mean of the other
/// implies, and where the robot is fast the two are a tenth of a millimetre apart. A mean over twice the width is off by four
/// times as much, so `(4 mean - mean of twice the width) / 3` is not (Richardson's extrapolation), at 1.2 times the
/// noise of the mean.
///
/// A mean of splines, not of samples: eleven samples at 100 Hz and twenty-five at 250 Hz span different widths, and the
/// difference would stay in the result wherever the motion is curved.
pub fn moving_average<R: Row>(t_s: &[f64], values: &[R], width_s: f64, gap_s: f64) -> Vec<Option<R>> {
    let mut averages = Vec::with_capacity(t_s.len());
    let mut from = 0;
    for to in 1..=t_s.len().min(values.len()) {
        let ends = to == t_s.len() || t_s[to] - t_s[to - 1] > gap_s;
        if ends {
            let integral = Integral::new(&t_s[from..to], &values[from..to]);
            averages.extend(t_s[from..to].iter().map(|t| {
                let integral = integral.as_ref()?;
                let (mean, wider) = (integral.mean(*t, width_s)?, integral.mean(*t, 2.0 * width_s)?);
                Some(mean.like(|i| (4.0 * mean[i] - wider[i]) / 3.0))
            }));
            from = to;
        }
    }
    averages
}

/// Integral of the spline through values, each about its mean so that little is lost to rounding.
struct Integral<'a, R> {
    t_s: &'a [f64],
    spline: CubicSpline<R>,
    middle: R,
    /// From the first stamp to each.
    until: Vec<R>,
}

impl<'a, R: Row> Integral<'a, R> {
    /// None where the values are too few for a spline.
    fn new(t_s: &'a [f64], values: &[R]) -> Option<Self> {
        let count = values.len().max(1) as f64;
        let middle = values.first()?.like(|i| values.iter().map(|value| value[i]).sum::<f64>() / count);
        let about: Vec<R> = values.iter().map(|value| value.like(|i| value[i] - middle[i])).collect();
        let spline = CubicSpline::new(t_s, &about, f64::INFINITY)?;
        let mut sum = middle.like(|_| 0.0);
        let mut until = vec![sum];
        for interval in 0..t_s.len() - 1 {
            let by = spline.integral_within(interval, 1.0)?;
            sum = sum.like(|i| sum[i] + by[i]);
            until.push(sum);
        }
        Some(Self { t_s, spline, middle, until })
    }

    /// Over `width_s` about `t_s`; none where that reaches beyond an end.
    fn mean(&self, t_s: f64, width_s: f64) -> Option<R> {
        let (before, after) = (self.at(t_s - 0.5 * width_s)?, self.at(t_s + 0.5 * width_s)?);
        Some(after.like(|i| (after[i] - before[i]) / width_s + self.middle[i]))
    }

    /// From the first stamp to `t_s`; none outside.
    fn at(&self, t_s: f64) -> Option<R> {
        /// Stamps that stand for decimal numbers are off by as much \[s\].
        const ROUNDING_S: f64 = 1e-9;
        let (first, last) = (*self.t_s.first()?, *self.t_s.last()?);
        if t_s < first - ROUNDING_S || t_s > last + ROUNDING_S {
            return None;
        }
        let after = self.t_s.partition_point(|stamp| *stamp <= t_s).clamp(1, self.t_s.len() - 1);
        let from = after - 1;
        let u = (t_s - self.t_s[from]) / (self.t_s[after] - self.t_s[from]);
        let within = self.spline.integral_within(from, u)?;
        Some(within.like(|i| self.until[from][i] + within[i]))
    }
}
