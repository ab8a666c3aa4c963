//! Detects waves of the robot's axes in the residuals of a solution. Such waves are errors of gears whose numbers
//! of teeth or lobes are unknown. `choose` tries the detected waves as error terms. The order of a wave is its
//! number of periods per turn of a drive.
//!
//! Let a drive at angle `g` have the error `a sin(n g) + b cos(n g)`. It adds `(a sin(n g) + b cos(n g)) J` to a
//! residual `r`, where `J` is the derivative of the residual by the drive's angle. The best `a` and `b` decrease the
//! sum of squares. This decrease, as a function of the order `n`, is a periodogram of the residuals over the drive's
//! angle (Lomb 1976, weighted with `J`).
//!
//! If two axes move together, a wave of one of them also appears in the periodogram of the other. Therefore the
//! strongest wave is fitted and subtracted before the next one is detected (orthogonal matching pursuit, Pati 1993).
//! The residuals are orthogonal to the parameters of the solution. Parameters that resemble a wave can therefore
//! hide it, but they cannot create one.
//!
//! Orders are detected in all samples, and again with each fold of the samples left out. In this way no fold confirms an
//! order that was detected in the same fold. All detections use sums over the samples of each fold, which are computed once.
//!
//! Steps: [`LineSpectrum::add`] computes the products of residuals and Jacobian of each sample. [`LineSpectrum::detect`]
//! sums them for each fold. `WaveDetection` then finds the waves, once in all folds and once without each fold.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;

use nalgebra::{DMatrix, DVector};

use crate::cost::CostError;
use crate::instrument::Run;
use crate::kinematics::{Joints, LinkParameter, Turn};
use crate::model::{DriveTrain, JointState, JointTerm, Model, ParameterId, Period, Phase, Waves};
use crate::solver::{Subset, stacked};
use crate::statistics::extremes;

/// Maximum number of samples of a run that are used. A wave that is significant only with
/// more samples is too small to matter.
const SAMPLES_MAX: usize = 3000;
const ORDER_MIN: u8 = *Waves::OF_AXIS.start();
const ORDERS: usize = (*Waves::OF_AXIS.end() - ORDER_MIN + 1) as usize;
/// Minimum decrease of the sum of squares, relative to the noise variance. In white noise, the decrease due to one wave
/// is chi-squared with two degrees of freedom. The probability that any of about 700 waves exceeds the limit by chance is
/// one in ten thousand.
const DETECTION_LIMIT: f64 = 32.0;
/// Median of the chi-squared distribution with two degrees of freedom.
const CHI_SQUARED_MEDIAN: f64 = 1.386;
/// Highest order of the slow waves, once and twice per turn. Every axis has separate error terms for slow waves.
const SLOW_ORDER_MAX: f64 = 2.0;
/// Maximum number of detected waves of one axis: for example an order, twice this order,
/// and the order of another gear stage.
const WAVES_MAX: usize = 3;

/// A wave: index of its axis from 0, and its order.
type AxisWave = (usize, u8);

/// Sums over samples of `J^T J` times `sin^2`, `sin cos` and `cos^2` of one wave. The three sums are in this order.
type WaveNormal = [f64; 3];

/// Sums of products of one wave (of axis `b`) with each wave (of axis `a`), including itself. A product is `J_a^T J_b` times
/// the sine or cosine of the one wave times the sine or cosine of the other.
///
/// Indices: `cross[a][order of a][phase of a][phase of b]`. The first order is `ORDER_MIN`. Phase
/// 0 is the sine, phase 1 the cosine.
type Cross = Vec<[[[f64; 2]; 2]; ORDERS]>;

/// Detected waves. Each has a sine and a cosine parameter.
#[derive(Debug, Clone, Default)]
pub(in crate::calibrate) struct DetectedWaves {
    /// Waves detected in all samples together.
    pub in_all: Vec<ParameterId>,
    /// For each fold, the waves that were detected when this fold was left out. The fold is predicted with these waves only.
    pub without_fold: Vec<Vec<ParameterId>>,
}

