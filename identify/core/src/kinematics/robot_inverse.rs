//! Inverse kinematics of robots with six to eight axes: computes joint variables at a pose, also for arms with
//! errors in every parameter.
//!
//! Newton's method is used on the true chain. For a six-axis arm with a spherical wrist, it starts at the solutions of a
//! closed form for the nominal structure. For other arms, it starts at joint variables that the caller passes.

use nalgebra::Matrix3;

use super::inverse::{
    distance_squared, nearest_turn, parallel, refine, refine_centred, revolute, right_angle, turn_and_twist,
    without_length, wrapped, wrist_angles,
};
use super::{Chain, InverseError, Joints, Pose};

/// Number of axes that an arm needs to reach arbitrary poses.
const AXES: usize = 6;

/// Parameters of the closed form. Twists are rounded to right angles, and offsets that are zero in the nominal structure are
/// omitted. In the functions below, `t1` to `t6` are the angles of the links: joint variable plus `theta`.
struct ClosedForm {
    /// Signs of the twists of links 1, 3, 4 and 5. The sign for link 3 is that of an equivalent arm whose axis 3 has the
    /// direction of axis 2.
    signs: [f64; 4],
    /// 1 if axis 3 has the direction of axis 2; -1 if it has the opposite direction, as in arms by FANUC,
    /// which reverses joint 3.
    sense: f64,
    a1_m: f64,
    d1_m: f64,
    a2_m: f64,
    /// Offset of the wrist along axis 2.
    shoulder_m: f64,
    a3_m: f64,
    d4_m: f64,
    /// Offset of each joint: `theta` of its link.
    theta_rad: [f64; AXES],
}

impl ClosedForm {
    fn new(chain: &Chain) -> Result<Self, InverseError> {
        let &[l1, l2, l3, l4, l5, l6] = chain.links.as_slice() else {
            return Err(InverseError::Links { found: chain.links.len(), expected: AXES });
        };
        revolute(chain)?;
        let sense = parallel(chain, 1)?;
        let [sign1, sign3, sign4, sign5] =
            [right_angle(chain, 0)?, right_angle(chain, 2)?, right_angle(chain, 3)?, right_angle(chain, 4)?];
        // Axes 4, 5 and 6 intersect in one point, the centre of the wrist.
        without_length(4, "a_m", l4.a_m)?;
        without_length(5, "a_m", l5.a_m)?;
        without_length(5, "d_m", l5.d_m)?;
        Ok(Self {
            // Rx(180) Rz(theta3) Rx(alpha3) = Rz(-theta3) Rx(180 + alpha3)
            signs: [sign1, sense * sign3, sign4, sign5],
            sense,
            a1_m: l1.a_m,
            d1_m: l1.d_m,
            a2_m: l2.a_m,
            shoulder_m: l2.d_m + sense * l3.d_m,
            a3_m: l3.a_m,
            d4_m: l4.d_m,
            theta_rad: [l1, l2, l3, l4, l5, l6].map(|link| link.theta_rad),
        })
    }

