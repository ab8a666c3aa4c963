//! Clock shift and skew from the angles: finer than the correlation of speeds, and right for runs of an hour.

use nalgebra::{DMatrix, DVector};

use super::offsets::wrapped;
use super::{Offsets, Predictor};
use crate::kinematics::BAR_JOINTS;

/// Robot time against bar time: `tau = shift + (1 + skew) t`, both from their own zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockFit {
    /// Robot time, after the log's first stamp, at bar time zero \[s\].
    pub shift_s: f64,
    /// Relative rate of the robot's clock minus one.
    pub skew: f64,
}

impl ClockFit {
    /// Robot time, after the log's first stamp, at bar time `t_s` \[s\].
    pub fn tau_s(&self, t_s: f64) -> f64 {
        self.shift_s + t_s + self.skew * t_s
    }
}

/// Half the distance over which speeds are differenced \[s\].
const DIFFERENCE_S: f64 = 0.005;
/// Clocks of controllers differ by this much, one standard deviation.
const SKEW_SIGMA: f64 = 100e-6;
/// Errors of the nominal geometry change slowly: so many neighbouring samples say the same.
const SAMPLES_ALIKE: f64 = 50.0;
/// Rounds of linearising and weighting.
const ROUNDS: usize = 4;

/// Improves `start` by least squares of the angle differences, with one free constant per encoder, so that offsets do
/// not matter. Robust (Cauchy), because the nominal geometry is wrong by an unknown amount. Returns `start` where
/// the samples do not determine it.
///
/// `samples` are bar times \[s\], best about zero, and measured angles \[rad\].
pub fn refine_clock(
    predictor: &Predictor<'_>,
    samples: &[(f64, [f64; BAR_JOINTS])],
    offsets: &Offsets,
    start: ClockFit,
) -> ClockFit {
    let mut fit = start;
    for _ in 0..ROUNDS {
        let rows = rows(predictor, samples, offsets, fit);
        let Some([shift, skew]) = solve(&rows, offsets.encoders.len(), fit.skew) else { return start };
        fit = ClockFit { shift_s: fit.shift_s + shift, skew: fit.skew + skew };
    }
    fit
}

/// One encoder at one instant: `difference = constant[encoder] - speed (shift + skew t)`.
struct Row {
    encoder: usize,
    t_s: f64,
    speed_rad_s: f64,
    difference_rad: f64,
}

fn rows(
    predictor: &Predictor<'_>,
    samples: &[(f64, [f64; BAR_JOINTS])],
    offsets: &Offsets,
    fit: ClockFit,
) -> Vec<Row> {
    let mut rows = Vec::with_capacity(samples.len() * offsets.encoders.len());
    for (t_s, measured_rad) in samples {
        let tau_s = fit.tau_s(*t_s);
        let around = [-DIFFERENCE_S, 0.0, DIFFERENCE_S].map(|by| predictor.at(tau_s + by));
        let [Some(before), Some(now), Some(after)] = around else { continue };
        let [before, now_rad, after] = [before, now, after].map(|bar| offsets.configuration.carry(&bar.joints_rad));
        // Near singular poses errors of gimbal and cardan grow by the inverse of this.
        let trust = now.margin_rad.sin();
        for (encoder, offset) in offsets.encoders.iter().enumerate() {
            let joint = usize::from(offset.joint) - 1;
            let speed_rad_s = wrapped(after[joint] - before[joint]) / (2.0 * DIFFERENCE_S);
            let difference_rad = wrapped(now_rad[joint] - measured_rad[joint] - offset.offset_rad);
            rows.push(Row {
                encoder,
                t_s: *t_s,
                speed_rad_s: speed_rad_s * trust,
                difference_rad: difference_rad * trust,
            });
        }
    }
    rows
}

/// Change of shift and skew.
fn solve(rows: &[Row], encoders: usize, skew: f64) -> Option<[f64; 2]> {
    let columns = encoders + 2;
    let mut solution = DVector::zeros(columns);
    for _ in 0..ROUNDS {
        let residual = |row: &Row, x: &DVector<f64>| {
            row.difference_rad - x[2 + row.encoder] + row.speed_rad_s * (x[0] + row.t_s * x[1])
        };
        let mut sizes: Vec<f64> = rows.iter().map(|row| residual(row, &solution).abs()).collect();
        let middle = sizes.len() / 2;
        if sizes.len() < 10 * columns {
            return None;
        }
        let sigma = (1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1).max(1e-9);
        let mut normal = DMatrix::zeros(columns, columns);
        let mut right = DVector::zeros(columns);
        for row in rows {
            let weight = 1.0 / (1.0 + (residual(row, &solution) / (2.385 * sigma)).powi(2));
            let parts = [(0, -row.speed_rad_s), (1, -row.speed_rad_s * row.t_s), (2 + row.encoder, 1.0)];
            for (i, a) in parts {
                right[i] += weight * a * row.difference_rad;
                for (j, b) in parts {
                    normal[(i, j)] += weight * a * b;
                }
            }
        }
        let prior = SAMPLES_ALIKE * (sigma / SKEW_SIGMA).powi(2);
        normal[(1, 1)] += prior;
        right[1] -= prior * skew;
        solution = normal.cholesky()?.solve(&right);
    }
    Some([solution[0], solution[1]])
}
