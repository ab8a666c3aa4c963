//! Functions that the inverse kinematics of the robot and of the bar share. A chain has a nominal structure if all its
//! twists are multiples of 90 degrees, which permits a closed form. The functions of the first group check the
//! structure and compute angles of the closed form. The functions of the second group refine joint variables on the
//! true chain, which has errors in every parameter.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, Vector3};
use shared::config::JointKind;

use super::{Chain, Pose, Trace, Tracer};

/// Why the inverse kinematics has no solution.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum InverseError {
    /// The links do not have the structure of the closed form.
    #[error("link {link} has {key} = {value:.4}, the closed form needs {expected}; check the configuration")]
    Structure {
        /// Number of the link, from 1.
        link: usize,
        /// Name of the parameter: `alpha_deg`, `a_m` or `d_m`.
        key: &'static str,
        /// Value of the parameter \[deg, m\].
        value: f64,
        /// Value that the structure requires \[deg, m\].
        expected: &'static str,
    },
    /// An axis is prismatic, which the closed form does not support.
    #[error(
        "axis {link} is prismatic, the closed form needs revolute axes; check `joint` in the configuration"
    )]
    Prismatic {
        /// Number of the link, from 1.
        link: usize,
    },
    /// The chain does not have the number of links that the structure requires.
    #[error("the chain has {found} links, {expected} are needed; check the links in the configuration")]
    Links {
        /// Number of links of the chain.
        found: usize,
        /// Number of links of the structure.
        expected: usize,
    },
    /// The pose is outside the workspace.
    #[error(
        "the pose at x {x_m:.3}, y {y_m:.3}, z {z_m:.3} m is out of reach; bring it closer to the robot's base"
    )]
    Unreachable {
        /// x of the target position \[m\].
        x_m: f64,
        /// y of the target position \[m\].
        y_m: f64,
        /// z of the target position \[m\].
        z_m: f64,
    },
    /// Refinement on the given chain did not converge: the pose is singular, or the chain differs too much
    /// from its nominal structure.
    #[error(
        "joint angles did not converge (last step {step_rad:.1e} rad after {iterations} iterations); \
         move the pose away from a singularity or check the chain's parameters"
    )]
    NotConverged {
        /// Number of iterations. It is below the limit if the iteration ended because no further step could be computed, as
        /// at a singular pose.
        iterations: usize,
        /// Largest motion of a joint in the last step; infinite if no step was computed.
        step_rad: f64,
    },
}

impl InverseError {
    pub(super) fn unreachable(target: &Pose) -> Self {
        let p = target.translation.vector;
        Self::Unreachable { x_m: p.x, y_m: p.y, z_m: p.z }
    }
}

/// Largest deviation of a twist from a multiple of 90 degrees in the nominal structure \[rad\].
const TWIST_TOLERANCE_RAD: f64 = 0.1;
/// Lengths up to this value count as zero in the nominal structure \[m\]. The limit is ten times the manufacturing errors of
/// robots, and a tenth of the smallest designed offset of a wrist.
const LENGTH_TOLERANCE_M: f64 = 5e-3;

/// Checks that all axes are revolute.
pub(super) fn revolute(chain: &Chain) -> Result<(), InverseError> {
    let prismatic = chain.links.iter().position(|link| link.joint == JointKind::Prismatic);
    prismatic.map_or(Ok(()), |index| Err(InverseError::Prismatic { link: index + 1 }))
}

/// The sign of the twist of a link (`index` from 0) if the twist is +-90 degrees; otherwise an error.
pub(super) fn right_angle(chain: &Chain, index: usize) -> Result<f64, InverseError> {
    let alpha_rad = twist_rad(chain, index);
    if alpha_rad.cos().abs() < TWIST_TOLERANCE_RAD {
        return Ok(alpha_rad.sin().signum());
    }
    Err(wrong_twist(chain, index, "+-90"))
}

/// 1 if the twist of a link (`index` from 0) is 0 degrees, -1 if it is 180 degrees; otherwise an error.
pub(super) fn parallel(chain: &Chain, index: usize) -> Result<f64, InverseError> {
    let alpha_rad = twist_rad(chain, index);
    if alpha_rad.sin().abs() < TWIST_TOLERANCE_RAD {
        return Ok(alpha_rad.cos().signum());
    }
    Err(wrong_twist(chain, index, "0 or 180"))
}