    /// Angles `[t1, t2, t3]` \[rad\] that move the centre of the wrist to `wrist_m`, in base coordinates. There are
    /// up to four solutions.
    fn angles_to_wrist(&self, wrist_m: [f64; 3]) -> Vec<[f64; 3]> {
        let [sign1, sign3, ..] = self.signs;
        let [x, y, z] = wrist_m;
        // Along axis 2, the coordinate of the wrist is the shoulder's offset: x sin t1 - y cos t1 = sign1 shoulder.
        let Some(from_azimuth) = clamped(sign1 * self.shoulder_m / x.hypot(y)).map(f64::asin) else {
            return Vec::new();
        };
        let azimuth = y.atan2(x);
        let mut solutions = Vec::with_capacity(4);
        for t1 in [azimuth + from_azimuth, azimuth + std::f64::consts::PI - from_azimuth] {
            // Position of the wrist relative to axis 2, in the plane perpendicular to this axis.
            let (s1, c1) = t1.sin_cos();
            let (out, up) = (c1 * x + s1 * y - self.a1_m, sign1 * (z - self.d1_m));
            // The forearm connects elbow and wrist: its component along x of link 3 is a3, its perpendicular component is
            // d4. The upper arm, the forearm and the line from axis 2 to the wrist form a triangle.
            let forearm_m = self.a3_m.hypot(self.d4_m);
            let bend = (-sign3 * self.d4_m).atan2(self.a3_m);
            let cos_elbow =
                (out * out + up * up - self.a2_m.powi(2) - forearm_m.powi(2)) / (2.0 * self.a2_m * forearm_m);
            let Some(elbow) = clamped(cos_elbow).map(f64::acos) else { continue };
            for elbow in [elbow, -elbow] {
                let (s, c) = elbow.sin_cos();
                let t2 = up.atan2(out) - (forearm_m * s).atan2(self.a2_m + forearm_m * c);
                solutions.push([t1, t2, self.sense * (elbow - bend)]);
            }
        }
        solutions
    }

    /// Rotation of frame 3 relative to the base.
    fn base_from_link3(&self, [t1, t2, t3]: [f64; 3]) -> Matrix3<f64> {
        turn_and_twist(t1, self.signs[0]) * turn_and_twist(t2 + self.sense * t3, self.signs[1])
    }
}

/// Clamps a sine or cosine to the range from -1 to 1. Absolute values of less than 1.02 are accepted, because errors of the
/// chain can put a reachable pose slightly outside the nominal workspace. `None` for larger values and for NaN.
fn clamped(value: f64) -> Option<f64> {
    (value.abs() < 1.02).then(|| value.clamp(-1.0, 1.0))
}

/// Solutions of the closed form on the nominal structure: up to eight, each joint within half a turn of `near`.
fn closed_form(chain: &Chain, target: &Pose, near: &[f64; AXES]) -> Result<Vec<[f64; AXES]>, InverseError> {
    let arm = ClosedForm::new(chain)?;
    let after_joint6 = chain.links.last().map_or_else(Pose::identity, |link| link.after_joint());
    let base_from_wrist =
        chain.root_from_base.inverse() * target * (after_joint6 * chain.last_from_end).inverse();
    let wrist_rotation = base_from_wrist.rotation.matrix();
    let mut solutions = Vec::with_capacity(8);
    for [t1, t2, t3] in arm.angles_to_wrist(base_from_wrist.translation.vector.into()) {
        let link3_from_wrist = arm.base_from_link3([t1, t2, t3]).transpose() * wrist_rotation;
        for side in [1.0, -1.0] {
            let signs = [arm.signs[2], arm.signs[3]];
            let [t4, t5, t6] = wrist_angles(&link3_from_wrist, signs, side, near[3] + arm.theta_rad[3]);
            let angles = [t1, t2, t3, t4, t5, t6];
            solutions.push(std::array::from_fn(|i| nearest_turn(angles[i] - arm.theta_rad[i], near[i])));
        }
    }
    if solutions.is_empty() { Err(InverseError::unreachable(target)) } else { Ok(solutions) }
}

