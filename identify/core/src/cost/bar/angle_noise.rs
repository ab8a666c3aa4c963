//! Estimates the noise of the bar's encoders and of the robot's joints from the residuals of cost `pose`. The cost then uses
//! these noises for its weights.
//!
//! Encoders and joints move a pose in different directions, so the scatter of the poses separates both noises. The
//! covariance of a residual `r` is `V = s_e^2 E + s_r^2 Q + K`. `E` is the covariance for encoders of unit variance, `Q`
//! that for robot joints of unit variance, and `K` the known covariance from other sources. The variances `s_e^2` and
//! `s_r^2` are maximum likelihood estimates, by Fisher scoring.
//!
//! Stages: `FoundNoise::estimate` repeats `scoring_step` until both variances converge, and then computes the
//! correlation of successive residuals.
//!
//! A scoring step computes the weights `W = V^-1` from the variances of the previous step. With `V_1 = E` and `V_2 = Q`, the
//! new variances `s_1^2` (encoders) and `s_2^2` (joints) solve two linear equations, one for each `k` = 1, 2 (Rao 1971):
//! `sum_l tr(W V_k W V_l) s_l^2 = r' W V_k W r - tr(W V_k W K)`. Both sides are summed over all samples. The equations are
//! unbiased for any weights, so the start need not be accurate.

use nalgebra::{Matrix6, Vector6};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::solver::GoodShare;

/// White noise of the angles, as standard deviations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AngleNoise {
    /// Noise of each bar encoder \[rad\].
    pub encoder_rad: f64,
    /// Noise of each robot joint \[rad\].
    pub robot_rad: f64,
}

impl AngleNoise {
    /// Variances of encoders and of robot joints \[rad^2\].
    fn variances(self) -> [f64; 2] {
        [self.encoder_rad.powi(2), self.robot_rad.powi(2)]
    }

    fn of_variances([encoder, robot]: [f64; 2]) -> Self {
        Self { encoder_rad: encoder.sqrt(), robot_rad: robot.sqrt() }
    }
}

/// Noise that was estimated from residuals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundNoise {
    /// Estimated noise. It includes correlated errors.
    pub noise: AngleNoise,
    /// Correlation of successive residuals. It is zero for white noise. If a fraction of the variance is due to slowly
    /// varying errors, the correlation is equal to this fraction.
    pub autocorrelation: f64,
    /// Standard deviation of `autocorrelation` if the noise is white.
    pub autocorrelation_sigma: f64,
}

/// Residual of one sample, with the covariances to which the noise of the angles contributes.
#[derive(Debug, Clone)]
pub(in crate::cost) struct NoisySample {
    /// Position \[m\] and rotation \[rad\].
    pub residual: Vector6<f64>,
    /// Covariances of the residual for unit variance of the encoders (`E`) and for unit variance of the robot joints (`Q`).
    pub by_angles: [Matrix6<f64>; 2],
    /// Covariance from all other sources (`K`).
    pub known: Matrix6<f64>,
}

impl NoisySample {
    /// Covariance of the residual for the given noise.
    pub fn covariance(&self, noise: AngleNoise) -> Matrix6<f64> {
        self.covariance_of(noise.variances())
    }

    fn covariance_of(&self, [encoder, robot]: [f64; 2]) -> Matrix6<f64> {
        self.by_angles[0] * encoder + self.by_angles[1] * robot + self.known
    }
}

/// Residual entries per sample.
const ROWS: usize = 6;
/// Maximum number of samples used. Two variances do not need more.
const SAMPLES_MAX: usize = 3000;
/// Lower limit of the estimates, relative to the configured noise. Below this limit, interpolation
/// and rounding errors dominate.
const NOISE_MIN: f64 = 0.1;
/// Probability that a sample is rejected as an outlier although its noise is normally distributed.
const FALSE_REJECTION: f64 = 1e-3;

