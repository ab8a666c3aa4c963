//! Chains of Denavit-Hartenberg links as products of 4x4 matrices, and iterative inverse kinematics.

use nalgebra::{Matrix3, Matrix4, Matrix6, Vector3, Vector6};

/// One link in the standard convention: `Rz(theta) Tz(d) Tx(a) Rx(alpha)`, then `Ry(beta)` \[m, rad\]. The angle of the
/// joint is added to theta.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dh {
    pub a_m: f64,
    pub alpha_rad: f64,
    pub d_m: f64,
    pub theta_rad: f64,
    pub beta_rad: f64,
}

impl Dh {
    /// A link in the units of data sheets \[m, deg\].
    pub fn new(a_m: f64, alpha_deg: f64, d_m: f64, theta_deg: f64) -> Self {
        Self { a_m, alpha_rad: alpha_deg.to_radians(), d_m, theta_rad: theta_deg.to_radians(), beta_rad: 0.0 }
    }

    /// The matrix `previous_from_link` at the joint angle `angle_rad`.
    fn matrix(&self, angle_rad: f64) -> Matrix4<f64> {
        let (st, ct) = (self.theta_rad + angle_rad).sin_cos();
        let (sa, ca) = self.alpha_rad.sin_cos();
        #[rustfmt::skip]
        let rows = Matrix4::new(
            ct, -st * ca,  st * sa, self.a_m * ct,
            st,  ct * ca, -ct * sa, self.a_m * st,
            0.0,      sa,       ca, self.d_m,
            0.0,     0.0,      0.0, 1.0,
        );
        let (sb, cb) = self.beta_rad.sin_cos();
        #[rustfmt::skip]
        let about_y = Matrix4::new(
            cb,  0.0, sb,  0.0,
            0.0, 1.0, 0.0, 0.0,
            -sb, 0.0, cb,  0.0,
            0.0, 0.0, 0.0, 1.0,
        );
        rows * about_y
    }
}

/// The matrix `base_from_end` of a chain at these joint angles.
pub fn forward(links: &[Dh], angles_rad: &[f64]) -> Matrix4<f64> {
    links.iter().zip(angles_rad).fold(Matrix4::identity(), |sum, (link, angle)| sum * link.matrix(*angle))
}

/// Rotation matrix of a pose.
pub fn rotation(pose: &Matrix4<f64>) -> Matrix3<f64> {
    pose.fixed_view::<3, 3>(0, 0).into_owned()
}

/// Position of a pose \[m\].
pub fn position(pose: &Matrix4<f64>) -> Vector3<f64> {
    pose.fixed_view::<3, 1>(0, 3).into_owned()
}

/// Difference of two poses, `to` minus `from`, in the axes of the base \[m, rad\]. The first three numbers are the
/// difference of the positions, the last three are a rotation vector.
///
/// The angle is computed from sine and cosine, because the arc cosine alone loses half of the digits of small angles.
pub fn difference(to: &Matrix4<f64>, from: &Matrix4<f64>) -> Vector6<f64> {
    let step = position(to) - position(from);
    let m = rotation(to) * rotation(from).transpose();
    let sine = Vector3::new(m[(2, 1)] - m[(1, 2)], m[(0, 2)] - m[(2, 0)], m[(1, 0)] - m[(0, 1)]) / 2.0;
    let size = sine.norm();
    let turn = if size > 0.0 { sine * (size.atan2((m.trace() - 1.0) / 2.0) / size) } else { sine };
    Vector6::new(step.x, step.y, step.z, turn.x, turn.y, turn.z)
}

/// An arm of six links with the inverse kinematics of its end.
#[derive(Debug, Clone)]
pub struct Arm {
    pub links: [Dh; 6],
}

impl Arm {
    pub fn pose(&self, angles_rad: &[f64; 6]) -> Matrix4<f64> {
        forward(&self.links, angles_rad)
    }

    fn jacobian(&self, angles_rad: &[f64; 6]) -> (Matrix4<f64>, Matrix6<f64>) {
        let end = self.pose(angles_rad);
        let mut before = Matrix4::identity();
        let mut columns = Matrix6::zeros();
        for (joint, (link, angle)) in self.links.iter().zip(angles_rad).enumerate() {
            let axis = before.fixed_view::<3, 1>(0, 2).into_owned();
            let speed = axis.cross(&(position(&end) - position(&before)));
            columns.fixed_view_mut::<3, 1>(0, joint).copy_from(&speed);
            columns.fixed_view_mut::<3, 1>(3, joint).copy_from(&axis);
            before *= link.matrix(*angle);
        }
        (end, columns)
    }

    /// Joint angles near `start_rad` at which the end of the arm is at `target` within 1e-12 m and rad. `None` if Newton's
    /// method does not converge, as at singular poses and outside the reach.
    pub fn inverse_near(&self, target: &Matrix4<f64>, start_rad: &[f64; 6]) -> Option<[f64; 6]> {
        let mut angles = *start_rad;
        for _ in 0..12 {
            let (pose, jacobian) = self.jacobian(&angles);
            let error = difference(target, &pose);
            if error.amax() < 1e-12 {
                return Some(angles);
            }
            let step = jacobian.lu().solve(&error)?;
            if step.amax() > 1.0 {
                return None;
            }
            angles.iter_mut().zip(step.iter()).for_each(|(angle, step)| *angle += step);
        }
        let (pose, _) = self.jacobian(&angles);
        (difference(target, &pose).amax() < 1e-11).then_some(angles)
    }
}

/// True if all joints are within their limits.
pub fn within(angles_rad: &[f64; 6], limits_rad: &[[f64; 2]; 6]) -> bool {
    angles_rad.iter().zip(limits_rad).all(|(angle, [low, high])| (low..=high).contains(&angle))
}

/// The sensed ball-bar: five links on a base that has any position and a small tilt.
#[derive(Debug, Clone)]
pub struct Bar {
    pub world_from_base: Matrix4<f64>,
    pub links: [Dh; 5],
}

impl Bar {
    /// Pose of the end at these joint angles. The rod is longer than its parameter by `longer_m`.
    pub fn pose(&self, angles_rad: &[f64; 5], longer_m: f64) -> Matrix4<f64> {
        let mut links = self.links;
        links[2].d_m += longer_m;
        self.world_from_base * forward(&links, angles_rad)
    }
}
