//! A tip on the flange that touches flat faces. The residual is the distance of the tip from the plane of the touched face,
//! plus the reading ([`TouchedFace`]). The reading of a dial gauge is the travel of its plunger. The reading of a probe is
//! zero. The faces may have any orientation. Known distances between faces determine the scale.

use nalgebra::{DMatrix, DVector, Matrix3, SymmetricEigen, Vector3};

use super::{Artefact, FaceTable, Faces, TIP_SIGMA_M, Tip, TouchedPoses, numbers_min, tip_weight};
use crate::cost::TouchedFace;
use crate::instrument::rows::{MEDIAN_OF_ONE, Standing};
use crate::instrument::{Cause, Deviation, Mistake, ScaleFrom};
use crate::kinematics::Chain;
use crate::logs::{JointMistake, TipRow};
use crate::model::{Axis, Face, FaceNumber, Geometry, ParameterId, Role};
use crate::statistics::rms;

/// Minimum number of rows of a face. It is twice the number of unknowns of a plane, which is three.
const FACE_ROWS_MIN: usize = 6;

/// The readings determine the sign of a face's normal if the sum of squared residuals with the wrong sign is larger by this
/// factor. Readings that vary by less than a sixth of the heights do not reach it, even if they are proportional to the heights.
const WRONG_SIGN: f64 = 2.0;

/// A tip that touches faces.
pub type Touch = Tip<Faces>;

impl Touch {
    /// Creates the instrument. `rows` are in the order in which the robot visited them. `names` contains the names of the
    /// faces, and `table` the known geometry of the faces. `robot` is the nominal chain up to the flange.
    pub fn new(rows: &[TipRow], names: &[String], table: &FaceTable, robot: &Chain) -> Self {
        let all = Standing::new(rows, |row| row.joints_rad);
        let poses = all.rows.iter().zip(&all.states).map(|(row, state)| (robot.forward(&state.q), *row));
        let touches: TouchedPoses = poses.collect();
        let stated_m = table.tip_mm.map(|tip_mm| Vector3::from(tip_mm) * 1e-3);
        let tip_m =
            stated_m.or_else(|| Some(best_fit(&touches, names.len(), None)?.tip_m)).unwrap_or_default();
        // The mean position of the tip on each face, with the nominal robot. The known distances apply there, so a tip that the
        // table does not contain is fitted.
        let centre_m = |face: usize| mean(&tips_on_face(&touches, face, tip_m));
        let centre_m: Vec<Vector3<f64>> = (0..names.len()).map(centre_m).collect();
        let faces = Faces::new(table, names, &centre_m);
        Self::of_rows(all, faces)
    }
}

/// Result of a fit of tip and planes to the rows.
struct TipFit {
    tip_m: Vector3<f64>,
    planes: Vec<Face>,
    /// Root mean square residual \[m\].
    rms_m: f64,
}

/// The best fit of tip and planes. The start value of the tip is `stated_m`, the position in the table. If the table contains
/// none, several positions along the flange's axis are tried.
fn best_fit(touches: &TouchedPoses, faces: usize, stated_m: Option<Vector3<f64>>) -> Option<TipFit> {
    const STARTS_M: [f64; 5] = [0.0, 0.1, 0.2, 0.3, 0.4];
    let starts_m =
        stated_m.map_or_else(|| STARTS_M.map(|z| Vector3::new(0.0, 0.0, z)).to_vec(), |tip_m| vec![tip_m]);
    let fits = starts_m.into_iter().filter_map(|start_m| fit_tip_and_planes(touches, faces, start_m));
    fits.min_by(|a, b| a.rms_m.total_cmp(&b.rms_m))
}

