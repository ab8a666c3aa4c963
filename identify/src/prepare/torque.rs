//! The force along the bar from the torques of the robot's joints.
//!
//! Held by the bar the robot feels one unknown force `F` along it: `tau = n F + Y p`, with `n = J^T u` for the direction
//! `u` of the bar. `Y p` is linear in few numbers `p` that hold for the whole run: mass and first moments of each link
//! (gravity), and Coulomb friction, viscous friction and inertia of each axis. A sample has six torques and one force; what
//! is left of it across `n` gives `p` by least squares, then each sample gives its force. The torques may be those of
//! the motors or external ones: then `p` comes out near zero.

use nalgebra::{DMatrix, DVector, SMatrix, SVector, Vector3, Vector6};

use crate::kinematics::{Chain, ROBOT_JOINTS, Trace, Tracer};
use crate::model::{BACKLASH_SPEED_RAD_S, JointState};

/// Mass and three first moments of each link; three terms of each axis.
const GRAVITY: usize = 4 * ROBOT_JOINTS;
const TERMS: usize = GRAVITY + 3 * ROBOT_JOINTS;
/// Weight of one kilogram \[N\].
const STANDARD_GRAVITY: f64 = 9.806_65;
/// Combinations of terms that do less than this part of the strongest, in squares, are none: links' masses are not told
/// apart one by one.
const RANK_TOLERANCE: f64 = 1e-10;
/// Times that the axes are weighed anew by what is left of them.
const ROUNDS: usize = 3;
/// Axes are never trusted better than this \[N m\].
const SIGMA_MIN_NM: f64 = 1e-3;
/// Samples for each term, at least.
const SAMPLES_PER_TERM: usize = 5;

type Regressors = SMatrix<f64, ROBOT_JOINTS, TERMS>;
type Terms = SVector<f64, TERMS>;

/// One sample as the solve needs it.
pub(super) struct TorqueSample {
    torque_nm: Vector6<f64>,
    /// Torques of one newton along the bar.
    by_force: Vector6<f64>,
    by_term: Box<Regressors>,
}

/// What torques say.
pub(super) struct FromTorques {
    /// Force along the bar of each sample \[N\].
    pub along_n: Vec<f64>,
    /// What is left of the torques, root mean square \[N m\].
    pub rms_nm: f64,
}

impl TorqueSample {
    pub fn new(
        robot: &Chain,
        base_m: Vector3<f64>,
        gravity: Vector3<f64>,
        state: &JointState,
        torque_nm: [f64; ROBOT_JOINTS],
    ) -> Self {
        let mut trace = Trace::default();
        Tracer::new(robot).trace(&state.q, &mut trace);
        let out = (trace.position_m() - base_m).normalize();
        let mut by_force = Vector6::zeros();
        for (entry, twist) in by_force.iter_mut().zip(trace.joint_twists()) {
            *entry = out.dot(&twist.linear);
        }
        let mut by_term = Box::new(Regressors::zeros());
        let weight = gravity * STANDARD_GRAVITY;
        let axes: Vec<(Vector3<f64>, Vector3<f64>)> = trace.joint_axes().collect();
        let mut frame = robot.root_from_base;
        for (link, (of_link, joint_rad)) in robot.joined(&state.q).enumerate().take(ROBOT_JOINTS) {
            frame *= of_link.transform(joint_rad);
            let turns = frame.rotation.matrix();
            // Motors hold against gravity; those beyond the link do not feel it.
            for (joint, (origin, z)) in axes.iter().enumerate().take(link + 1) {
                let lever = frame.translation.vector - origin;
                by_term[(joint, 4 * link)] = -z.dot(&lever.cross(&weight));
                for axis in 0..3 {
                    let moment: Vector3<f64> = turns.column(axis).into();
                    by_term[(joint, 4 * link + 1 + axis)] = -z.dot(&moment.cross(&weight));
                }
            }
        }
        for axis in 0..ROBOT_JOINTS {
            let terms = [(state.qd[axis] / BACKLASH_SPEED_RAD_S).tanh(), state.qd[axis], state.qdd[axis]];
            for (kind, term) in terms.into_iter().enumerate() {
                by_term[(axis, GRAVITY + 3 * axis + kind)] = term;
            }
        }
        Self { torque_nm: Vector6::from(torque_nm), by_force, by_term }
    }