/// Joint variables \[rad, m\] that move the end of `chain` to `target`. If there are several solutions, the result is the
/// solution nearest to `near`, a list of one value for each axis.
///
/// A six-axis arm has a closed form if its axes are revolute, the twists of links 1, 3, 4 and 5 are right angles, axes 2 and
/// 3 are parallel with equal or opposite directions, and axes 4 to 6 intersect in one point. For such an arm, Newton's
/// method on the given chain starts at the closed form. The chain may have errors of some mm and mrad in every parameter.
///
/// For other arms, Newton's method starts at `near`, so it finds a solution only if a solution is near. With seven or eight
/// axes, each step has the least norm, so the solution is close to `near`.
///
/// # Errors
/// [`InverseError::Unreachable`] if the pose is outside the workspace. [`InverseError::NotConverged`] at a singularity, or
/// if the solution is too far from `near`. [`InverseError::Links`] if the arm does not have six to eight axes, or
/// `near` does not have one value for each axis.
pub fn robot_inverse(chain: &Chain, target: &Pose, near: &[f64]) -> Result<Joints, InverseError> {
    if near.len() != chain.links.len() {
        return Err(InverseError::Links { found: chain.links.len(), expected: near.len() });
    }
    match near.len() {
        6 => six_axes(chain, target, near),
        7 => from_near::<7>(chain, target, near),
        8 => from_near::<8>(chain, target, near),
        found => Err(InverseError::Links { found, expected: AXES }),
    }
}

/// As [`robot_inverse`], but with a different solution for seven and eight axes. Of all postures that are connected with
/// `near`, it is the posture nearest to the middle of the joint limits \[rad, m\]. It depends only on the pose, so the
/// joints return to their start on a closed path.
///
/// # Errors
/// The errors of [`robot_inverse`].
pub fn robot_inverse_centred(
    chain: &Chain,
    target: &Pose,
    near: &[f64],
    limits: &[[f64; 2]],
) -> Result<Joints, InverseError> {
    fn centred<const N: usize>(
        chain: &Chain,
        target: &Pose,
        near: &[f64],
        limits: &[[f64; 2]],
    ) -> Result<Joints, InverseError> {
        refine_centred::<N>(chain, target, std::array::from_fn(|axis| near[axis]), limits).map(Joints::from)
    }
    match (near.len() == chain.links.len(), near.len()) {
        (true, 7) => centred::<7>(chain, target, near, limits),
        (true, 8) => centred::<8>(chain, target, near, limits),
        _ => robot_inverse(chain, target, near),
    }
}

fn from_near<const N: usize>(chain: &Chain, target: &Pose, near: &[f64]) -> Result<Joints, InverseError> {
    let start = std::array::from_fn(|axis| near[axis]);
    refine::<N>(chain, target, start).map(Joints::from)
}

fn six_axes(chain: &Chain, target: &Pose, near: &[f64]) -> Result<Joints, InverseError> {
    let mut starts = match closed_form(chain, target, &std::array::from_fn(|axis| near[axis])) {
        Ok(starts) => starts,
        Err(InverseError::Structure { .. } | InverseError::Prismatic { .. }) => {
            return from_near::<AXES>(chain, target, near);
        }
        Err(error) => return Err(error),
    };
    starts.sort_by(|a, b| distance_squared(a, near).total_cmp(&distance_squared(b, near)));
    let mut failure = InverseError::unreachable(target);
    for start in starts {
        match refine(chain, target, start) {
            Ok(joints) => return Ok(joints.into()),
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

/// All solutions of a six-axis arm with a spherical wrist: up to eight, each joint in (-pi, pi]. A solution of the closed
/// form is omitted if Newton's method does not converge from it on the given chain.
///
/// # Errors
/// [`InverseError::Unreachable`] and [`InverseError::NotConverged`] if no solution converges. [`InverseError::Structure`],
/// [`InverseError::Prismatic`] and [`InverseError::Links`] for arms without this structure, whose solutions cannot be
/// listed.
pub fn robot_inverse_all(chain: &Chain, target: &Pose) -> Result<Vec<Joints>, InverseError> {
    let mut failure = InverseError::unreachable(target);
    let mut solutions = Vec::with_capacity(8);
    for start in closed_form(chain, target, &[0.0; AXES])? {
        match refine(chain, target, start) {
            Ok(joints) => solutions.push(joints.map(wrapped).into()),
            Err(error) => failure = error,
        }
    }
    if solutions.is_empty() { Err(failure) } else { Ok(solutions) }
}
