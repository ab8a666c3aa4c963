//! A tip on the flange that touches flat faces. A row contains the robot's joints, the name of the face, and with a dial gauge
//! the travel of its plunger. The residual is the distance of the tip from the plane of its face ([`TouchedFace`]), where tip and
//! planes are estimated too. Faces have any orientation; known distances between them fix the scale.

use nalgebra::{DMatrix, DVector, Matrix3, SymmetricEigen, Vector3};

use super::description::nearest;
use super::rows::{MEDIAN_OF_ONE, Screened, Standing, sigma_by_median};
use super::{
    Cause, Deviation, Doubt, FaceTable, Faces, Instrument, Knowns, Measures, Mistake, Noise, RejectedRow,
    RowError, ScaleFrom, Section,
};
use crate::cost::{CostError, DataSet, LoopProblem, Residual, TouchedFace};
use crate::kinematics::{Chain, Pose};
use crate::logs::{JointMistake, TipRow};
use crate::model::{
    Axis, Clock, Face, FaceNumber, Geometry, JointState, Model, ModelError, Observation, Owner, ParameterId,
    Role, SetUp,
};

/// Fewest rows of a face: twice the three unknowns of its plane.
const FACE_ROWS_MIN: usize = 6;
/// Prior of the tip's distance from the flange \[m\]: effective only if the poses do not determine the tip.
const TIP_SIGMA_M: f64 = 1.0;

/// Rows of one set-up, and the noise of the touched distances.
#[derive(Debug, Clone)]
pub struct Touch {
    rows: Screened<TipRow>,
    table: FaceTable,
    faces: Faces,
    /// Observations of the rows in use; below, the face and reading of each.
    observations: Vec<Observation>,
    touched: Vec<(usize, f64)>,
    /// Standard deviation of a distance, estimated from the residuals \[m\].
    noise_m: f64,
}

impl Touch {
    /// From rows in the order in which the robot visited them, the names of their faces, and the table of known geometry.
    /// `robot` is the nominal chain up to the flange.
    pub fn new(rows: &[TipRow], names: &[String], table: &FaceTable, robot: &Chain) -> Self {
        let all = Standing::new(rows, |row| row.joints_rad);
        let tip_m = Vector3::from(table.tip_mm.unwrap_or_default()) * 1e-3;
        let centre_m = |face: usize| {
            let on_face = all.rows.iter().zip(&all.states).filter(|(row, _)| row.part == face);
            let place = |state: &JointState| robot.forward(&state.q).transform_point(&tip_m.into()).coords;
            let tips_m: Vec<Vector3<f64>> = on_face.map(|(_, state)| place(state)).collect();
            tips_m.iter().sum::<Vector3<f64>>() / tips_m.len().max(1) as f64
        };
        let centre_m: Vec<Vector3<f64>> = (0..names.len()).map(centre_m).collect();
        let faces = Faces::new(table, names, &centre_m);
        Self::from_parts(Screened::new(all), table.clone(), faces, TIP_SIGMA_M)
    }

    fn from_parts(rows: Screened<TipRow>, table: FaceTable, faces: Faces, noise_m: f64) -> Self {
        let mut touch = Self { rows, table, faces, observations: Vec::new(), touched: Vec::new(), noise_m };
        touch.update_observations();
        touch
    }

    /// Updates observations and faces from the rows in use.
    fn update_observations(&mut self) {
        self.observations = self.rows.at.observations();
        self.touched = self.rows.at.rows.iter().map(|row| (row.part, row.reading_m)).collect();
    }

    /// The same instrument with other rows on the same faces.
    fn with_rows(&self, all: Standing<TipRow>) -> Self {
        Self::from_parts(Screened::new(all), self.table.clone(), self.faces.clone(), self.noise_m)
    }