/// Checks that a length of link number `link` (from 1) is zero, up to manufacturing errors.
pub(super) fn without_length(link: usize, key: &'static str, value: f64) -> Result<(), InverseError> {
    if value.abs() < LENGTH_TOLERANCE_M {
        return Ok(());
    }
    Err(InverseError::Structure { link, key, value, expected: "0" })
}

fn twist_rad(chain: &Chain, index: usize) -> f64 {
    chain.links.get(index).map_or(f64::NAN, |link| link.alpha_rad)
}

fn wrong_twist(chain: &Chain, index: usize, expected: &'static str) -> InverseError {
    let value = twist_rad(chain, index).to_degrees();
    InverseError::Structure { link: index + 1, key: "alpha_deg", value, expected }
}

/// The rotation of a nominal link: by `theta_rad` about z, then a twist of `sign * 90` degrees about x.
pub(super) fn turn_and_twist(theta_rad: f64, sign: f64) -> Matrix3<f64> {
    let (s, c) = theta_rad.sin_cos();
    Matrix3::new(c, 0.0, sign * s, s, 0.0, -sign * c, 0.0, sign, 0.0)
}

/// Solves `Rz(first) Rx(sign0 90) Rz(second) Rx(sign1 90) z = direction` for the angles `(first, second)`. `side` is the
/// sign of sin(second). If `direction` is along z, every first angle is a solution, and `first_if_free` is returned.
pub(super) fn point_z(
    direction: &Vector3<f64>,
    signs: [f64; 2],
    side: f64,
    first_if_free: f64,
) -> (f64, f64) {
    // direction = (sign1 s2 c1, sign1 s2 s1, -sign0 sign1 c2)
    let across = direction.x.hypot(direction.y);
    let second = (side * across).atan2(-signs[0] * signs[1] * direction.z);
    let factor = side * signs[1];
    let first =
        if across < 1e-9 { first_if_free } else { (factor * direction.y).atan2(factor * direction.x) };
    (first, second)
}

/// Solves `Rz(t0) Rx(signs0 90) Rz(t1) Rx(signs1 90) Rz(t2) = rotation` for the three angles of a spherical wrist.
/// `side` and `first_if_free` are as in [`point_z`].
pub(super) fn wrist_angles(
    rotation: &Matrix3<f64>,
    signs: [f64; 2],
    side: f64,
    first_if_free: f64,
) -> [f64; 3] {
    let (first, second) = point_z(&rotation.column(2).into(), signs, side, first_if_free);
    let before_last = turn_and_twist(first, signs[0]) * turn_and_twist(second, signs[1]);
    let last = before_last.transpose() * rotation;
    [first, second, last[(1, 0)].atan2(last[(0, 0)])]
}

/// Adds whole turns to `angle_rad` so that the result is nearest to `near_rad`.
pub fn nearest_turn(angle_rad: f64, near_rad: f64) -> f64 {
    angle_rad + ((near_rad - angle_rad) / TAU).round() * TAU
}

/// Removes whole turns from an angle. The result is in (-pi, pi] \[rad\].
pub fn wrapped(angle_rad: f64) -> f64 {
    let wrapped = nearest_turn(angle_rad, 0.0);
    if wrapped <= -PI { wrapped + TAU } else { wrapped }
}

/// Sum of squared differences.
pub(super) fn distance_squared(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

/// Difference between target and end: target position minus end position \[m\], then the rotation vector \[rad\] of the
/// rotation from end to target.
pub(super) fn pose_error(target: &Pose, end: &Pose) -> SVector<f64, 6> {
    let position = target.translation.vector - end.translation.vector;
    let rotation: Rotation3<f64> = target.rotation * end.rotation.inverse();
    let turn = rotation_vector(rotation.matrix());
    SVector::from_iterator(position.iter().chain(turn.iter()).copied())
}

/// Rotation vector \[rad\] of a rotation matrix. The angle is computed by the arc tangent, because the arc
/// cosine of the trace loses half of the digits at small angles. The result is zero for a rotation by 180
/// degrees, where the sign of the axis is arbitrary.
pub fn rotation_vector(rotation: &Matrix3<f64>) -> Vector3<f64> {
    let r = rotation;
    let twice_sine = Vector3::new(r[(2, 1)] - r[(1, 2)], r[(0, 2)] - r[(2, 0)], r[(1, 0)] - r[(0, 1)]);
    let sine = 0.5 * twice_sine.norm();
    let angle = sine.atan2(0.5 * (r.trace() - 1.0));
    // Below this limit, angle and sine are equal in double precision.
    if sine < 1e-9 { 0.5 * twice_sine } else { twice_sine * (0.5 * angle / sine) }
}

/// The rotation nearest to a matrix, from its singular value decomposition; identity if the decomposition fails.
pub fn nearest_rotation(matrix: &Matrix3<f64>) -> Rotation3<f64> {
    let svd = matrix.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Rotation3::identity() };
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    Rotation3::from_matrix_unchecked(u * flip * v_t)
}

