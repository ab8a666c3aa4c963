//! A length measured at each pose: draw-wire or telescoping bar.

use nalgebra::Vector3;

use super::scene::unit;
use super::{Movement, Residual, Scene};
use crate::model::{Owner, ParameterId, SetUp};

/// `|R attachment - anchor| + offset - measured` \[m\], divided by the sample's noise relative to that of the median sample.
#[derive(Debug, Clone, Copy)]
pub struct MeasuredLength<'a> {
    /// Standard deviation of each sample relative to that of the median sample; a sample without entry is ignored.
    pub relative_noise: &'a [f64],
    /// Anchor and attachment of each sample; a sample without entry is ignored.
    pub set_ups: &'a [SetUp],
}

/// The wire at one sample, in the root frame.
#[derive(Debug, Clone, Copy)]
pub struct Stretched {
    set_up: SetUp,
    relative_noise: f64,
    /// Vector from the robot's end to the attachment \[m\].
    attachment_m: Vector3<f64>,
    /// Vector from anchor to attachment \[m\].
    along_m: Vector3<f64>,
}

impl Residual for MeasuredLength<'_> {
    type Local = Stretched;

    const NAME: &'static str = "measured_length";
    const ROWS: usize = 1;
    const ENCODERS: &'static [usize] = &[];
    const NEEDS_LENGTH: bool = true;

    fn depends_on(id: ParameterId) -> bool {
        id.affects(Owner::Wire)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Stretched> {
        let (set_up, relative_noise) =
            (*self.set_ups.get(scene.sample)?, *self.relative_noise.get(scene.sample)?);
        let (anchor_m, attachment_m) = scene.geometry.wire.at(set_up)?;
        let attachment_m = scene.robot.rotation() * attachment_m;
        let along_m = scene.robot.position_m() + attachment_m - anchor_m;
        Some(Stretched { set_up, relative_noise, attachment_m, along_m })
    }

    fn residual(&self, scene: &Scene<'_>, wire: &Stretched, out: &mut [f64]) {
        let measured_m = scene.observation.length_m.unwrap_or(f64::NAN);
        let residual_m = wire.along_m.norm() + scene.geometry.wire.offset_m - measured_m;
        out[0] = residual_m / wire.relative_noise;
    }

    fn derivative(&self, scene: &Scene<'_>, wire: &Stretched, id: ParameterId, out: &mut [f64]) {
        let Stretched { set_up, relative_noise, attachment_m, along_m } = wire;
        // At zero length the direction is undefined; the derivative is taken as zero.
        let direction = if along_m.norm() > 0.0 { along_m.normalize() } else { *along_m };
        let derivative = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => direction.dot(&(twist.linear + twist.angular.cross(attachment_m))),
            (ParameterId::Attachment { target, axis }, _) if target == set_up.target => {
                direction.dot(&(scene.robot.rotation() * unit(axis)))
            }
            (ParameterId::Anchor { station, axis }, _) if station == set_up.station => {
                -direction[axis.index()]
            }
            (ParameterId::LengthOffset, _) => 1.0,
            _ => 0.0,
        };
        out[0] = derivative / relative_noise;
    }
}