/// Fits the tip and the planes of `faces` faces to poses of a robot. `start_m` is the start value of the tip.
///
/// Repeats two linear fits until both have converged. The first fits the planes with the tip fixed. The second fits the tip
/// and the distances of the planes with the normals fixed.
fn fit_tip_and_planes(touches: &TouchedPoses, faces: usize, start_m: Vector3<f64>) -> Option<TipFit> {
    const ROUNDS: usize = 60;
    let mut tip_m = start_m;
    let mut planes = Vec::new();
    for _ in 0..ROUNDS {
        planes = (0..faces).map(|face| fit_plane(touches, face, tip_m)).collect::<Option<Vec<Face>>>()?;
        // With `n` fixed, `n.(p + R t) - d + reading = 0` is linear in the tip `t` and in the distance `d` of each face. The
        // unknowns are the three coordinates of `t`, then the `d` of all faces.
        let size = 3 + faces;
        let (mut matrix, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        // The prior of the tip expects its last estimate.
        let prior_weight = tip_weight(touches.len());
        matrix.view_mut((0, 0), (3, 3)).fill_diagonal(prior_weight);
        right.rows_mut(0, 3).copy_from(&(tip_m * prior_weight));
        for (flange, row) in touches {
            let normal = planes[row.part].normal;
            let mut coefficients = DVector::zeros(size);
            coefficients.rows_mut(0, 3).copy_from(&(flange.rotation.inverse() * normal));
            coefficients[3 + row.part] = -1.0;
            let constant = normal.dot(&flange.translation.vector) + row.reading_m;
            matrix.ger(1.0, &coefficients, &coefficients, 1.0);
            right.axpy(-constant, &coefficients, 1.0);
        }
        let solution = matrix.cholesky()?.solve(&right);
        tip_m = solution.fixed_rows::<3>(0).into_owned();
        planes.iter_mut().enumerate().for_each(|(face, plane)| plane.distance_m = solution[3 + face]);
    }
    let rms_m = rms(touches.iter().map(|(flange, row)| {
        let tip_m = flange.transform_point(&tip_m.into()).coords;
        planes[row.part].normal.dot(&tip_m) - planes[row.part].distance_m + row.reading_m
    }));
    Some(TipFit { tip_m, planes, rms_m })
}

/// Positions of the tip at the touches of a face, for a tip at `tip_m` in the flange's frame.
fn tips_on_face(touches: &TouchedPoses, face: usize, tip_m: Vector3<f64>) -> Vec<Vector3<f64>> {
    let on_face = touches.iter().filter(|(_, row)| row.part == face);
    on_face.map(|(flange, _)| flange.transform_point(&tip_m.into()).coords).collect()
}

/// Mean of positions; zero if there are none.
fn mean(positions_m: &[Vector3<f64>]) -> Vector3<f64> {
    positions_m.iter().sum::<Vector3<f64>>() / positions_m.len().max(1) as f64
}

/// Fits a plane through the tip positions on a face, of which there must be at least three. The normal points outwards, so
/// that the reading decreases in its direction.
///
/// The readings only determine the sign of the normal: on a plane, the sum of height and reading is constant. If the readings
/// vary much less than the errors of the nominal robot, for example with a constant preload, both signs explain the heights
/// equally well, but the wrong sign displaces the face by twice the preload. In this case the normal points from the tip to
/// the flange, because a gauge touches a face from the outside.
fn fit_plane(touches: &TouchedPoses, face: usize, tip_m: Vector3<f64>) -> Option<Face> {
    let on_face = || touches.iter().filter(|(_, row)| row.part == face);
    let tips_m = tips_on_face(touches, face, tip_m);
    let count = tips_m.len() as f64;
    let centre_m = mean(&tips_m);
    let scatter: Matrix3<f64> =
        tips_m.iter().map(|tip| (tip - centre_m) * (tip - centre_m).transpose()).sum();
    let eigen = SymmetricEigen::try_new(scatter, f64::EPSILON, 1000)?;
    let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let mean_m = on_face().map(|(_, row)| row.reading_m).sum::<f64>() / count.max(1.0);
    let squared = |sign: f64| -> f64 {
        let height_m = |tip: &Vector3<f64>| sign * normal.dot(&(tip - centre_m));
        on_face().zip(&tips_m).map(|((_, row), tip)| (height_m(tip) + row.reading_m - mean_m).powi(2)).sum()
    };
    let [outwards, inwards] = [squared(1.0), squared(-1.0)];
    let is_inwards = if outwards.max(inwards) > WRONG_SIGN * outwards.min(inwards) {
        inwards < outwards
    } else {
        let towards_flange_m: Vector3<f64> =
            on_face().zip(&tips_m).map(|((flange, _), tip)| flange.translation.vector - tip).sum();
        normal.dot(&towards_flange_m) < 0.0
    };
    let normal = if is_inwards { -normal } else { normal };
    tips_m.len().ge(&3).then(|| Face { normal, distance_m: normal.dot(&centre_m) })
}

impl Artefact for Faces {
    type Cost<'a> = TouchedFace<'a>;
    const NAME: &'static str = "touch";
    const TIP_AND_PARTS: &'static str = "tip and faces";
    const PART: &'static str = "face";
    const ELSEWHERE: &'static str = "not on its face";
    const MEDIAN: f64 = MEDIAN_OF_ONE;
    const PART_ROWS_MIN: usize = FACE_ROWS_MIN;
    const PART_ROWS_KEPT: usize = FACE_ROWS_MIN / 2;

    fn names(&self) -> &[String] {
        &self.names
    }

    fn scale(&self) -> ScaleFrom {
        if self.has_distance() { ScaleFrom::Faces } else { ScaleFrom::Robot }
    }

    fn cost(rows: &[TipRow]) -> TouchedFace<'_> {
        TouchedFace { rows }
    }

    fn tip_m(geometry: &Geometry) -> Vector3<f64> {
        geometry.touch.tip_m
    }

    /// Distance of the tip from the plane of a face along the normal of the face, plus the reading of the gauge.
    fn deviation(geometry: &Geometry, face: usize, tip_m: Vector3<f64>, reading_m: f64) -> Deviation {
        let off_m = |face: &Face| face.normal.dot(&tip_m) - face.distance_m;
        let height_m = geometry.touch.faces.get(face).map(|face| off_m(face) / face.normal.norm());
        Deviation::of_length(height_m.unwrap_or(f64::NAN) + reading_m)
    }

    /// A plane has only three parameters, so the largest coordinate of each normal is fixed at 1 or -1.
    fn start(&self, touches: &TouchedPoses) -> Option<Vec<(ParameterId, f64, Role)>> {
        let TipFit { tip_m, planes, .. } = best_fit(touches, self.names.len(), self.tip_m)?;
        // The tip, with a weak prior.
        let expected_m = self.tip_m.unwrap_or_default();
        let coordinate = |axis: Axis| {
            let role = Role::Prior { value: expected_m[axis.index()], sigma: TIP_SIGMA_M };
            (ParameterId::Tip { axis }, tip_m[axis.index()], role)
        };
        // The faces. Each plane is divided by the largest coordinate of its normal, which is then fixed.
        let mut start = Axis::ALL.map(coordinate).to_vec();
        for (face, Face { normal, distance_m }) in planes.iter().enumerate() {
            let largest = normal.iamax();
            let scale = normal[largest].abs();
            start.extend(FaceNumber::ALL.map(|number| {
                let (value, role) = match number {
                    FaceNumber::Normal(axis) if axis.index() == largest => {
                        (normal[largest].signum(), Role::Fixed)
                    }
                    FaceNumber::Normal(axis) => (normal[axis.index()] / scale, Role::Free),
                    FaceNumber::Distance => (distance_m / scale, Role::Free),
                };
                (ParameterId::Face { face, number }, value, role)
            }));
        }
        Some(start)
    }

    /// Only the tip can change, because all faces are on one rigid body.
    fn causes() -> Vec<Cause> {
        vec![Cause::new("the tip on the flange", Axis::ALL.map(|axis| ParameterId::Tip { axis }))]
    }

    fn samples_min(&self, axes: usize) -> usize {
        numbers_min(self.names.len(), axes)
    }

    /// Wrong units of the joints cannot be revealed. In a smaller unit the arm hardly moves, and such
    /// poses are consistent with any plane.
    fn reveals(mistake: &Mistake) -> bool {
        !matches!(mistake, Mistake::Joints(JointMistake::InRadians | JointMistake::InDegrees))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};

    use super::*;
    use crate::kinematics::Pose;

    /// Twenty touches of the plane `z = 0` from above by a robot with position errors of 0.5 mm. The gauge stands below the
    /// flange. Its readings are between these two \[m\].
    fn touches(readings_m: [f64; 2], seed: u64) -> TouchedPoses {
        let mut random = StdRng::seed_from_u64(seed);
        let mut touch = || {
            let reading_m = random.random_range(readings_m[0]..readings_m[1]);
            let [x, y, error_m] = [0.2, 0.2, 5e-4].map(|half: f64| random.random_range(-half..half));
            let tip_m = Vector3::new(x, y, error_m - reading_m);
            let tilt = Rotation3::new(Vector3::new(random.random_range(-0.3..0.3), 0.0, 0.0));
            let flange_m = tip_m - tilt * Vector3::new(0.0, 0.0, -0.2);
            let row = TipRow { reading_m, ..TipRow::default() };
            (Pose::from_parts(flange_m.into(), tilt), row)
        };
        (0..20).map(|_| touch()).collect()
    }

    #[test]
    fn the_outer_side_of_a_face_is_found_with_a_constant_preload_and_with_a_long_travel() {
        for readings_m in [[0.99e-3, 1.01e-3], [0.0, 8e-3]] {
            for seed in 0..100 {
                let face = fit_plane(&touches(readings_m, seed), 0, Vector3::new(0.0, 0.0, -0.2));
                assert!(face.is_some_and(|face| face.normal.z > 0.9), "{readings_m:?}, seed {seed}");
            }
        }
    }
}
