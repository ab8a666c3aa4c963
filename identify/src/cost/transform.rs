//! The whole pose, entry by entry: all five encoders.

use nalgebra::{Matrix3, Vector3};

use super::scene::ALL_ENCODERS;
use super::{Movement, Residual, Scene};
use crate::kinematics::Twist;
use crate::model::ParameterId;

/// The twelve entries of `R - B` (thesis eq. 2.4), columns of the rotation, then the position \[m\]. Metres and matrix
/// entries weigh the same, as there.
#[derive(Debug, Clone, Copy, Default)]
pub struct Transform;

/// Entries of `dT` for a twist of a pose with this rotation: `sign ([w] R, v)`.
fn moved(twist: &Twist, rotation: &Matrix3<f64>, sign: f64, out: &mut [f64]) {
    let angular = twist.angular * sign;
    let turned = rotation.column_iter().map(|column| angular.cross(&Vector3::from(column)));
    let linear = twist.linear * sign;
    for (out, column) in out.chunks_exact_mut(3).zip(turned.chain([linear])) {
        out.copy_from_slice(column.as_slice());
    }
}

impl Residual for Transform {
    const NAME: &'static str = "transform";
    const ROWS: usize = 12;
    const ENCODERS: &'static [usize] = ALL_ENCODERS;

    fn sees(id: ParameterId) -> bool {
        !matches!(id, ParameterId::Attachment(_) | ParameterId::Anchor(_) | ParameterId::LengthOffset)
    }

    fn residual(&self, scene: &Scene<'_>, out: &mut [f64]) {
        let rotation = scene.robot.rotation() - scene.bar.rotation();
        let position = scene.robot.position_m() - scene.bar.position_m();
        for (out, entry) in out.iter_mut().zip(rotation.iter().chain(position.iter())) {
            *out = *entry;
        }
    }

    fn derivative(&self, scene: &Scene<'_>, id: ParameterId, out: &mut [f64]) {
        match scene.movement(id) {
            Movement::Robot(twist) => moved(&twist, scene.robot.rotation(), 1.0, out),
            Movement::Bar(twist) => moved(&twist, scene.bar.rotation(), -1.0, out),
            Movement::None => {}
        }
    }
}