/// Joint variables \[rad, m\] at which the end of `chain` is closest to `target`, by Gauss-Newton iterations from `start`.
/// With six joints this is Newton's method. With more joints, each step is the shortest step to the solution of the
/// linearised equations. Metres and radians have equal weight.
pub(super) fn refine<const N: usize>(
    chain: &Chain,
    target: &Pose,
    start: [f64; N],
) -> Result<[f64; N], InverseError> {
    /// The iteration ends after a step below this size, because a further step would only contain rounding errors.
    const STEP_RAD_MIN: f64 = 1e-13;
    /// The iteration also ends after a step below this size if the step is not much shorter than the step before.
    /// Rounding errors then prevent further progress.
    const STEP_RAD_ACCEPTED: f64 = 1e-10;
    const ITERATIONS_MAX: usize = 30;
    /// Longer steps are shortened to this size, because the linearisation is valid only for short steps.
    const STEP_RAD_MAX: f64 = 0.5;

    let tracer = Tracer::new(chain);
    let mut trace = Trace::default();
    let mut joints = SVector::<f64, N>::from(start);
    let (mut iterations, mut step_rad) = (0, f64::INFINITY);
    while iterations < ITERATIONS_MAX {
        tracer.trace(joints.as_slice(), &mut trace);
        let mut jacobian = SMatrix::<f64, 6, N>::zeros();
        for (mut column, twist) in jacobian.column_iter_mut().zip(trace.joint_twists()) {
            column.copy_from(&twist.column());
        }
        let Some(step) = least_squares_step(jacobian, pose_error(target, trace.end())) else { break };
        iterations += 1;
        let previous = step_rad;
        step_rad = step.amax();
        joints += step * (STEP_RAD_MAX / step_rad.max(STEP_RAD_MAX));
        if step_rad < STEP_RAD_MIN || (step_rad < STEP_RAD_ACCEPTED && step_rad > 0.5 * previous) {
            return Ok(joints.into());
        }
        if !step_rad.is_finite() {
            break;
        }
    }
    if step_rad < STEP_RAD_ACCEPTED {
        return Ok(joints.into());
    }
    Err(InverseError::NotConverged { iterations, step_rad })
}

