//! Evaluates the residuals of the samples at the fitted geometry: outliers, and how the alignment varies along the run.

use serde::Serialize;

use crate::kinematics::BAR_JOINTS;
use crate::prepare::encoders::circular::spread_of;

/// Residuals of one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::prepare) struct AngleErrors {
    /// Index of the sample among all samples.
    pub sample: usize,
    /// Bar time since the reference time \[s\].
    pub t_s: f64,
    /// Number of the counters' origin.
    pub origin: usize,
    /// Measured joints minus the joints that follow from the robot's pose, times the sine of `margin_rad` \[rad\].
    pub error_rad: [f64; BAR_JOINTS],
    /// Distance from the nearest singular pose \[rad\].
    pub margin_rad: f64,
    /// Speeds of the implied joints, times the sine of `margin_rad` \[rad/s\].
    pub speed_rad_s: [f64; BAR_JOINTS],
}

/// Alignment of a short part of the run relative to the alignment of the whole run. It corresponds to figure 5.5 of the
/// thesis, as a function of time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LocalShift {
    /// Mean time of the samples of the part, as bar time since the reference time \[s\].
    pub t_s: f64,
    /// Shift of the part minus the shift of the whole run \[s\].
    pub shift_s: f64,
}

/// Length of a part \[s\].
const PART_S: f64 = 5.0;
/// A shift is computed only for parts whose speeds have at least this standard deviation, over all joints together \[rad/s\].
const SPEED_SPREAD_MIN_RAD_S: f64 = 0.05;
/// Smallest number of samples of a part.
const PART_SAMPLES_MIN: usize = 20;

/// Computes the shift of each part of the run. Each part has free offsets, so that slowly varying errors of the geometry do
/// not appear as a shift.
pub(in crate::prepare) fn local_shifts(errors: &[AngleErrors]) -> Vec<LocalShift> {
    let origin_and_part = |sample: &AngleErrors| (sample.origin, (sample.t_s / PART_S).floor());
    errors.chunk_by(|a, b| origin_and_part(a) == origin_and_part(b)).filter_map(local_shift).collect()
}

/// Fits `error = constant + shift * speed` to all joints of a part by least squares. Each joint has its own constant. `None`
/// if the part has too few samples or hardly moves.
fn local_shift(part: &[AngleErrors]) -> Option<LocalShift> {
    if part.len() < PART_SAMPLES_MIN {
        return None;
    }
    let n = part.len() as f64;
    let (mut products, mut squares) = (0.0, 0.0);
    for joint in 0..BAR_JOINTS {
        let mean = |value: &dyn Fn(&AngleErrors) -> f64| part.iter().map(value).sum::<f64>() / n;
        let error_mean = mean(&|sample| sample.error_rad[joint]);
        let speed_mean = mean(&|sample| sample.speed_rad_s[joint]);
        for sample in part {
            let speed = sample.speed_rad_s[joint] - speed_mean;
            products += speed * (sample.error_rad[joint] - error_mean);
            squares += speed * speed;
        }
    }
    (squares > n * SPEED_SPREAD_MIN_RAD_S.powi(2)).then(|| LocalShift {
        t_s: part.iter().map(|sample| sample.t_s).sum::<f64>() / n,
        shift_s: products / squares,
    })
}

/// Robust standard deviation of each joint's error, estimated from the median \[rad\].
pub(in crate::prepare) fn spreads_rad(errors: &[AngleErrors]) -> [f64; BAR_JOINTS] {
    std::array::from_fn(|joint| {
        spread_of(errors.iter().map(|sample| sample.error_rad[joint].abs()).collect())
    })
}

/// Smallest error of an outlier, in standard deviations. Noise exceeds it in fewer than one of a million runs.
const OUTLIER_SIGMAS: f64 = 8.0;
/// Smallest error of an outlier \[rad\].
const OUTLIER_RAD_MIN: f64 = 100e-6;
/// Largest fraction of the samples that can be outliers. If more samples exceed the limit, something changed during the run,
/// and the solve needs these samples.
const OUTLIER_SHARE_MAX: f64 = 0.05;

/// Indices of the samples in which the error of a joint is an outlier; none if their fraction is above [`OUTLIER_SHARE_MAX`].
pub(in crate::prepare) fn outliers(errors: &[AngleErrors], spreads_rad: &[f64; BAR_JOINTS]) -> Vec<usize> {
    let is_outlier = |sample: &&AngleErrors| {
        let mut errors = sample.error_rad.iter().zip(spreads_rad);
        errors.any(|(error, spread)| error.abs() > OUTLIER_RAD_MIN.max(OUTLIER_SIGMAS * spread))
    };
    let found: Vec<usize> = errors.iter().filter(is_outlier).map(|sample| sample.sample).collect();
    if found.len() as f64 > OUTLIER_SHARE_MAX * errors.len() as f64 { Vec::new() } else { found }
}
