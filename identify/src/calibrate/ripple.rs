//! Which waves of the robot's axes are left in the residuals: the teeth and lobes of gears that nobody has counted.
//!
//! An error `a sin(n g) + b cos(n g)` of a drive at angle `g` adds `(a sin(n g) + b cos(n g)) J` to a residual, where `J`
//! is what the drive's turn does to it. How much the sum of squares would fall with the best `a` and `b` is, over all
//! orders `n`, a periodogram of the residuals over the drive's angle (Lomb 1976, with `J` for weights). What the solve has
//! taken out already is orthogonal to the residuals, so that parameters near a wave can only hide it, never feign it.

use std::collections::BTreeSet;
use std::f64::consts::TAU;

use crate::cost::{CostError, LoopProblem, Residual};
use crate::kinematics::{LinkParameter, ROBOT_JOINTS};
use crate::model::{DriveTrain, JointTerm, JointWaves, Model, Observation, ParameterId, Period, Phase, Role};
use crate::model::{JointState, RobotMotion};
use crate::solver::stacked;

const ORDERS: usize = (JointWaves::LAST - JointWaves::FIRST + 1) as usize;
/// What a wave takes away of noise of variance one is chi-squared with two degrees of freedom. Beyond this it stands out:
/// that none of some 700 tries gets there by chance is certain to one in ten thousand.
const STANDS_OUT: f64 = 32.0;
/// Median of the same.
const MEDIAN: f64 = 1.386;
/// Waves of one axis at most: the order itself, twice that, and another stage of the gear.
const WAVES_MAX: usize = 3;
/// The side lobes of a peak that are seen are fewer, and lower than this part of it.
const SIDE_LOBES: f64 = 4.0;
const SIDE_LOBE: f64 = 0.1;

/// Normal equations of one wave.
#[derive(Debug, Clone, Copy, Default)]
struct Wave {
    gradient: [f64; 2],
    /// `ss`, `sc`, `cc`
    normal: [f64; 3],
}

impl Wave {
    /// How much the sum of squares falls with it.
    fn fall(&self) -> f64 {
        let ([s, c], [ss, sc, cc]) = (self.gradient, self.normal);
        let determinant = ss * cc - sc * sc;
        // The axis stood still, or sine and cosine are one over its travel.
        if determinant <= 1e-6 * ss * cc {
            return 0.0;
        }
        (s * s * cc - 2.0 * s * c * sc + c * c * ss) / determinant
    }
}

/// Waves of all axes over the samples of all runs.
#[derive(Debug)]
pub(super) struct Spectrum {
    waves: [Vec<Wave>; ROBOT_JOINTS],
    /// Least and largest angle of each drive \[rad\].
    travel_rad: [[f64; 2]; ROBOT_JOINTS],
    squared: f64,
    rows: f64,
    /// Orders that are terms of their own.
    known: BTreeSet<(usize, u8)>,
}

impl Default for Spectrum {
    fn default() -> Self {
        let waves = std::array::from_fn(|_| vec![Wave::default(); ORDERS]);
        let travel_rad = [[f64::INFINITY, f64::NEG_INFINITY]; ROBOT_JOINTS];
        Self { waves, travel_rad, squared: 0.0, rows: 0.0, known: BTreeSet::new() }
    }
}

impl Spectrum {
    /// Adds the samples of a run where its model is, with their weights.
    ///
    /// # Errors
    /// [`CostError`] where the observations are not what the cost needs.
    pub fn add<R: Residual>(
        &mut self,
        model: &Model,
        motion: &impl RobotMotion,
        observations: &[Observation],
        residual: R,
        sigma: f64,
        weights: &[f64],
    ) -> Result<(), CostError> {
        let geometry = model.geometry(&[]);
        let drives = &geometry.joints.drives;
        self.known.extend(known(drives));
        let Some(of_joints) = joints_only(model) else { return Ok(()) };
        let problem = LoopProblem::new(&of_joints, motion, observations, residual, sigma)?;
        let Some((residuals, jacobian)) = stacked(&problem, &of_joints.start()) else { return Ok(()) };
        let reported = observations.iter().map(|one| motion.at(geometry.clock.robot_time_s(one.t_s)));
        // Samples without a value have no rows, and no weight.
        let present: Vec<(JointState, f64)> = reported
            .zip(weights)
            .filter_map(|(state, weight)| Some((state?, *weight)))
            .filter(|(_, weight)| *weight > 0.0)
            .collect();
        if residuals.len() != R::ROWS * present.len() {
            return Ok(());
        }
        for (sample, (state, weight)) in present.iter().enumerate() {
            let rows = sample * R::ROWS..(sample + 1) * R::ROWS;
            self.squared += weight * rows.clone().map(|row| residuals[row].powi(2)).sum::<f64>();
            self.rows += weight * R::ROWS as f64;
            for axis in 0..ROBOT_JOINTS {
                let turned = &drives.joint_from_drive[axis];
                let by_drive = |row: usize| {
                    turned.iter().enumerate().map(|(j, part)| part * jacobian[(row, j)]).sum::<f64>()
                };
                let (mut pull, mut stiffness) = (0.0, 0.0);
                for row in rows.clone() {
                    let by = by_drive(row);
                    pull += weight * by * residuals[row];
                    stiffness += weight * by * by;
                }
                let angle_rad = drives.of_drive(axis, &state.q);
                let [low, high] = self.travel_rad[axis];
                self.travel_rad[axis] = [low.min(angle_rad), high.max(angle_rad)];
                add_sample(&mut self.waves[axis], angle_rad, pull, stiffness);
            }
        }
        Ok(())
    }