impl DetectedWaves {
    /// All detected waves, without duplicates.
    pub fn ids(&self) -> Vec<ParameterId> {
        let all: BTreeSet<ParameterId> =
            self.without_fold.iter().chain([&self.in_all]).flatten().copied().collect();
        all.into_iter().collect()
    }

    /// Waves that were detected when one fold was left out, but not when all samples were used.
    pub fn only_without_a_fold(&self) -> Vec<ParameterId> {
        self.ids().into_iter().filter(|id| !self.in_all.contains(id)).collect()
    }

    /// Keeps the waves for which `wanted` is true.
    pub fn retain(&mut self, wanted: impl Fn(&ParameterId) -> bool) {
        self.without_fold.iter_mut().chain([&mut self.in_all]).for_each(|ids| ids.retain(&wanted));
    }

    /// Adds waves that were detected later. The earlier waves are kept. They are not detected again, because they were
    /// fitted and the residuals no longer contain them.
    pub fn extend(&mut self, others: Self) {
        let add = |own: &mut Vec<ParameterId>, new: Vec<ParameterId>| {
            own.retain(|id| !new.contains(id));
            own.extend(new);
        };
        self.without_fold.resize(self.without_fold.len().max(others.without_fold.len()), Vec::new());
        self.without_fold.iter_mut().zip(others.without_fold).for_each(|(own, new)| add(own, new));
        add(&mut self.in_all, others.in_all);
    }
}

/// Products of the residuals `r` of one sample and of their derivatives `J` by the drives' angles. All
/// products include the weight of the sample.
#[derive(Debug)]
struct SampleProducts {
    fold: usize,
    /// Angle of each drive \[rad\].
    angles_rad: Joints,
    /// The matrix `J^T J`.
    jtj: Vec<Joints>,
    /// The vector `J^T r`.
    jtr: Joints,
    /// The squared norm `r^T r`.
    squared: f64,
    /// Number of entries of `r`.
    rows: f64,
}

/// Sums over the samples of some folds, for each axis and order.
#[derive(Debug, Clone)]
struct Sums {
    /// Sum of `r^T r`.
    squared: f64,
    /// Number of residuals in these samples.
    rows: f64,
    /// Sums of `J^T r` times sine and cosine, with the indices axis, order and phase.
    gradients: Vec<[[f64; 2]; ORDERS]>,
    /// Sums of `J^T J` times products of sine and cosine, with the indices axis and order.
    normals: Vec<[WaveNormal; ORDERS]>,
}

impl Sums {
    fn zeros(axes: usize) -> Self {
        let (gradients, normals) = (vec![[[0.0; 2]; ORDERS]; axes], vec![[[0.0; 3]; ORDERS]; axes]);
        Self { squared: 0.0, rows: 0.0, gradients, normals }
    }

    fn add(&mut self, sample: &SampleProducts) {
        self.squared += sample.squared;
        self.rows += sample.rows;
        for (axis, (gradients, normals)) in self.gradients.iter_mut().zip(&mut self.normals).enumerate() {
            let (jtr, jtj) = (sample.jtr[axis], sample.jtj[axis][axis]);
            let of_orders = gradients.iter_mut().zip(normals).zip(sin_cos_of_orders(sample.angles_rad[axis]));
            for ((gradient, normal), [sin, cos]) in of_orders {
                gradient[0] += jtr * sin;
                gradient[1] += jtr * cos;
                normal[0] += jtj * sin * sin;
                normal[1] += jtj * sin * cos;
                normal[2] += jtj * cos * cos;
            }
        }
    }

    fn add_all(&mut self, other: &Self) {
        self.squared += other.squared;
        self.rows += other.rows;
        add_each(
            self.gradients.as_flattened_mut().as_flattened_mut(),
            other.gradients.as_flattened().as_flattened(),
        );
        add_each(
            self.normals.as_flattened_mut().as_flattened_mut(),
            other.normals.as_flattened().as_flattened(),
        );
    }
}

fn add_each(sums: &mut [f64], values: &[f64]) {
    sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
}