impl FoundNoise {
    /// Estimates the noise from samples in order of time, after a fit of `columns` parameters. A sample without a value is
    /// `None`. The iteration begins at `start`. Returns `None` if there are too few samples.
    pub(in crate::cost) fn estimate(
        samples: &[Option<NoisySample>],
        columns: usize,
        start: AngleNoise,
    ) -> Option<Self> {
        const STEPS_MAX: usize = 30;
        /// The iteration has converged if both variances change by less than this fraction.
        const CHANGE_CONVERGED: f64 = 1e-3;
        let present: Vec<&NoisySample> = samples.iter().flatten().collect();
        let rows = ROWS * present.len();
        if rows < 2 * columns {
            return None;
        }
        // The fit of the parameters makes the residuals smaller than the noise. This is the factor on their squares.
        let reduction = (rows - columns) as f64 / rows as f64;
        let thinned: Vec<&NoisySample> =
            present.iter().step_by(present.len().div_ceil(SAMPLES_MAX).max(1)).copied().collect();
        let lower_limits = start.variances().map(|variance| NOISE_MIN * NOISE_MIN * variance);
        let mut variances = start.variances();
        for _ in 0..STEPS_MAX {
            let before = variances;
            variances = scoring_step(&thinned, before, lower_limits, reduction)?;
            let changes = variances.iter().zip(before).map(|(now, before)| (now / before - 1.0).abs());
            if changes.fold(0.0, f64::max) < CHANGE_CONVERGED {
                break;
            }
        }
        let noise = AngleNoise::of_variances(variances);
        let (autocorrelation, autocorrelation_sigma) = autocorrelation(samples, variances)?;
        Some(Self { noise, autocorrelation, autocorrelation_sigma })
    }
}

/// A sample with its weight matrix `W`.
struct Weighted<'a> {
    sample: &'a NoisySample,
    weight: Matrix6<f64>,
    /// `W r`.
    residual: Vector6<f64>,
}

impl Weighted<'_> {
    /// Squared norm `r' W r` of the whitened residual, which has a chi-squared distribution.
    fn squared_norm(&self) -> f64 {
        self.sample.residual.dot(&self.residual)
    }
}

/// One step of Fisher scoring: computes new variances from samples that are weighted with the variances `before`. Squared
/// residuals are divided by `reduction`, because the fit of the parameters has reduced them by this factor.
fn scoring_step(
    samples: &[&NoisySample],
    before: [f64; 2],
    lower_limits: [f64; 2],
    reduction: f64,
) -> Option<[f64; 2]> {
    let weighted: Vec<Weighted<'_>> = samples
        .iter()
        .filter_map(|sample| {
            let weight = sample.covariance_of(before).cholesky()?.inverse();
            Some(Weighted { sample, weight, residual: weight * sample.residual })
        })
        .collect();
    // Sum the equations over all samples that are not outliers.
    let limit = squared_norm_limit(weighted.iter().map(Weighted::squared_norm))?;
    let (mut information, mut right_side) = ([[0.0; 2]; 2], [0.0; 2]);
    for good in weighted.iter().filter(|weighted| weighted.squared_norm() <= limit) {
        let Weighted { sample, weight, residual } = good;
        // Products `W V_k` and `W K`.
        let by_angles: [Matrix6<f64>; 2] = sample.by_angles.map(|covariance| weight * covariance);
        let known = weight * sample.known;
        for k in 0..2 {
            let square = residual.dot(&(sample.by_angles[k] * residual));
            right_side[k] += square / reduction - trace_of_product(&by_angles[k], &known);
            for l in 0..2 {
                information[k][l] += trace_of_product(&by_angles[k], &by_angles[l]);
            }
        }
    }
    // Solve the equations. A variance below its limit is set to the limit.
    let [[ee, er], [_, rr]] = information;
    let determinant = ee * rr - er * er;
    let [e, r] = right_side;
    let both = [(rr * e - er * r) / determinant, (ee * r - er * e) / determinant];
    // The variance with index `k`, if the other variance has the value `other`.
    let single = |k: usize, other: f64| (right_side[k] - er * other) / information[k][k];
    let [encoder_min, robot_min] = lower_limits;
    let [encoder, robot] = match [both[0] < encoder_min, both[1] < robot_min] {
        [false, false] => both,
        [true, false] => [encoder_min, single(1, encoder_min)],
        _ => [single(0, robot_min), robot_min],
    };
    let variances = [encoder.max(encoder_min), robot.max(robot_min)];
    variances.iter().all(|variance| variance.is_finite()).then_some(variances)
}

fn trace_of_product(a: &Matrix6<f64>, b: &Matrix6<f64>) -> f64 {
    a.component_mul(&b.transpose()).sum()
}