    /// The waves that stand out of the noise and of each axis' other waves, sine and cosine of each.
    pub fn peaks(&self) -> Vec<ParameterId> {
        let of_axis = |axis: usize| {
            let new = move |order: &u8| !self.known.contains(&(axis, *order));
            let orders = self.peaks_of(axis).into_iter().filter(new);
            orders
                .flat_map(move |order| Phase::ALL.map(|phase| ParameterId::JointWave { axis, order, phase }))
        };
        (0..ROBOT_JOINTS).flat_map(of_axis).collect()
    }

    /// Orders of an axis, the strongest first.
    fn peaks_of(&self, axis: usize) -> Vec<u8> {
        let falls: Vec<f64> = self.waves[axis].iter().map(Wave::fall).collect();
        let mut sorted = falls.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        // Errors of other kinds lift all waves: peaks have to stand out of these, too.
        let floor = sorted.get(sorted.len() / 2).map_or(0.0, |median| median / MEDIAN);
        let noise = floor.max(self.squared / self.rows.max(1.0));
        let mut standing: Vec<(f64, u8)> = falls.into_iter().zip(JointWaves::FIRST..).collect();
        standing.retain(|(fall, _)| *fall > STANDS_OUT * noise);
        standing.sort_by(|a, b| b.0.total_cmp(&a.0));
        // Over a part of a turn a wave looks like its neighbours: those of a stronger one are its shadows.
        let [low, high] = self.travel_rad[axis];
        let resolved = (TAU / (high - low)).ceil();
        let mut peaks: Vec<(f64, u8)> = Vec::new();
        for (fall, order) in standing {
            let is_shadow = |(of_peak, peak): &(f64, u8)| {
                let apart = f64::from(peak.abs_diff(order));
                apart <= resolved || apart <= SIDE_LOBES * resolved && fall < SIDE_LOBE * of_peak
            };
            if peaks.len() < WAVES_MAX && !peaks.iter().any(is_shadow) {
                peaks.push((fall, order));
            }
        }
        peaks.into_iter().map(|(_, order)| order).collect()
    }
}

/// Orders that other terms of the axes have.
fn known(drives: &DriveTrain) -> impl Iterator<Item = (usize, u8)> + '_ {
    let turns = [(Period::Cycloid, &drives.cycloid_lobes), (Period::Motor, &drives.motor_turns)];
    turns.into_iter().flat_map(move |(period, numbers)| {
        let has = move |axis: &usize| drives.has(*axis, JointTerm::Sine(period));
        (0..ROBOT_JOINTS).filter(has).filter_map(move |axis| {
            let number = numbers.get(axis).copied().flatten()?.round();
            (number <= f64::from(JointWaves::LAST)).then_some((axis, number as u8))
        })
    })
}

/// The model with nothing free but the turn of each joint.
fn joints_only(model: &Model) -> Option<Model> {
    let mut model = model.clone();
    let all: Vec<ParameterId> = model.parameters().iter().map(|parameter| parameter.id).collect();
    let turn = |id| matches!(id, ParameterId::Robot { parameter: LinkParameter::Theta, .. });
    for id in all {
        model.set_role(id, if turn(id) { Role::Free } else { Role::Fixed }).ok()?;
    }
    let complete = model.columns().len() == ROBOT_JOINTS;
    complete.then_some(model)
}

/// Adds a sample at a drive's angle to the normal equations of all orders.
fn add_sample(waves: &mut [Wave], angle_rad: f64, pull: f64, stiffness: f64) {
    let (step_sin, step_cos) = angle_rad.sin_cos();
    let (mut sin, mut cos) = (f64::from(JointWaves::FIRST) * angle_rad).sin_cos();
    for wave in waves {
        wave.gradient[0] += pull * sin;
        wave.gradient[1] += pull * cos;
        wave.normal[0] += stiffness * sin * sin;
        wave.normal[1] += stiffness * sin * cos;
        wave.normal[2] += stiffness * cos * cos;
        (sin, cos) = (sin * step_cos + cos * step_sin, cos * step_cos - sin * step_sin);
    }
}