    /// Distance of the tip from the plane of a face, along its normal, plus the reading \[m\].
    fn residual_m(geometry: &Geometry, row: &TipRow, state: &JointState, face: usize) -> f64 {
        let touch = &geometry.touch;
        let Some(Face { normal, distance_m }) = touch.faces.get(face) else { return f64::NAN };
        let tip_m = geometry.robot_end(state).transform_point(&touch.tip_m.into()).coords;
        (normal.dot(&tip_m) - distance_m) / normal.norm() + row.reading_m
    }

    /// Residual of every row to its own face, in use or not \[m\].
    fn residuals_m(&self, geometry: &Geometry) -> Vec<f64> {
        let all = &self.rows.all;
        let touches = all.rows.iter().zip(&all.states);
        touches.map(|(row, state)| Self::residual_m(geometry, row, state, row.part)).collect()
    }
}

/// Pose of the flange at each row, with the row.
type Touches = Vec<(Pose, TipRow)>;

/// Tip and planes that fit the rows.
struct Placed {
    tip_m: Vector3<f64>,
    planes: Vec<Face>,
    /// Root mean square residual \[m\].
    rms_m: f64,
}

/// Fits tip and planes of `faces` faces to poses of a robot, from a start value of the tip.
///
/// Alternates two linear steps, often enough to converge: planes for a known tip by least squares, then the tip for known normals.
fn fit_tip_and_planes(touches: &Touches, faces: usize, start_m: Vector3<f64>) -> Option<Placed> {
    const ROUNDS: usize = 60;
    /// Error of a distance that gives the weight of the tip's prior about its last value: effective only if the poses do not
    /// determine the tip \[m\].
    const ERROR_M: f64 = 1e-3;
    let mut tip_m = start_m;
    let mut planes = Vec::new();
    for _ in 0..ROUNDS {
        planes = (0..faces).map(|face| fit_plane(touches, face, tip_m)).collect::<Option<Vec<Face>>>()?;
        // `n.(p + R t) - d + reading = 0`, linear in the tip `t` and in the `d` of all faces.
        let size = 3 + faces;
        let (mut matrix, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        let prior_weight = touches.len() as f64 * (ERROR_M / TIP_SIGMA_M).powi(2);
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
    let squared = touches.iter().map(|(flange, row)| {
        let tip_m = flange.transform_point(&tip_m.into()).coords;
        (planes[row.part].normal.dot(&tip_m) - planes[row.part].distance_m + row.reading_m).powi(2)
    });
    let rms_m = (squared.sum::<f64>() / touches.len().max(1) as f64).sqrt();
    Some(Placed { tip_m, planes, rms_m })
}

/// Plane through the tips of a face, at least three; its normal points to decreasing travel of a gauge's plunger.
fn fit_plane(touches: &Touches, face: usize, tip_m: Vector3<f64>) -> Option<Face> {
    let on_face = || touches.iter().filter(|(_, row)| row.part == face);
    let tips_m: Vec<Vector3<f64>> =
        on_face().map(|(flange, _)| flange.transform_point(&tip_m.into()).coords).collect();
    let count = tips_m.len() as f64;
    let centre_m = tips_m.iter().sum::<Vector3<f64>>() / count.max(1.0);
    let scatter: Matrix3<f64> =
        tips_m.iter().map(|tip| (tip - centre_m) * (tip - centre_m).transpose()).sum();
    let eigen = SymmetricEigen::try_new(scatter, f64::EPSILON, 1000)?;
    let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let mean_m = on_face().map(|(_, row)| row.reading_m).sum::<f64>() / count.max(1.0);
    // Covariance of height and reading, whose sum is constant on a plane.
    let covariance: f64 = on_face()
        .zip(&tips_m)
        .map(|((_, row), tip)| normal.dot(&(tip - centre_m)) * (row.reading_m - mean_m))
        .sum();
    let normal = if covariance > 0.0 { -normal } else { normal };
    tips_m.len().ge(&3).then(|| Face { normal, distance_m: normal.dot(&centre_m) })
}

impl Measures for Touch {
    fn name(&self) -> &'static str {
        "touch"
    }

    fn cost(&self) -> &'static str {
        TouchedFace::NAME
    }

    fn doubts(&self, geometry: &Geometry) -> Vec<Doubt> {
        let contradicted = self.faces.contradicted(geometry);
        if contradicted.is_empty() { Vec::new() } else { vec![Doubt::OtherTable(contradicted)] }
    }

    fn scale(&self) -> ScaleFrom {
        if self.faces.has_distance() { ScaleFrom::Faces } else { ScaleFrom::Robot }
    }

    fn noise(&self) -> Noise {
        Noise::Length(self.noise_m)
    }

    fn samples(&self) -> usize {
        self.rows.at.rows.len()
    }

    fn parts(&self) -> &'static str {
        "tip and faces"
    }

    /// A section for each face.
    fn sections(&self) -> Vec<Section> {
        Section::each(self.faces.names(), "face", self.rows.all.rows.iter().map(|row| row.part))
    }

    /// Names the face that is nearest to the tip.
    fn remarks(&self, geometry: &Geometry) -> Vec<(usize, String)> {
        let (names, all) = (self.faces.names(), &self.rows.all);
        let remark = |rejected: &RejectedRow| {
            let (row, state) = (all.rows.get(rejected.row)?, all.states.get(rejected.row)?);
            let other = nearest(names, row.part, |face| Self::residual_m(geometry, row, state, face).abs());
            Some((rejected.row, format!("not on its face `{}`{other}", names[row.part])))
        };
        self.rows.rejected.iter().filter_map(remark).collect()
    }

    /// Adds the touched faces.
    fn fitted_out(&self, robot: Model) -> Model {
        robot.with_faces(self.faces.names().len()).without_clocks()
    }

    /// Start values from the tip in the table, or from the best of several tips along the flange's axis. The largest coordinate of
    /// each normal is fixed at 1 or -1, because a plane has three parameters.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        const STARTS_M: [f64; 5] = [0.0, 0.1, 0.2, 0.3, 0.4];
        let geometry = model.geometry(&[]);
        let used = &self.rows.at;
        let used = used.states.iter().zip(&used.rows);
        let touches: Touches = used.map(|(state, row)| (geometry.robot_end(state), *row)).collect();
        let stated_m = self.table.tip_mm.map(|tip_mm| Vector3::from(tip_mm) * 1e-3);
        let starts_m =
            stated_m.map_or_else(|| STARTS_M.map(|z| Vector3::new(0.0, 0.0, z)).to_vec(), |tip| vec![tip]);
        let faces = self.faces.names().len();
        let fits = starts_m.into_iter().filter_map(|start_m| fit_tip_and_planes(&touches, faces, start_m));
        let best = fits.min_by(|a, b| a.rms_m.total_cmp(&b.rms_m));
        let Some(Placed { tip_m, planes, .. }) = best else { return Ok(false) };
        let expected_m = stated_m.unwrap_or_default();
        let mut set = |id: ParameterId, value: f64, role: Role| {
            if fix.contains(&id) {
                return Ok(());
            }
            model.set_value(id, value)?;
            model.set_role(id, role)
        };
        for axis in Axis::ALL {
            let role = Role::Prior { value: expected_m[axis.index()], sigma: TIP_SIGMA_M };
            set(ParameterId::Tip { axis }, tip_m[axis.index()], role)?;
        }
        for (face, Face { normal, distance_m }) in planes.iter().enumerate() {
            let largest = normal.iamax();
            let scale = normal[largest].abs();
            for number in FaceNumber::ALL {
                let (value, role) = match number {
                    FaceNumber::Normal(axis) if axis.index() == largest => {
                        (normal[largest].signum(), Role::Fixed)
                    }
                    FaceNumber::Normal(axis) => (normal[axis.index()] / scale, Role::Free),
                    FaceNumber::Distance => (distance_m / scale, Role::Free),
                };
                set(ParameterId::Face { face, number }, value, role)?;
            }
        }
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let Self { rows, observations, touched, faces, noise_m, .. } = self;
        let residual = TouchedFace { touched };
        let problem = LoopProblem::new(model, &rows.at, observations, residual, sigma * noise_m)?;
        Ok(Box::new(problem.with_knowns(faces)))
    }

    fn reported(&self, sample: usize, _: &Clock) -> Option<JointState> {
        self.rows.at.states.get(sample).copied()
    }

    /// The tip alone: all faces are on one rigid body.
    fn causes(&self, _: &Geometry) -> Vec<Cause> {
        vec![Cause::Tip]
    }

    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool {
        TouchedFace::depends_on(id, robot) && id.owner() != Owner::Clocks
    }

    /// Standard deviation, from the median of mostly normal residuals.
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        let residuals_m = self.residuals_m(&model.geometry(&[]));
        self.noise_m = sigma_by_median(residuals_m.into_iter(), MEDIAN_OF_ONE);
        Some(self.noise_m)
    }

    /// Leaves rows out if most rows agree with each other and each face keeps enough.
    fn screen(&mut self, model: &Model) -> bool {
        let residuals_m = self.residuals_m(&model.geometry(&[]));
        let faces = self.faces.names().len();
        let cover_all_faces = |rows: &[TipRow]| {
            let rows_of = |face: usize| rows.iter().filter(|row| row.part == face).count();
            (0..faces).all(|face| rows_of(face) >= FACE_ROWS_MIN / 2)
        };
        let changed = self.rows.screen(&residuals_m, &vec![1.0; residuals_m.len()], cover_all_faces);
        self.update_observations();
        changed
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.rows.at.independent(count, |row| row.part)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        self.with_rows(self.rows.at.chosen(samples)).into()
    }

    fn group(&mut self, groups: &[usize], seed: u64) {
        self.rows.group(groups, seed);
    }

    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        self.residuals_m(geometry).into_iter().map(Deviation::of_length).collect()
    }

    fn rejected(&self) -> &[RejectedRow] {
        &self.rows.rejected
    }

    /// Twice the number of unknowns of tip, faces and links.
    fn samples_min(&self) -> usize {
        const NUMBERS_OF_LINK: usize = 4;
        let axes = self.rows.all.states.first().map_or(0, |state| state.q.len());
        2 * (3 * (1 + self.faces.names().len()) + NUMBERS_OF_LINK * axes)
    }

    fn contradicting(&self, _: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        self.rows.all.ensure_finite(|row| [row.reading_m].into_iter())?;
        let face = |row: &TipRow| SetUp { station: row.part, target: 0 };
        self.rows.all.ensure_each_has_rows(face, [("face", FACE_ROWS_MIN), ("tip", 0)])?;
        Ok(Vec::new())
    }

    /// Rows with the tip on another face than stated, which no model can predict.
    fn misplaced(&self, model: &Model) -> Vec<RejectedRow> {
        let mut screened = self.clone();
        screened.screen(model);
        screened.rows.rejected
    }

    fn judges_gross(&self) -> bool {
        true
    }

    /// Without wrong units of the joints: an arm that hardly moves is consistent with any plane.
    fn mistakes(&self, axes: usize) -> Vec<Mistake> {
        let is_of_unit = |mistake: &Mistake| {
            matches!(mistake, Mistake::Joints(JointMistake::InRadians | JointMistake::InDegrees))
        };
        let of_joints = Mistake::of_joints(axes).into_iter().filter(|mistake| !is_of_unit(mistake));
        of_joints.chain([Mistake::ModifiedTable]).collect()
    }

    fn undone(&self, mistake: Mistake) -> Vec<Instrument> {
        let Mistake::Joints(mistake) = mistake else { return Vec::new() };
        let other = self.rows.all.with_joints(|joints_rad| mistake.undone(joints_rad));
        vec![self.with_rows(other).into()]
    }
}
