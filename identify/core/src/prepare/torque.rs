//! Computes the force along the bar from the torques of the robot's joints. `forces` uses it for force logs of joint torques.
//!
//! The bar exerts one unknown force `F` on the robot, along the bar's axis. The torques of a sample are `tau = n F + Y p`.
//! Here `n = J^T u`, where `J` is the Jacobian of the robot's end and `u` is the direction of the bar, from the bar's base.
//! With torques of motors, `F` is positive under tension.
//!
//! `Y p` is linear in a small number of *terms* `p`, which are constant in the whole run. The terms of each link are its
//! mass and first moments (gravity). The terms of each axis are Coulomb friction, viscous friction and inertia.
//!
//! Each sample has one torque for each axis, but only one unknown force. The component of the torques perpendicular to `n`
//! does not depend on the force. From this component, `p` is estimated by least squares over all samples. With `p`, the force
//! of each sample is computed. The torques may be motor torques or external torques; with external torques `p` is near zero.

use nalgebra::{DMatrix, DVector, Vector3};

use crate::kinematics::{Chain, Joints, Trace, Tracer};
use crate::model::{BACKLASH_SPEED_RAD_S, JointState};

/// Number of terms of each link: mass and three first moments.
const TERMS_PER_LINK: usize = 4;
/// Number of terms of each axis: Coulomb friction, viscous friction and inertia.
const TERMS_PER_AXIS: usize = 3;
/// Weight of one kilogram \[N\].
const STANDARD_GRAVITY: f64 = 9.806_65;
/// Combinations of terms whose eigenvalue is below this fraction of the largest one are set to zero, because the torques
/// do not determine them.
const RANK_TOLERANCE: f64 = 1e-10;
/// Number of rounds in which the axes are weighted by their residuals.
const ROUNDS: usize = 3;
/// Smallest assumed standard deviation of the torque of an axis \[N m\].
const SIGMA_MIN_NM: f64 = 1e-3;
/// Smallest number of samples for each term.
const SAMPLES_PER_TERM: usize = 5;

/// The coefficients of the equation `tau = n F + Y p` for one sample.
pub(super) struct TorqueSample {
    /// `tau`: torque of each axis \[N m\].
    torque_nm: DVector<f64>,
    /// `n`: torque of each axis for a force of one newton along the bar.
    by_force: DVector<f64>,
    /// `Y`: torque of each axis (rows) for one unit of each term (columns).
    by_term: DMatrix<f64>,
}

/// Forces along the bar that were computed from torques.
pub(super) struct FromTorques {
    /// Force along the bar of each sample \[N\].
    pub along_n: Vec<f64>,
    /// Root mean square of the residual torques over all axes \[N m\].
    pub rms_nm: f64,
}

impl TorqueSample {
    pub fn new(
        robot: &Chain,
        base_m: Vector3<f64>,
        gravity: Vector3<f64>,
        state: &JointState,
        torque_nm: Joints,
    ) -> Self {
        let mut trace = Trace::default();
        Tracer::new(robot).trace(&state.q, &mut trace);
        let bar_direction = (trace.position_m() - base_m).normalize();
        let axes = robot.links.len();
        let by_force = trace.joint_twists().map(|twist| bar_direction.dot(&twist.linear));
        let by_force = DVector::from_iterator(axes, by_force);
        let mut by_term = DMatrix::zeros(axes, (TERMS_PER_LINK + TERMS_PER_AXIS) * axes);
        let weight = gravity * STANDARD_GRAVITY;
        let mut frame = robot.root_from_base;
        for (link, (link_parameters, joint)) in robot.joined(&state.q).enumerate() {
            frame *= link_parameters.transform(joint);
            // The weight of a link loads only the axes up to this link, not the axes beyond the link.
            for (joint, twist) in trace.point_twists(frame.translation.vector, link + 1).enumerate() {
                by_term[(joint, TERMS_PER_LINK * link)] = -twist.linear.dot(&weight);
                for axis in 0..3 {
                    // A first moment of one unit is one kilogram at one metre from the frame's origin.
                    let lever: Vector3<f64> = frame.rotation.matrix().column(axis).into();
                    by_term[(joint, TERMS_PER_LINK * link + 1 + axis)] =
                        -twist.angular.dot(&lever.cross(&weight));
                }
            }
        }
        for axis in 0..axes {
            let terms = [(state.qd[axis] / BACKLASH_SPEED_RAD_S).tanh(), state.qd[axis], state.qdd[axis]];
            for (kind, term) in terms.into_iter().enumerate() {
                by_term[(axis, TERMS_PER_LINK * axes + TERMS_PER_AXIS * axis + kind)] = term;
            }
        }
        Self { torque_nm: DVector::from_iterator(axes, torque_nm), by_force, by_term }
    }