/// The products of the samples of all runs. Each sample belongs to one fold of its run. Folds of
/// all runs are numbered consecutively.
#[derive(Debug, Default)]
pub(in crate::calibrate) struct LineSpectrum {
    samples: Vec<SampleProducts>,
    /// Number of folds of all runs.
    folds: usize,
    /// Waves for which the model already has another error term.
    separate: BTreeSet<AxisWave>,
}

impl LineSpectrum {
    /// Adds the samples of a run, with residuals at the values of its model. `sigma` is the standard
    /// deviation of these residuals, and `weights` contains the weight of each sample. `folds` are the groups
    /// of samples that are left out in turn.
    ///
    /// # Errors
    /// [`CostError`] if the samples lack data that the cost needs.
    pub fn add(
        &mut self,
        Run { instrument, model }: &Run,
        sigma: f64,
        weights: &[f64],
        folds: &[Vec<usize>],
    ) -> Result<(), CostError> {
        let geometry = model.geometry(&[]);
        let drives = &geometry.joints.drives;
        self.separate.extend(separate_terms(drives));
        let first_fold = self.folds;
        self.folds += folds.len();
        let Some(joint_model) = joints_only(model) else { return Ok(()) };
        let problem = instrument.data_set(&joint_model, sigma)?;
        let every = problem.samples().div_ceil(SAMPLES_MAX).max(1);
        // For each used sample: its index, fold, weight and reported joints. Samples with the weight zero are not used.
        let mut present: Vec<(usize, usize, f64, JointState)> = folds
            .iter()
            .enumerate()
            .flat_map(|(fold, samples)| samples.iter().map(move |sample| (*sample, first_fold + fold)))
            .filter(|(sample, _)| sample % every == 0)
            .filter_map(|(sample, fold)| {
                let weight = weights.get(sample).copied().filter(|weight| *weight > 0.0)?;
                Some((sample, fold, weight, instrument.reported(sample, &geometry.clock)?))
            })
            .collect();
        present.sort_unstable_by_key(|(sample, ..)| *sample);
        let subset = Subset { of: &*problem, samples: present.iter().map(|(sample, ..)| *sample).collect() };
        let Some((residuals, jacobian)) = stacked(&subset, &joint_model.start()) else { return Ok(()) };
        let per_sample = problem.rows();
        if residuals.len() != per_sample * present.len() {
            return Ok(());
        }
        for (number, (_, fold, weight, state)) in present.into_iter().enumerate() {
            let rows = number * per_sample..(number + 1) * per_sample;
            // An entry of `J`: the derivative of a residual by a drive's angle, computed from the derivatives by the joints.
            let by_drive = |row: usize, axis: usize| -> f64 {
                let by_joints = jacobian.row(row);
                let joint_from_drive = drives.joint_from_drive[axis].iter();
                joint_from_drive.zip(&by_joints).map(|(part, by_joint)| part * by_joint).sum()
            };
            let for_axes = |value: &dyn Fn(usize) -> f64| Joints::from_fn(drives.axes(), value);
            let jtj = |a: usize, b: usize| -> f64 {
                weight * rows.clone().map(|row| by_drive(row, a) * by_drive(row, b)).sum::<f64>()
            };
            let jtr = |axis: usize| -> f64 {
                weight * rows.clone().map(|row| by_drive(row, axis) * residuals[row]).sum::<f64>()
            };
            self.samples.push(SampleProducts {
                fold,
                angles_rad: for_axes(&|axis| drives.of_drive(axis, &state.q)),
                jtj: (0..drives.axes()).map(|a| for_axes(&|b| jtj(a, b))).collect(),
                jtr: for_axes(&jtr),
                squared: weight * rows.clone().map(|row| residuals[row].powi(2)).sum::<f64>(),
                rows: per_sample as f64,
            });
        }
        Ok(())
    }

    /// Detects the waves whose decrease exceeds both the noise and the median decrease of their axis.
    pub fn detect(&self) -> DetectedWaves {
        let axes = self.samples.first().map_or(0, |sample| sample.angles_rad.len());
        let mut folds = vec![Sums::zeros(axes); self.folds];
        self.samples.iter().for_each(|sample| folds[sample.fold].add(sample));
        let order_distances_min = (0..axes).map(|axis| self.order_distance_min(axis)).collect();
        let mut detection =
            WaveDetection { spectrum: self, folds, order_distances_min, crosses: BTreeMap::new() };
        DetectedWaves {
            in_all: detection.detect(None),
            without_fold: (0..self.folds).map(|fold| detection.detect(Some(fold))).collect(),
        }
    }

