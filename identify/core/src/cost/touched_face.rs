//! Cost for a tip on the flange that touches a flat face. Each sample consists of the robot's joints, the index of the face
//! and, with a gauge, the displacement of the gauge's plunger.

use nalgebra::Vector3;

use super::{Movement, Residual, Scene};
use crate::logs::TipRow;
use crate::model::{FaceNumber, Owner, ParameterId};

/// The residual is `h + reading` \[m\]. `h = (n.x - d) / |n|` is the height of the tip's centre `x = R_p + R tip` over the
/// plane `n.x = d` in the robot's base. This plane is the face, displaced by the tip's radius along `n`, which points away
/// from the material. The problem divides the residual by the standard deviation of a distance.
#[derive(Debug, Clone, Copy)]
pub struct TouchedFace<'a> {
    /// Each sample with its face and reading.
    pub rows: &'a [TipRow],
}

/// The tip relative to a face.
#[derive(Debug, Clone, Copy)]
pub struct OverFace {
    face: usize,
    reading_m: f64,
    /// Unit normal `n / |n|`, and below it the length `|n|`.
    unit_normal: Vector3<f64>,
    normal_length: f64,
    /// Vector from the flange to the tip, in the robot's base \[m\].
    flange_to_tip_m: Vector3<f64>,
    /// Position `x` of the tip's centre in the robot's base \[m\].
    tip_m: Vector3<f64>,
    /// Height `h` of the tip over the face \[m\].
    height_m: f64,
}

impl Residual for TouchedFace<'_> {
    type Local = OverFace;

    const NAME: &'static str = "touched_face";
    const ROWS: usize = 1;
    const OWNER: Owner = Owner::Touch;

    fn local(&self, scene: &Scene<'_>) -> Option<OverFace> {
        let TipRow { part: face, reading_m, .. } = *self.rows.get(scene.sample)?;
        let plane = scene.geometry.touch.faces.get(face)?;
        let flange_to_tip_m = scene.robot.rotation() * scene.geometry.touch.tip_m;
        let tip_m = scene.robot.position_m() + flange_to_tip_m;
        let normal_length = plane.normal.norm();
        let unit_normal = plane.normal / normal_length;
        let height_m = (plane.normal.dot(&tip_m) - plane.distance_m) / normal_length;
        Some(OverFace { face, reading_m, unit_normal, normal_length, flange_to_tip_m, tip_m, height_m })
    }

    fn residual(&self, _: &Scene<'_>, touched: &OverFace, out: &mut [f64]) {
        out[0] = touched.height_m + touched.reading_m;
    }

    fn derivative(&self, scene: &Scene<'_>, touched: &OverFace, id: ParameterId, out: &mut [f64]) {
        let OverFace { unit_normal, normal_length, flange_to_tip_m, tip_m, height_m, .. } = touched;
        out[0] = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => unit_normal.dot(&twist.carried(flange_to_tip_m).linear),
            (ParameterId::Tip { axis }, _) => unit_normal.dot(&(scene.robot.rotation() * axis.unit())),
            (ParameterId::Face { face, number }, _) if face == touched.face => match number {
                FaceNumber::Normal(axis) => {
                    (tip_m[axis.index()] - height_m * unit_normal[axis.index()]) / normal_length
                }
                FaceNumber::Distance => -normal_length.recip(),
            },
            _ => 0.0,
        };
    }
}