    /// The force that fits the torques best, with a weight for each axis: `n W tau / n W n` \[N\].
    fn force(&self, torque_nm: &DVector<f64>, weights: &DVector<f64>) -> f64 {
        let weighted = self.by_force.component_mul(weights);
        weighted.dot(torque_nm) / weighted.dot(&self.by_force).max(f64::MIN_POSITIVE)
    }

    /// Torques minus the torques of the terms: `tau - Y p` \[N m\].
    fn without_terms_nm(&self, terms: &DVector<f64>) -> DVector<f64> {
        &self.torque_nm - &self.by_term * terms
    }
}

/// Computes the force of each sample. `None` if there are too few samples, or if the solution is not finite.
pub(super) fn forces_from_torques(samples: &[TorqueSample]) -> Option<FromTorques> {
    let (axes, term_count) = samples.first()?.by_term.shape();
    if samples.len() < SAMPLES_PER_TERM * term_count {
        return None;
    }
    let mut weights = DVector::repeat(axes, 1.0);
    let mut terms = DVector::zeros(term_count);
    let mut sigma_nm = DVector::zeros(axes);
    for _ in 0..ROUNDS {
        terms = least_squares_terms(samples, &weights)?;
        sigma_nm = spread_nm(samples, &terms, &weights);
        weights = sigma_nm.map(|sigma| sigma.max(SIGMA_MIN_NM).powi(-2));
    }
    let along_n: Vec<f64> =
        samples.iter().map(|sample| sample.force(&sample.without_terms_nm(&terms), &weights)).collect();
    let rms_nm = (sigma_nm.norm_squared() / axes as f64).sqrt();
    along_n.iter().all(|force| force.is_finite()).then_some(FromTorques { along_n, rms_nm })
}

/// Root mean square of the residual torque of each axis \[N m\].
fn spread_nm(samples: &[TorqueSample], terms: &DVector<f64>, weights: &DVector<f64>) -> DVector<f64> {
    let axes = weights.len();
    let squares = samples.iter().fold(DVector::zeros(axes), |sum: DVector<f64>, sample| {
        let torque_nm = sample.without_terms_nm(terms);
        let residual_nm = &torque_nm - &sample.by_force * sample.force(&torque_nm, weights);
        sum + residual_nm.component_mul(&residual_nm)
    });
    // From the `axes` torques of a sample, one force is estimated, so each sample has `axes - 1` degrees of freedom.
    // These are shared equally among the axes.
    let count = samples.len() as f64 * (axes - 1) as f64 / axes as f64;
    squares.map(|sum| (sum / count).sqrt())
}

/// Computes the terms by least squares, from the component of the torques perpendicular to `n` in each sample. Combinations
/// of terms that have no effect on any torque of the run are not determined. The solution with the smallest norm is then
/// returned. `None` if the normal matrix is not finite or zero.
fn least_squares_terms(samples: &[TorqueSample], weights: &DVector<f64>) -> Option<DVector<f64>> {
    let terms = samples.first()?.by_term.ncols();
    let mut normal = DMatrix::zeros(terms, terms);
    let mut right = DVector::zeros(terms);
    for sample in samples {
        // Removes the components of `Y` and `tau` along `n`, in the metric of the weights.
        let mut across = sample.by_term.clone();
        for mut column in across.column_iter_mut() {
            let column_force = sample.force(&column.clone_owned(), weights);
            column -= &sample.by_force * column_force;
        }
        let torque_across = &sample.torque_nm - &sample.by_force * sample.force(&sample.torque_nm, weights);
        let mut weighted = across.clone();
        for mut column in weighted.column_iter_mut() {
            column.component_mul_assign(weights);
        }
        normal += weighted.tr_mul(&across);
        right += weighted.tr_mul(&torque_across);
    }
    // The terms have different units. Each term is scaled by the root of its diagonal entry, so that
    // the eigenvalues are comparable.
    let scale = normal.diagonal().map(|entry: f64| if entry > 0.0 { entry.sqrt().recip() } else { 0.0 });
    let scaled = DMatrix::from_fn(terms, terms, |i, j| normal[(i, j)] * scale[i] * scale[j]);
    let eigen = scaled.symmetric_eigen();
    let largest = eigen.eigenvalues.max();
    if !(largest.is_finite() && largest > 0.0) {
        return None;
    }
    let mut by_eigenvector = eigen.eigenvectors.tr_mul(&right.component_mul(&scale));
    for (entry, value) in by_eigenvector.iter_mut().zip(eigen.eigenvalues.iter()) {
        *entry = if *value > RANK_TOLERANCE * largest { *entry / value } else { 0.0 };
    }
    Some((eigen.eigenvectors * by_eigenvector).component_mul(&scale))
}