    /// The force that fits best to what is left of the torques, each axis with its weight.
    fn force(&self, left_nm: &Vector6<f64>, weights: &Vector6<f64>) -> f64 {
        let weighed = self.by_force.component_mul(weights);
        weighed.dot(left_nm) / weighed.dot(&self.by_force).max(f64::MIN_POSITIVE)
    }

    fn left_nm(&self, terms: &Terms) -> Vector6<f64> {
        self.torque_nm - *self.by_term * terms
    }
}

/// The force of each sample; none where the samples are too few or not finite.
pub(super) fn forces_from_torques(samples: &[TorqueSample]) -> Option<FromTorques> {
    if samples.len() < SAMPLES_PER_TERM * TERMS {
        return None;
    }
    let mut weights = Vector6::repeat(1.0);
    let mut terms = Terms::zeros();
    let mut sigma_nm = Vector6::zeros();
    for _ in 0..ROUNDS {
        terms = solved(samples, &weights)?;
        sigma_nm = spread_nm(samples, &terms, &weights);
        weights = sigma_nm.map(|sigma| sigma.max(SIGMA_MIN_NM).powi(-2));
    }
    let along_n: Vec<f64> =
        samples.iter().map(|sample| sample.force(&sample.left_nm(&terms), &weights)).collect();
    let rms_nm = (sigma_nm.norm_squared() / ROBOT_JOINTS as f64).sqrt();
    along_n.iter().all(|force| force.is_finite()).then_some(FromTorques { along_n, rms_nm })
}

/// Root mean square of what is left of each axis.
fn spread_nm(samples: &[TorqueSample], terms: &Terms, weights: &Vector6<f64>) -> Vector6<f64> {
    let squares: Vector6<f64> = samples
        .iter()
        .map(|sample| {
            let left = sample.left_nm(terms);
            let rest = left - sample.by_force * sample.force(&left, weights);
            rest.component_mul(&rest)
        })
        .sum();
    // One of six torques went into the force.
    let count = samples.len() as f64 * (ROBOT_JOINTS - 1) as f64 / ROBOT_JOINTS as f64;
    squares.map(|sum| (sum / count).sqrt())
}

/// Least squares across the force in each sample, of smallest norm where terms are not told apart: those combinations do
/// nothing to any torque of the run.
fn solved(samples: &[TorqueSample], weights: &Vector6<f64>) -> Option<Terms> {
    let mut normal = DMatrix::zeros(TERMS, TERMS);
    let mut right = DVector::zeros(TERMS);
    for sample in samples {
        // Y and tau without their parts along n, in the metric of the weights.
        let mut across = sample.by_term.clone_owned();
        for mut column in across.column_iter_mut() {
            let column_force = sample.force(&column.clone_owned(), weights);
            column -= sample.by_force * column_force;
        }
        let torque = sample.torque_nm - sample.by_force * sample.force(&sample.torque_nm, weights);
        let mut weighed = across;
        for mut column in weighed.column_iter_mut() {
            column.component_mul_assign(weights);
        }
        normal += weighed.transpose() * across;
        right += weighed.transpose() * torque;
    }
    let scale = normal.diagonal().map(|entry: f64| if entry > 0.0 { entry.sqrt().recip() } else { 0.0 });
    let scaled = DMatrix::from_fn(TERMS, TERMS, |i, j| normal[(i, j)] * scale[i] * scale[j]);
    let eigen = scaled.symmetric_eigen();
    let most = eigen.eigenvalues.max();
    if !(most.is_finite() && most > 0.0) {
        return None;
    }
    let mut turned = eigen.eigenvectors.tr_mul(&right.component_mul(&scale));
    for (entry, value) in turned.iter_mut().zip(eigen.eigenvalues.iter()) {
        *entry = if *value > RANK_TOLERANCE * most { *entry / value } else { 0.0 };
    }
    let terms = (eigen.eigenvectors * turned).component_mul(&scale);
    Some(Terms::from_iterator(terms.iter().copied()))
}
