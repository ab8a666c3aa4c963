//! Which waves of the robot's axes are left in the residuals: the teeth and lobes of gears that nobody has counted.
//!
//! An error `a sin(n g) + b cos(n g)` of a drive at angle `g` adds `(a sin(n g) + b cos(n g)) J` to a residual, where `J`
//! is what the drive's turn does to it. How much the sum of squares would fall with the best `a` and `b` is, over all
//! orders `n`, a periodogram of the residuals over the drive's angle (Lomb 1976, with `J` for weights). The wave that stands
//! out most is fitted and taken away, then the next one is looked for (orthogonal matching pursuit, Pati 1993): axes that
//! move together show each other's waves. What the solve has taken out already is orthogonal to the residuals, so that
//! parameters near a wave can only hide it, never feign it.

use std::collections::BTreeSet;
use std::f64::consts::TAU;
use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use crate::cost::{CostError, DataSets, SharedColumns};
use crate::instrument::Run;
use crate::kinematics::{Joints, LinkParameter};
use crate::model::{DriveTrain, JointState, JointTerm, JointWaves, Model, ParameterId, Period, Phase};
use crate::solver::{Problem, Subset, stacked};
use crate::statistics::extremes;

/// Samples of a run that are looked at, at most: what only more would show is too small to matter.
const SAMPLES_MAX: usize = 3000;
const ORDERS: usize = (JointWaves::LAST - JointWaves::FIRST + 1) as usize;
/// What a wave takes away of noise of variance one is chi-squared with two degrees of freedom. Beyond this it stands out:
/// that none of some 700 tries gets there by chance is certain to one in ten thousand.
const STANDS_OUT: f64 = 32.0;
/// Median of the same.
const MEDIAN: f64 = 1.386;
/// Waves per turn that are terms of their own, at most.
const TWICE: f64 = 2.0;
/// Waves of one axis at most: the order itself, twice that, and another stage of the gear.
const WAVES_MAX: usize = 3;

/// A wave of an axis: axis from 0, times per turn.
type Wave = (usize, u8);

/// Normal equations of one wave: `ss`, `sc`, `cc`.
type Normal = [f64; 3];

/// Samples of all runs, each multiplied by the root of its weight.
#[derive(Debug, Default)]
pub(in crate::calibrate) struct LineSpectrum {
    /// One for each row.
    residuals: Vec<f64>,
    /// What a turn of each drive does to each row.
    by_drives: Vec<Joints>,
    /// Rows of each sample.
    rows: Vec<Range<usize>>,
    /// Of the drives at each sample \[rad\].
    angles_rad: Vec<Joints>,
    /// Orders that are terms of their own.
    known: BTreeSet<Wave>,
}

impl LineSpectrum {
    /// Adds the samples of a run where its model is, with their weights.
    ///
    /// # Errors
    /// [`CostError`] where the samples are not what the cost needs.
    pub fn add(
        &mut self,
        Run { instrument, model }: &Run,
        sigma: f64,
        weights: &[f64],
    ) -> Result<(), CostError> {
        let geometry = model.geometry(&[]);
        let drives = &geometry.joints.drives;
        self.known.extend(known(drives));
        let Some(of_joints) = joints_only(model) else { return Ok(()) };
        let columns = SharedColumns::new([&of_joints], |_| false);
        let problem = DataSets::new(vec![instrument.data_set(&of_joints, sigma)?], &columns);
        // Samples without a value have no weight.
        let every = problem.samples().div_ceil(SAMPLES_MAX).max(1);
        let present = (0..problem.samples()).step_by(every).filter_map(|sample| {
            let weight = weights.get(sample).copied().filter(|weight| *weight > 0.0)?;
            Some((sample, weight, instrument.reported(sample, &geometry.clock)?))
        });
        let present: Vec<(usize, f64, JointState)> = present.collect();
        let subset = Subset { of: &problem, samples: present.iter().map(|(sample, ..)| *sample).collect() };
        let Some((residuals, jacobian)) = stacked(&subset, &of_joints.start()) else { return Ok(()) };
        let per_sample = problem.rows();
        if residuals.len() != per_sample * present.len() {
            return Ok(());
        }
        for (sample, (_, weight, state)) in present.iter().enumerate() {
            let begin = self.residuals.len();
            for row in sample * per_sample..(sample + 1) * per_sample {
                let (by, root) = (jacobian.row(row), weight.sqrt());
                let by_drive = |axis: usize| {
                    let turned = drives.joint_from_drive[axis].iter().zip(&by);
                    turned.map(|(part, by_joint)| part * by_joint * root).sum()
                };
                self.residuals.push(residuals[row] * root);
                self.by_drives.push(Joints::from_fn(drives.axes(), by_drive));
            }
            self.rows.push(begin..self.residuals.len());
            self.angles_rad.push(Joints::from_fn(drives.axes(), |axis| drives.of_drive(axis, &state.q)));
        }
        Ok(())
    }

