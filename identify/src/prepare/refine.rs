//! Clocks, base and offsets from the angles: finer than the correlation of speeds, and right for runs of an hour.

use nalgebra::{DMatrix, DVector, Vector3};

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

/// What relates the two logs, on nominal geometry.
#[derive(Debug, Clone, PartialEq)]
pub struct Relation {
    /// The clocks.
    pub clock: ClockFit,
    /// Centre of the gimbal in the robot's base \[m\].
    pub base_m: Vector3<f64>,
    /// The encoders and the configuration.
    pub offsets: Offsets,
}

/// Half the distance over which speeds are differenced \[s\].
const DIFFERENCE_S: f64 = 0.005;
/// Distance over which the effect of the base is differenced \[m\].
const DIFFERENCE_M: f64 = 1e-4;
/// The correlation of the speeds gives the shift this well, one standard deviation \[s\]: constant errors of the nominal
/// geometry spoil speeds less than angles.
const SHIFT_SIGMA_S: f64 = 0.001;
/// Clocks of controllers differ by this much, one standard deviation.
const SKEW_SIGMA: f64 = 50e-6;
/// The sphere through the robot's positions gives the base this well, one standard deviation \[m\].
const BASE_SIGMA_M: f64 = 0.003;
/// Errors of the nominal geometry change slowly: so many neighbouring samples say the same.
const SAMPLES_ALIKE: f64 = 300.0;
/// Rounds of linearising.
const ROUNDS: usize = 4;
/// Rounds of weighting in each.
const WEIGHTINGS: usize = 4;
/// Columns before those of the encoders: shift, skew, base.
const COMMON: usize = 5;

/// How far the common columns are expected to go, one standard deviation each.
const EXPECTED: [f64; COMMON] = [SHIFT_SIGMA_S, SKEW_SIGMA, BASE_SIGMA_M, BASE_SIGMA_M, BASE_SIGMA_M];

/// Improves `start` by least squares of the angle differences. Robust (Cauchy), because the nominal geometry is wrong
/// by an unknown amount. Returns `start` where the samples do not determine it.
///
/// `samples` are bar times \[s\], best about zero, and measured angles \[rad\].
pub fn refine(predictor: &Predictor<'_>, samples: &[(f64, [f64; BAR_JOINTS])], start: &Relation) -> Relation {
    let mut now = start.clone();
    for _ in 0..ROUNDS {
        let rows: Vec<Row> = samples
            .iter()
            .filter_map(|(t_s, measured_rad)| rows_of(predictor, *t_s, measured_rad, &now))
            .flatten()
            .collect();
        let base_by = now.base_m - start.base_m;
        let so_far =
            [now.clock.shift_s - start.clock.shift_s, now.clock.skew, base_by.x, base_by.y, base_by.z];
        let Some(step) = solve(&rows, now.offsets.encoders.len(), &so_far) else { return start.clone() };
        now.clock.shift_s += step[0];
        now.clock.skew += step[1];
        now.base_m += Vector3::new(step[2], step[3], step[4]);
        for (encoder, by) in now.offsets.encoders.iter_mut().zip(step.iter().skip(COMMON)) {
            encoder.offset_rad = wrapped(encoder.offset_rad + by);
        }
    }
    now
}

/// One encoder at one instant: predicted minus measured, and how that changes with shift, skew and base.
struct Row {
    encoder: usize,
    slopes: [f64; COMMON],
    /// Slope of the encoder's offset.
    trust: f64,
    difference_rad: f64,
}

fn rows_of(
    predictor: &Predictor<'_>,
    t_s: f64,
    measured_rad: &[f64; BAR_JOINTS],
    relation: &Relation,
) -> Option<Vec<Row>> {
    let Relation { clock, base_m, offsets } = relation;
    let tau_s = clock.tau_s(t_s);
    let at = |by_s: f64, by_m: Vector3<f64>| {
        let bar = predictor.at_with_base(tau_s + by_s, &(base_m + by_m))?;
        Some((offsets.configuration.carry(&bar.joints_rad), bar.margin_rad))
    };
    let (now, margin_rad) = at(0.0, Vector3::zeros())?;
    let (before, _) = at(-DIFFERENCE_S, Vector3::zeros())?;
    let (after, _) = at(DIFFERENCE_S, Vector3::zeros())?;
    let mut moved = [now; 3];
    for (axis, joints) in moved.iter_mut().enumerate() {
        let mut by_m = Vector3::zeros();
        by_m[axis] = DIFFERENCE_M;
        (*joints, _) = at(0.0, by_m)?;
    }
    // Near singular poses errors of gimbal and cardan grow by the inverse of this.
    let trust = margin_rad.sin();
    let row = |(encoder, joint): (usize, usize)| {
        let speed = wrapped(after[joint] - before[joint]) / (2.0 * DIFFERENCE_S);
        let by_base = moved.map(|joints| wrapped(joints[joint] - now[joint]) / DIFFERENCE_M);
        let offset_rad = offsets.encoders.get(encoder).map_or(0.0, |encoder| encoder.offset_rad);
        Row {
            encoder,
            slopes: [speed, speed * t_s, by_base[0], by_base[1], by_base[2]].map(|slope| -slope * trust),
            trust,
            difference_rad: wrapped(now[joint] - measured_rad[joint] - offset_rad) * trust,
        }
    };
    let joints = offsets.encoders.iter().map(|encoder| usize::from(encoder.joint) - 1);
    Some(joints.enumerate().map(row).collect())
}

/// Step of shift, skew, base and offsets; the common ones have come `so_far` from their expected values.
fn solve(rows: &[Row], encoders: usize, so_far: &[f64; COMMON]) -> Option<DVector<f64>> {
    let columns = COMMON + encoders;
    if rows.len() < 10 * columns {
        return None;
    }
    let mut step = DVector::zeros(columns);
    for _ in 0..WEIGHTINGS {
        let residual = |row: &Row| {
            let common: f64 = row.slopes.iter().zip(step.iter()).map(|(slope, x)| slope * x).sum();
            row.difference_rad - common - row.trust * step[COMMON + row.encoder]
        };
        let residuals: Vec<f64> = rows.iter().map(residual).collect();
        let mut sizes: Vec<f64> = residuals.iter().map(|residual| residual.abs()).collect();
        let middle = sizes.len() / 2;
        let sigma = (1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1).max(1e-9);
        let mut normal = DMatrix::zeros(columns, columns);
        let mut right = DVector::zeros(columns);
        for (row, residual) in rows.iter().zip(residuals) {
            // Cauchy's loss at its usual 95 % efficiency.
            let weight = 1.0 / (1.0 + (residual / (2.385 * sigma)).powi(2));
            let common = row.slopes.iter().copied().enumerate();
            let parts: Vec<(usize, f64)> =
                common.chain(std::iter::once((COMMON + row.encoder, row.trust))).collect();
            for &(i, a) in &parts {
                right[i] += weight * a * row.difference_rad;
                for &(j, b) in &parts {
                    normal[(i, j)] += weight * a * b;
                }
            }
        }
        for (column, (value, deviation)) in so_far.iter().zip(EXPECTED).enumerate() {
            let prior = SAMPLES_ALIKE * (sigma / deviation).powi(2);
            normal[(column, column)] += prior;
            right[column] -= prior * value;
        }
        step = normal.cholesky()?.solve(&right);
    }
    Some(step)
}
