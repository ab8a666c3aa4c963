//! A length measured at each pose: draw-wire or telescoping bar.

use nalgebra::Vector3;

use super::scene::unit;
use super::{Movement, Residual, Scene};
use crate::model::{Owner, ParameterId};

/// `|R attachment - anchor| + offset - measured` \[m\].
#[derive(Debug, Clone, Copy, Default)]
pub struct MeasuredLength;

/// From anchor to attachment, in the root frame \[m\].
fn along_wire(scene: &Scene<'_>) -> Vector3<f64> {
    let wire = &scene.geometry.wire;
    scene.robot.position_m() + scene.robot.rotation() * wire.attachment_m - wire.anchor_m
}

impl Residual for MeasuredLength {
    /// From anchor to attachment \[m\].
    type Local = Vector3<f64>;

    const NAME: &'static str = "measured_length";
    const ROWS: usize = 1;
    const ENCODERS: &'static [usize] = &[];
    const NEEDS_LENGTH: bool = true;

    fn sees(id: ParameterId) -> bool {
        id.is_seen_by(Owner::Wire)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Vector3<f64>> {
        Some(along_wire(scene))
    }

    fn residual(&self, scene: &Scene<'_>, wire: &Vector3<f64>, out: &mut [f64]) {
        let measured_m = scene.observation.length_m.unwrap_or(f64::NAN);
        out[0] = wire.norm() + scene.geometry.wire.offset_m - measured_m;
    }

    fn derivative(&self, scene: &Scene<'_>, wire: &Vector3<f64>, id: ParameterId, out: &mut [f64]) {
        // At length zero it has no direction; there the derivative is taken as zero.
        let direction = if wire.norm() > 0.0 { wire.normalize() } else { *wire };
        let attachment = scene.robot.rotation() * scene.geometry.wire.attachment_m;
        out[0] = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => direction.dot(&(twist.linear + twist.angular.cross(&attachment))),
            (ParameterId::Attachment(axis), _) => direction.dot(&(scene.robot.rotation() * unit(axis))),
            (ParameterId::Anchor(axis), _) => -direction[axis.index()],
            (ParameterId::LengthOffset, _) => 1.0,
            _ => 0.0,
        };
    }
}