    /// The waves that stand out of the noise and of each axis' other waves, sine and cosine of each.
    pub fn found(&self) -> Vec<ParameterId> {
        let axes = self.angles_rad.first().map_or(0, |angles| angles.len());
        let resolved: Vec<f64> = (0..axes).map(|axis| self.resolved(axis)).collect();
        let normals: Vec<[Normal; ORDERS]> = (0..axes).map(|axis| self.normals(axis)).collect();
        let mut found: Vec<Wave> = Vec::new();
        let mut left = DVector::from_column_slice(&self.residuals);
        loop {
            let is_new = |&(_, (axis, order)): &(f64, Wave)| {
                let of_axis = found.iter().filter(|wave| wave.0 == axis);
                // Over a part of a turn a wave looks like its neighbours: they are its shadows. Those of once and twice
                // per turn are in the way, too: these are terms of their own and may not have been taken out yet.
                let mut apart = of_axis.clone().map(|wave| f64::from(wave.1.abs_diff(order)));
                let slow = f64::from(order) <= TWICE + resolved[axis];
                !slow && of_axis.clone().count() < WAVES_MAX && apart.all(|apart| apart > resolved[axis])
            };
            let variance = left.norm_squared() / left.len().max(1) as f64;
            let standing = normals
                .iter()
                .enumerate()
                .flat_map(|(axis, normals)| self.standing(axis, normals, left.as_slice(), variance));
            let Some((_, wave)) = standing.filter(is_new).max_by(|a, b| a.0.total_cmp(&b.0)) else { break };
            found.push(wave);
            let Some(without) = self.without(&found) else { break };
            left = without;
        }
        let new = found.into_iter().filter(|wave| !self.known.contains(wave));
        new.flat_map(|(axis, order)| Phase::ALL.map(|phase| ParameterId::JointWave { axis, order, phase }))
            .collect()
    }

    /// Orders that are distinguished over the travel of a drive.
    fn resolved(&self, axis: usize) -> f64 {
        let [low, high] = extremes(self.angles_rad.iter().map(|angles| angles[axis]));
        (TAU / (high - low)).ceil()
    }

    /// What all waves of an axis do to the residuals: the same whatever is left of these.
    fn normals(&self, axis: usize) -> [Normal; ORDERS] {
        let mut normals = [[0.0; 3]; ORDERS];
        for (rows, angles) in self.rows.iter().zip(&self.angles_rad) {
            let by = &self.by_drives[rows.clone()];
            // All rows of a sample share its waves.
            let stiffness: f64 = by.iter().map(|by| by[axis] * by[axis]).sum();
            for (normal, (sin, cos)) in normals.iter_mut().zip(waves(angles[axis])) {
                normal[0] += stiffness * sin * sin;
                normal[1] += stiffness * sin * cos;
                normal[2] += stiffness * cos * cos;
            }
        }
        normals
    }