    /// Minimum difference of two orders that the travel of the drive can distinguish.
    fn order_distance_min(&self, axis: usize) -> f64 {
        let [low, high] = extremes(self.samples.iter().map(|sample| sample.angles_rad[axis]));
        (TAU / (high - low)).ceil()
    }

    /// Cross products of one wave with all waves, one [`Cross`] for each fold.
    fn crosses(&self, (axis, order): AxisWave) -> Vec<Cross> {
        let axes = self.samples.first().map_or(0, |sample| sample.angles_rad.len());
        let mut crosses = vec![vec![[[[0.0; 2]; 2]; ORDERS]; axes]; self.folds];
        for sample in &self.samples {
            let (sin, cos) = (f64::from(order) * sample.angles_rad[axis]).sin_cos();
            for (other, cross) in crosses[sample.fold].iter_mut().enumerate() {
                let jtj = sample.jtj[axis][other];
                for (cross, sin_cos) in cross.iter_mut().zip(sin_cos_of_orders(sample.angles_rad[other])) {
                    for (cross, other_phase) in cross.iter_mut().zip(sin_cos) {
                        cross[0] += jtj * other_phase * sin;
                        cross[1] += jtj * other_phase * cos;
                    }
                }
            }
        }
        crosses
    }
}

/// State that the detections with all folds and without each fold have in common.
struct WaveDetection<'a> {
    spectrum: &'a LineSpectrum,
    /// Sums of each fold.
    folds: Vec<Sums>,
    /// For each axis, the minimum difference of orders that can be distinguished.
    order_distances_min: Vec<f64>,
    /// Cross products of each wave that a detection has found so far, one [`Cross`] for each fold.
    crosses: BTreeMap<AxisWave, Vec<Cross>>,
}

