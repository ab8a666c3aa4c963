//! Cost that compares the whole pose, entry by entry. It needs all five encoders.

use nalgebra::{Matrix3, Vector3};

use crate::cost::residual::ALL_ENCODERS;
use crate::cost::{Movement, Residual, Scene};
use crate::kinematics::Twist;
use crate::model::ParameterId;

/// The residual is the twelve entries of `R - B` (thesis eq. 2.4): the columns of the rotation, then the position \[m\]. As
/// in the thesis, metres and matrix entries have equal weights.
#[derive(Debug, Clone, Copy, Default)]
pub struct Transform;

/// Writes the derivative of a pose for a twist with angular part `w` and linear part `v`: `sign ([w] rotation, v)`.
/// `rotation` is the rotation of the pose.
#[inline(always)]
fn write_derivative(twist: &Twist, rotation: &Matrix3<f64>, sign: f64, out: &mut [f64]) {
    let Some(out) = out.first_chunk_mut::<12>() else { return };
    let w: Vector3<f64> = twist.angular * sign;
    let v = twist.linear * sign;
    [out[9], out[10], out[11]] = v.into();
    // A translation does not rotate, so the other entries stay zero.
    if w == Vector3::zeros() {
        return;
    }
    for column in 0..3 {
        let (x, y, z) = (rotation[(0, column)], rotation[(1, column)], rotation[(2, column)]);
        out[3 * column] = w.y * z - w.z * y;
        out[3 * column + 1] = w.z * x - w.x * z;
        out[3 * column + 2] = w.x * y - w.y * x;
    }
}

impl Residual for Transform {
    type Local = ();

    const NAME: &'static str = "transform";
    const ROWS: usize = 12;
    const ENCODERS: &'static [usize] = ALL_ENCODERS;

    fn local(&self, _: &Scene<'_>) -> Option<()> {
        Some(())
    }

    fn residual(&self, scene: &Scene<'_>, (): &(), out: &mut [f64]) {
        let rotation = scene.robot.rotation() - scene.bar.rotation();
        let position = scene.robot.position_m() - scene.bar.position_m();
        for (out, entry) in out.iter_mut().zip(rotation.iter().chain(position.iter())) {
            *out = *entry;
        }
    }

    #[inline(always)]
    fn derivative(&self, scene: &Scene<'_>, (): &(), id: ParameterId, out: &mut [f64]) {
        match scene.movement(id) {
            Movement::Robot(twist) => write_derivative(&twist, scene.robot.rotation(), 1.0, out),
            Movement::Bar(twist) => write_derivative(&twist, scene.bar.rotation(), -1.0, out),
            Movement::None => {}
        }
    }
}