/// Squared norm beyond which a sample is an outlier, estimated from the squared norms of all samples.
fn squared_norm_limit(squared_norms: impl Iterator<Item = f64>) -> Option<f64> {
    let spread = GoodShare::HALF.spread(squared_norms.map(|squared| (squared, ROWS)));
    Some(spread.powi(2) * ChiSquared::new(ROWS as f64).ok()?.inverse_cdf(1.0 - FALSE_REJECTION))
}

/// Correlation of successive whitened residuals, and the standard deviation of this correlation for white noise.
fn autocorrelation(samples: &[Option<NoisySample>], variances: [f64; 2]) -> Option<(f64, f64)> {
    let whiten = |sample: &NoisySample| {
        let factor = sample.covariance_of(variances).cholesky()?;
        factor.l().solve_lower_triangular(&sample.residual)
    };
    let whitened: Vec<Option<Vector6<f64>>> =
        samples.iter().map(|sample| sample.as_ref().and_then(whiten)).collect();
    let limit = squared_norm_limit(whitened.iter().flatten().map(Vector6::norm_squared))?;
    let good = |residual: &Option<Vector6<f64>>| residual.filter(|residual| residual.norm_squared() <= limit);
    let (mut products, mut squares, mut pairs) = (0.0, 0.0, 0usize);
    for pair in whitened.windows(2) {
        let (Some(residual), Some(next)) = (good(&pair[0]), good(&pair[1])) else { continue };
        products += residual.dot(&next);
        squares += 0.5 * (residual.norm_squared() + next.norm_squared());
        pairs += 1;
    }
    (squares > 0.0).then(|| (products / squares, ((ROWS * pairs) as f64).sqrt().recip()))
}

#[cfg(test)]
mod tests {
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};
    use rand_distr::StandardNormal;

    use super::*;

    /// Poses with errors from five encoders and six joints, which act in random directions. If `outliers` is set, every
    /// tenth pose is an outlier.
    fn samples(truth: AngleNoise, outliers: bool) -> Vec<Option<NoisySample>> {
        let mut random = StdRng::seed_from_u64(5);
        let mut normal = move || random.sample::<f64, _>(StandardNormal);
        let mut sample = |number: usize| {
            let mut by_angles = [Matrix6::zeros(); 2];
            let mut residual = Vector6::zeros();
            for (group, (count, sigma)) in
                [(5, truth.encoder_rad), (6, truth.robot_rad)].into_iter().enumerate()
            {
                for _ in 0..count {
                    let direction = Vector6::from_fn(|_, _| normal());
                    by_angles[group] += direction * direction.transpose();
                    residual += direction * (sigma * normal());
                }
            }
            if outliers && number.is_multiple_of(10) {
                residual *= 100.0;
            }
            Some(NoisySample { residual, by_angles, known: Matrix6::identity() * 1e-14 })
        };
        (0..2000).map(&mut sample).collect()
    }

    #[test]
    fn both_noises_are_found_wherever_the_configuration_starts_and_outliers_have_no_say() {
        let start = AngleNoise { encoder_rad: 5e-6, robot_rad: 15e-6 };
        for (encoder, robot) in [(5.0, 15.0), (200.0, 1.5), (200.0, 50.0), (0.5, 200.0), (2.0, 3.0)] {
            let truth = AngleNoise { encoder_rad: encoder * 1e-6, robot_rad: robot * 1e-6 };
            for outliers in [false, true] {
                let found = FoundNoise::estimate(&samples(truth, outliers), 0, start);
                let FoundNoise { noise, autocorrelation, autocorrelation_sigma } =
                    found.unwrap_or_else(|| panic!("nothing"));
                // The smaller of two very different variances is poorly determined.
                let within =
                    |found: f64, truth: f64, other: f64| (found - truth).abs() < 0.05 * truth + 0.1 * other;
                assert!(within(noise.encoder_rad, truth.encoder_rad, truth.robot_rad), "{noise:?}");
                assert!(within(noise.robot_rad, truth.robot_rad, truth.encoder_rad), "{noise:?}");
                assert!(autocorrelation.abs() < 4.0 * autocorrelation_sigma, "{autocorrelation}");
            }
        }
    }
}