impl WaveDetection<'_> {
    /// Detects waves in all folds except `without`. `None` uses all folds. Returns the parameters of the detected waves,
    /// except waves for which the model already has another error term.
    fn detect(&mut self, without: Option<usize>) -> Vec<ParameterId> {
        let is_used = |fold: &usize| Some(*fold) != without;
        let folds: Vec<usize> = (0..self.folds.len()).filter(is_used).collect();
        let mut all = Sums::zeros(self.order_distances_min.len());
        folds.iter().for_each(|fold| all.add_all(&self.folds[*fold]));
        let mut found: Vec<AxisWave> = Vec::new();
        let mut residual = all.clone();
        while let Some(wave) = self.strongest(&residual, &found) {
            found.push(wave);
            self.crosses.entry(wave).or_insert_with(|| self.spectrum.crosses(wave));
            let Some(remaining) = self.subtract(&all, &found, &folds) else { break };
            residual = remaining;
        }
        let new = found.into_iter().filter(|wave| !self.spectrum.separate.contains(wave));
        new.flat_map(|(axis, order)| Phase::ALL.map(|phase| ParameterId::JointWave { axis, order, phase }))
            .collect()
    }

    /// The strongest significant wave in the residuals. `None` if no wave is significant. Waves
    /// in `found` are not detected again.
    fn strongest(&self, residual: &Sums, found: &[AxisWave]) -> Option<AxisWave> {
        let is_new = |&(_, (axis, order)): &(f64, AxisWave)| {
            let of_axis = found.iter().filter(|wave| wave.0 == axis);
            // If a drive moves over less than a turn, a wave resembles the waves of neighbouring orders. Therefore exclude
            // the neighbours of waves that were detected. Also exclude the neighbours of one and two waves per turn. The
            // slow waves are separate error terms, which may not have been fitted yet.
            let mut distances = of_axis.clone().map(|wave| f64::from(wave.1.abs_diff(order)));
            let distance_min = self.order_distances_min[axis];
            let is_slow = f64::from(order) <= SLOW_ORDER_MAX + distance_min;
            !is_slow
                && of_axis.clone().count() < WAVES_MAX
                && distances.all(|distance| distance > distance_min)
        };
        let variance = residual.squared / residual.rows.max(1.0);
        let of_axes = residual.gradients.iter().zip(&residual.normals).enumerate();
        // Significant waves, each with its ratio to the noise.
        let significant = of_axes.flat_map(|(axis, (gradients, normals))| {
            let orders = significant_orders(gradients, normals, variance).into_iter();
            orders.map(move |(ratio, order)| (ratio, (axis, order)))
        });
        significant.filter(is_new).max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, wave)| wave)
    }

    /// Sums after a joint fit of the `waves` to the residuals of the `folds`. `None` if the waves cannot be separated. The
    /// matrix of the normal equations has two rows and columns for each wave, first the sine, then the cosine.
    fn subtract(&self, all: &Sums, waves: &[AxisWave], folds: &[usize]) -> Option<Sums> {
        let crosses: Vec<Cross> = waves.iter().map(|wave| sum_over(&self.crosses[wave], folds)).collect();
        let index = |order: u8| usize::from(order - ORDER_MIN);
        let count = 2 * waves.len();
        let matrix = DMatrix::from_fn(count, count, |row, column| {
            let (axis, order) = waves[row / 2];
            crosses[column / 2][axis][index(order)][row % 2][column % 2]
        });
        let gradient = DVector::from_fn(count, |row, _| {
            let (axis, order) = waves[row / 2];
            all.gradients[axis][index(order)][row % 2]
        });
        let amplitudes = matrix.cholesky()?.solve(&gradient);
        let mut residual = all.clone();
        residual.squared -= amplitudes.dot(&gradient);
        for (cross, amplitude) in crosses.iter().zip(amplitudes.as_slice().chunks_exact(2)) {
            let of_orders = residual.gradients.as_flattened_mut().iter_mut().zip(cross.as_flattened());
            for (gradient, cross) in of_orders {
                for (gradient, cross) in gradient.iter_mut().zip(cross) {
                    *gradient -= cross[0] * amplitude[0] + cross[1] * amplitude[1];
                }
            }
        }
        Some(residual)
    }
}

fn sum_over(crosses: &[Cross], folds: &[usize]) -> Cross {
    let mut sum = vec![[[[0.0; 2]; 2]; ORDERS]; crosses.first().map_or(0, Vec::len)];
    for fold in folds {
        let of_fold = crosses[*fold].as_flattened().as_flattened().as_flattened();
        add_each(sum.as_flattened_mut().as_flattened_mut().as_flattened_mut(), of_fold);
    }
    sum
}

/// Orders of an axis that are significant if the residuals have this variance. Each is
/// returned after its ratio to the noise.
fn significant_orders(
    gradients: &[[f64; 2]; ORDERS],
    normals: &[WaveNormal; ORDERS],
    variance: f64,
) -> Vec<(f64, u8)> {
    let decreases: [f64; ORDERS] = std::array::from_fn(|order| decrease(gradients[order], normals[order]));
    let mut sorted = decreases;
    sorted.sort_unstable_by(f64::total_cmp);
    // Errors that are not waves increase the decreases of all orders to a common floor. A significant order
    // must exceed this floor and the noise.
    let floor = sorted[ORDERS / 2] / CHI_SQUARED_MEDIAN;
    let noise = floor.max(variance);
    let orders = decreases.into_iter().zip(ORDER_MIN..);
    let significant = orders.filter(|(decrease, _)| *decrease > DETECTION_LIMIT * noise);
    significant.map(|(decrease, order)| (decrease / noise, order)).collect()
}

/// Decrease of the sum of squares if one wave is fitted. It is `v^T N^-1 v` with the gradient `v = (s, c)` and the
/// matrix `N` of the normal equations.
fn decrease([s, c]: [f64; 2], [ss, sc, cc]: WaveNormal) -> f64 {
    let determinant = ss * cc - sc * sc;
    // The axis did not move, or its travel is so short that sine and cosine are proportional.
    if determinant <= 1e-6 * ss * cc {
        return 0.0;
    }
    (s * s * cc - 2.0 * s * c * sc + c * c * ss) / determinant
}

