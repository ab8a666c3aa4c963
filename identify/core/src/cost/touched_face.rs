//! A tip on the flange that touches a flat face: each sample consists of the robot's joints, the number of the face and, with a
//! gauge, the displacement of its plunger.

use nalgebra::Vector3;

use super::scene::unit;
use super::{Movement, Residual, Scene};
use crate::model::{FaceNumber, Owner, ParameterId};

/// `(n.(p + R tip) - d) / |n| + reading` \[m\]: the face is the plane `n.x = d` in the robot's base, `n` points away from the
/// material, `p` and `R` are the robot's pose. Divide by the standard deviation of a distance.
#[derive(Debug, Clone, Copy)]
pub struct TouchedFace<'a> {
    /// Face of each sample (from 0), and the displacement of the gauge's plunger \[m\], positive inwards.
    pub touched: &'a [(usize, f64)],
}

/// The tip relative to a face.
#[derive(Debug, Clone, Copy)]
pub struct OverFace {
    face: usize,
    reading_m: f64,
    normal: Vector3<f64>,
    length: f64,
    /// `stem_m`: vector from the flange to the tip, in the robot's base; `tip_m`: position of the tip \[m\].
    stem_m: Vector3<f64>,
    tip_m: Vector3<f64>,
    /// Distance of the tip from the face, along the normal \[m\].
    height_m: f64,
}

impl Residual for TouchedFace<'_> {
    type Local = OverFace;

    const NAME: &'static str = "touched_face";
    const ROWS: usize = 1;
    const ENCODERS: &'static [usize] = &[];

    fn depends_on(id: ParameterId) -> bool {
        id.affects(Owner::Touch)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<OverFace> {
        let (face, reading_m) = *self.touched.get(scene.sample)?;
        let of = scene.geometry.touch.faces.get(face)?;
        let stem_m = scene.robot.rotation() * scene.geometry.touch.tip_m;
        let (normal, tip_m) = (of.normal, scene.robot.position_m() + stem_m);
        let length = normal.norm();
        let height_m = (normal.dot(&tip_m) - of.distance_m) / length;
        Some(OverFace { face, reading_m, normal: normal / length, length, stem_m, tip_m, height_m })
    }

    fn residual(&self, _: &Scene<'_>, over: &OverFace, out: &mut [f64]) {
        out[0] = over.height_m + over.reading_m;
    }

    fn derivative(&self, scene: &Scene<'_>, over: &OverFace, id: ParameterId, out: &mut [f64]) {
        let OverFace { normal, length, stem_m, tip_m, height_m, .. } = over;
        out[0] = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => normal.dot(&(twist.linear + twist.angular.cross(stem_m))),
            (ParameterId::Tip { axis }, _) => normal.dot(&(scene.robot.rotation() * unit(axis))),
            (ParameterId::Face { face, number }, _) if face == over.face => match number {
                FaceNumber::Normal(axis) => (tip_m[axis.index()] - height_m * normal[axis.index()]) / length,
                FaceNumber::Distance => -length.recip(),
            },
            _ => 0.0,
        };
    }
}