/// As [`refine`], for arms with more axes than a pose needs. Such an arm reaches a pose with many sets of joint
/// variables \[rad, m\]. Among the sets that are connected with `start`, the result is the set nearest to the middle of
/// the joint limits. Distances of joints from the middle are relative to their ranges. The result depends only on the
/// pose, not on the path to the pose (Liegeois 1977).
///
/// In the following formula, joint variables are divided by their ranges. `J` is the Jacobian, `J+` its pseudoinverse, `e`
/// the pose error, and `m` the vector from the joints to the middle. A step is `J+ e + (m - J+ J m) / 2`. The first term is
/// Newton's method towards the pose. The second term is half of a Gauss-Newton step towards the middle, by motions that do
/// not change the pose.
pub(super) fn refine_centred<const N: usize>(
    chain: &Chain,
    target: &Pose,
    start: [f64; N],
    limits: &[[f64; 2]],
) -> Result<[f64; N], InverseError> {
    /// After a step below this size the joints have converged up to rounding errors \[fraction of a range\].
    const STEP_MIN: f64 = 1e-12;
    /// If no iteration remains, a last step below this size is accepted \[fraction of a range\]. The remaining error does
    /// not change the pose, and is below the resolution of a controller.
    const STEP_ACCEPTED: f64 = 1e-9;
    const ITERATIONS_MAX: usize = 200;
    /// Fraction of the Gauss-Newton step towards the middle that is used. The Gauss-Newton step ignores the curvature of the
    /// constraint (the set of joints with this pose). With half of the step, the iteration converges unless the curvature
    /// contributes more than three times as much to the second derivative as the Gauss-Newton term.
    const STEP_SHARE: f64 = 0.5;
    /// Longer steps are shortened to this size \[fraction of a range\].
    const STEP_MAX: f64 = 0.1;

    let limit = |axis: usize| limits.get(axis).copied().unwrap_or([-PI, PI]);
    // The range is a divisor, so it is clamped to a positive minimum, and to a finite maximum for joints without limits.
    let range =
        SVector::<f64, N>::from_fn(|axis, _| (limit(axis)[1] - limit(axis)[0]).clamp(1e-3, 2.0 * TAU));
    let middle = SVector::<f64, N>::from_fn(|axis, _| 0.5 * (limit(axis)[0] + limit(axis)[1]));
    let tracer = Tracer::new(chain);
    let mut trace = Trace::default();
    let mut joints = SVector::<f64, N>::from(start);
    let (mut iterations, mut largest_step) = (0, f64::INFINITY);
    while iterations < ITERATIONS_MAX {
        tracer.trace(joints.as_slice(), &mut trace);
        let mut jacobian = SMatrix::<f64, 6, N>::zeros();
        for (axis, (mut column, twist)) in jacobian.column_iter_mut().zip(trace.joint_twists()).enumerate() {
            column.copy_from(&(twist.column() * range[axis]));
        }
        let to_middle = (middle - joints).component_div(&range);
        let error = pose_error(target, trace.end());
        let Some(to_pose) = least_squares_step(jacobian, error) else { break };
        let Some(off_pose) = least_squares_step(jacobian, jacobian * to_middle) else { break };
        iterations += 1;
        let step = to_pose + (to_middle - off_pose) * STEP_SHARE;
        largest_step = step.amax();
        joints += step.component_mul(&range) * (STEP_MAX / largest_step.max(STEP_MAX));
        if largest_step < STEP_MIN {
            return Ok(joints.into());
        }
        if !largest_step.is_finite() {
            break;
        }
    }
    if largest_step < STEP_ACCEPTED {
        return Ok(joints.into());
    }
    Err(InverseError::NotConverged { iterations, step_rad: largest_step * range.amax() })
}

/// Solves `x = argmin |J x - e|` by Householder QR of `[J e]`. For more than six joints, the result is the shortest `x` with
/// `J x = e`, that is, `J' (J J')^-1 e`. `None` if `J` is singular.
fn least_squares_step<const N: usize>(
    jacobian: SMatrix<f64, 6, N>,
    error: SVector<f64, 6>,
) -> Option<SVector<f64, N>> {
    /// With a smaller pivot, `J` counts as singular.
    const PIVOT_MIN: f64 = 1e-9;
    if N > 6 {
        let factor = (jacobian * jacobian.transpose()).cholesky()?;
        let is_regular = factor.l_dirty().diagonal().min() > PIVOT_MIN;
        return is_regular.then(|| jacobian.tr_mul(&factor.solve(&error)));
    }
    // Householder QR: reflections convert the matrix to a triangle, column by column, and are applied to the
    // right-hand side as well.
    let mut triangle = jacobian;
    let mut rhs = error;
    for k in 0..N {
        let mut reflector = SVector::<f64, 6>::zeros();
        reflector.rows_mut(k, 6 - k).copy_from(&triangle.column(k).rows(k, 6 - k));
        let pivot = -reflector.norm().copysign(reflector[k]);
        if pivot.abs() < PIVOT_MIN {
            return None;
        }
        reflector[k] -= pivot;
        let scale = 2.0 / reflector.norm_squared();
        for mut column in triangle.column_iter_mut().skip(k) {
            let along = scale * reflector.dot(&column);
            column -= reflector * along;
        }
        rhs -= reflector * (scale * reflector.dot(&rhs));
    }
    // Back substitution.
    let mut step = SVector::<f64, N>::zeros();
    for k in (0..N).rev() {
        let solved: f64 = (k + 1..N).map(|j| triangle[(k, j)] * step[j]).sum();
        step[k] = (rhs[k] - solved) / triangle[(k, k)];
    }
    Some(step)
}