/// The waves of cycloid lobes and of motor turns, for which the axes have separate error terms.
fn separate_terms(drives: &DriveTrain) -> impl Iterator<Item = AxisWave> + '_ {
    let turns = [(Period::Cycloid, &drives.cycloid_lobes), (Period::Motor, &drives.motor_turns)];
    turns.into_iter().flat_map(move |(period, numbers)| {
        let has = move |axis: &usize| drives.has(*axis, JointTerm::Wave(period, Phase::Sine));
        (0..drives.axes()).filter(has).filter_map(move |axis| {
            let number = numbers.get(axis).copied().flatten()?.round();
            (number <= f64::from(*Waves::OF_AXIS.end())).then_some((axis, number as u8))
        })
    })
}

/// The model with only the `theta` of each joint free. `None` if the model lacks the `theta` of any joint.
fn joints_only(model: &Model) -> Option<Model> {
    let mut model = model.clone();
    model.free_only(|id| matches!(id, ParameterId::Robot { parameter: LinkParameter::Theta, .. }));
    let complete = model.columns().len() == model.axes();
    complete.then_some(model)
}

/// Sine and cosine of each order at a drive's angle, from the lowest order.
fn sin_cos_of_orders(angle_rad: f64) -> impl Iterator<Item = [f64; 2]> {
    let step = Turn::from_angle(angle_rad);
    let turns = std::iter::successors(Some(step.times(ORDER_MIN)), move |turn| Some(turn.and(step)));
    turns.map(|Turn { sin, cos }| [sin, cos])
}

#[cfg(test)]
mod tests {
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};
    use rand_distr::StandardNormal;

    use super::*;

    const FOLDS: usize = 8;

    /// Spectrum of two axes that make full turns. Each axis has a residual of its own, with unit noise. Each
    /// wave has an amplitude for each fold.
    fn spectrum(waves: &[(AxisWave, [f64; FOLDS])]) -> LineSpectrum {
        let mut random = StdRng::seed_from_u64(5);
        let sample = |number: usize| {
            let fold = number * FOLDS / 2400;
            let angles_rad: Joints = (0..2).map(|_| random.random_range(0.0..TAU)).collect();
            let residual = |axis: usize| -> f64 {
                let of_axis = waves.iter().filter(|((of, _), _)| *of == axis);
                of_axis.map(|((_, order), by)| by[fold] * (f64::from(*order) * angles_rad[axis]).sin()).sum()
            };
            let jtr = Joints::from_fn(2, |axis| residual(axis) + random.sample::<f64, _>(StandardNormal));
            let jtj = (0..2).map(|a| Joints::from_fn(2, |b| f64::from(u8::from(a == b)))).collect();
            SampleProducts { fold, angles_rad, jtj, squared: jtr.iter().map(|r| r * r).sum(), jtr, rows: 2.0 }
        };
        LineSpectrum { samples: (0..2400).map(sample).collect(), folds: FOLDS, separate: BTreeSet::new() }
    }

    fn ids((axis, order): AxisWave) -> Vec<ParameterId> {
        Phase::ALL.map(|phase| ParameterId::JointWave { axis, order, phase }).to_vec()
    }

    #[test]
    fn a_wave_of_a_single_fold_is_not_detected_without_this_fold() {
        let (lasting, of_one) = ((0, 11), (1, 40));
        let mut once = [0.0; FOLDS];
        once[3] = 3.0;
        let detected = spectrum(&[(lasting, [0.4; FOLDS]), (of_one, once)]).detect();
        assert_eq!(
            detected.in_all.iter().collect::<BTreeSet<_>>(),
            [ids(lasting), ids(of_one)].concat().iter().collect()
        );
        for (fold, without) in detected.without_fold.iter().enumerate() {
            assert!(without.contains(&ids(lasting)[0]), "{fold}: {without:?}");
            assert_eq!(without.contains(&ids(of_one)[0]), fold != 3, "{fold}: {without:?}");
        }
    }

    #[test]
    fn no_wave_is_detected_in_noise() {
        assert!(spectrum(&[]).detect().ids().is_empty());
    }
}