    /// Waves of an axis that stand out of what is left, of this variance, with by how much.
    fn standing(
        &self,
        axis: usize,
        normals: &[Normal; ORDERS],
        left: &[f64],
        variance: f64,
    ) -> Vec<(f64, Wave)> {
        let mut gradients = [[0.0; 2]; ORDERS];
        for (rows, angles) in self.rows.iter().zip(&self.angles_rad) {
            let (residuals, by) = (&left[rows.clone()], &self.by_drives[rows.clone()]);
            let pull: f64 = residuals.iter().zip(by).map(|(residual, by)| by[axis] * residual).sum();
            for (gradient, (sin, cos)) in gradients.iter_mut().zip(waves(angles[axis])) {
                gradient[0] += pull * sin;
                gradient[1] += pull * cos;
            }
        }
        let falls: [f64; ORDERS] = std::array::from_fn(|order| fall(gradients[order], normals[order]));
        let mut sorted = falls;
        sorted.sort_unstable_by(f64::total_cmp);
        // Errors of other kinds lift all waves: peaks have to stand out of these, too.
        let floor = sorted[ORDERS / 2] / MEDIAN;
        let noise = floor.max(variance);
        let standing =
            falls.into_iter().zip(JointWaves::FIRST..).filter(|(fall, _)| *fall > STANDS_OUT * noise);
        standing.map(|(fall, order)| (fall / noise, (axis, order))).collect()
    }

    /// What these waves, fitted together, leave of the residuals.
    fn without(&self, waves: &[Wave]) -> Option<DVector<f64>> {
        let columns: Vec<(Wave, Phase)> =
            waves.iter().flat_map(|wave| Phase::ALL.map(|phase| (*wave, phase))).collect();
        let by = DMatrix::from_fn(self.residuals.len(), columns.len(), |row, column| {
            let ((axis, order), phase) = columns[column];
            let sample = self.rows.partition_point(|rows| rows.end <= row);
            let angle_rad = self.angles_rad[sample][axis];
            self.by_drives[row][axis] * JointWaves::wave(order, phase, angle_rad)
        });
        let residuals = DVector::from_column_slice(&self.residuals);
        let amplitudes = by.tr_mul(&by).cholesky()?.solve(&by.tr_mul(&residuals));
        Some(residuals - by * amplitudes)
    }
}

/// How much the sum of squares falls with one wave.
fn fall([s, c]: [f64; 2], [ss, sc, cc]: Normal) -> f64 {
    let determinant = ss * cc - sc * sc;
    // The axis stood still, or sine and cosine are one over its travel.
    if determinant <= 1e-6 * ss * cc {
        return 0.0;
    }
    (s * s * cc - 2.0 * s * c * sc + c * c * ss) / determinant
}

/// Orders that other terms of the axes have.
fn known(drives: &DriveTrain) -> impl Iterator<Item = (usize, u8)> + '_ {
    let turns = [(Period::Cycloid, &drives.cycloid_lobes), (Period::Motor, &drives.motor_turns)];
    turns.into_iter().flat_map(move |(period, numbers)| {
        let has = move |axis: &usize| drives.has(*axis, JointTerm::Sine(period));
        (0..drives.axes()).filter(has).filter_map(move |axis| {
            let number = numbers.get(axis).copied().flatten()?.round();
            (number <= f64::from(JointWaves::LAST)).then_some((axis, number as u8))
        })
    })
}

/// The model with nothing free but the turn of each joint.
fn joints_only(model: &Model) -> Option<Model> {
    let mut model = model.clone();
    model.free_only(|id| matches!(id, ParameterId::Robot { parameter: LinkParameter::Theta, .. }));
    let complete = model.columns().len() == model.axes();
    complete.then_some(model)
}

/// Sine and cosine of all orders at a drive's angle.
fn waves(angle_rad: f64) -> impl Iterator<Item = (f64, f64)> {
    let (step_sin, step_cos) = angle_rad.sin_cos();
    let first = (f64::from(JointWaves::FIRST) * angle_rad).sin_cos();
    std::iter::successors(Some(first), move |(sin, cos)| {
        Some((sin * step_cos + cos * step_sin, cos * step_cos - sin * step_sin))
    })
}
