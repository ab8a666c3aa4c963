//! Cost for a length that is measured at each pose, by a draw-wire sensor or a telescoping bar.

use nalgebra::Vector3;

use super::{Movement, Residual, Scene};
use crate::logs::LengthRow;
use crate::model::{Geometry, Owner, ParameterId, SetUp, WireGeometry};

/// The residual is `(1 + scale) |R attachment - anchor| + offset - measured` \[m\], divided by the relative noise of the
/// sample. The relative noise is the standard deviation of this sample, divided by the standard deviation of the median
/// sample. The problem divides the residual by the standard deviation of the median sample.
#[derive(Debug, Clone)]
pub struct MeasuredLength<'a> {
    /// Each sample with its length, anchor and attachment. Samples without a row are ignored.
    pub rows: &'a [LengthRow],
    /// Relative noise of each sample. Samples without an entry are ignored.
    pub relative_noise: Vec<f64>,
}

/// The wire at one sample, in the root frame.
#[derive(Debug, Clone, Copy)]
pub struct Stretched {
    length_m: f64,
    set_up: SetUp,
    relative_noise: f64,
    flange_to_attachment_m: Vector3<f64>,
    /// Vector from the anchor to the attachment.
    wire_m: Vector3<f64>,
}

impl Residual for MeasuredLength<'_> {
    type Local = Stretched;

    const NAME: &'static str = "measured_length";
    const ROWS: usize = 1;
    const OWNER: Owner = Owner::Wire;

    fn local(&self, scene: &Scene<'_>) -> Option<Stretched> {
        let LengthRow { length_m, set_up, .. } = *self.rows.get(scene.sample)?;
        let relative_noise = *self.relative_noise.get(scene.sample)?;
        let (anchor_m, attachment_m) = scene.geometry.wire.at(set_up)?;
        let flange_to_attachment_m = scene.robot.rotation() * attachment_m;
        let wire_m = scene.robot.position_m() + flange_to_attachment_m - anchor_m;
        Some(Stretched { length_m, set_up, relative_noise, flange_to_attachment_m, wire_m })
    }

    fn residual(&self, scene: &Scene<'_>, wire: &Stretched, out: &mut [f64]) {
        let Geometry { wire: WireGeometry { offset_m, .. }, scale, .. } = scene.geometry;
        let residual_m = (1.0 + scale) * wire.wire_m.norm() + offset_m - wire.length_m;
        out[0] = residual_m / wire.relative_noise;
    }

    fn derivative(&self, scene: &Scene<'_>, wire: &Stretched, id: ParameterId, out: &mut [f64]) {
        let Stretched { set_up, relative_noise, flange_to_attachment_m, wire_m, .. } = wire;
        // At zero length the direction is undefined, so the derivative is set to zero.
        let direction = if wire_m.norm() > 0.0 { wire_m.normalize() } else { *wire_m };
        let direction = direction * (1.0 + scene.geometry.scale);
        let derivative = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => direction.dot(&twist.carried(flange_to_attachment_m).linear),
            (ParameterId::Attachment { target, axis }, _) if target == set_up.target => {
                direction.dot(&(scene.robot.rotation() * axis.unit()))
            }
            (ParameterId::Anchor { station, axis }, _) if station == set_up.station => {
                -direction[axis.index()]
            }
            (ParameterId::LengthOffset, _) => 1.0,
            (ParameterId::Scale, _) => wire_m.norm(),
            _ => 0.0,
        };
        out[0] = derivative / relative_noise;
    }
}
