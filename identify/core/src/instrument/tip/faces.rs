//! Flat faces that a tip touches, with their known distances and angles. [`FaceTable`] is the table of the file. [`Faces`]
//! converts its entries to residuals with derivatives, which the fit uses in addition to the rows of [`super::Touch`].
//!
//! A face is represented by the plane `n.x = d`. The plane contains the centre of the tip when the tip touches
//! the face. `n` may have any length.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector, Matrix3, RowDVector, RowVector3, Vector3};
use serde::{Deserialize, Serialize};
use shared::config::{Validate, Violation};

use super::known::{Knowns, SPAN_MM_MAX, ensure_pairs_differ};
use crate::model::{Face, FaceNumber, Geometry, ParameterId, Unit};

/// Sides from which two parallel faces are touched.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Touched {
    /// Outer faces of a block. Between the faces, the centre of the tip moves by their distance plus the tip's diameter.
    #[default]
    Outside,
    /// Two walls of a gap. Between the walls, the centre moves by their distance minus the tip's diameter.
    Inside,
    /// Faces of a step, both touched from the same side. Between the faces, the centre moves by their distance.
    Step,
}

/// Known distance of two parallel faces.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spacing {
    /// Names of the two faces in the rows.
    pub between: [String; 2],
    /// Distance of the faces themselves \[mm\].
    pub distance_mm: f64,
    /// Sides from which the two faces are touched.
    #[serde(default)]
    pub touched: Touched,
    /// Standard uncertainty \[um\]. If it is absent, the uncertainty in the table applies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub u_um: Option<f64>,
}

/// Known angle between two faces.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownAngle {
    /// Names of the two faces in the rows.
    pub between: [String; 2],
    /// Angle between the planes of the faces, 0 to 90 \[deg\].
    pub angle_deg: f64,
    /// Standard uncertainty \[urad\]. If it is absent, the uncertainty in the table applies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub u_urad: Option<f64>,
}

/// Known geometry of faces, such as a datum cube, a surface plate or the walls of a fixture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaceTable {
    /// Standard uncertainty of each distance that has none of its own \[um\].
    #[serde(default = "usual_u")]
    pub u_um: f64,
    /// Standard uncertainty of each angle that has none of its own \[urad\].
    #[serde(default = "usual_u_angle")]
    pub u_urad: f64,
    /// Diameter of the tip's ball \[mm\]. Needed for faces that are touched from opposite sides.
    #[serde(default)]
    pub tip_diameter_mm: f64,
    /// Centre of the tip's ball in the flange frame, if known \[mm\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tip_mm: Option<[f64; 3]>,
    /// Known distances of parallel faces.
    #[serde(default, rename = "distance", skip_serializing_if = "Vec::is_empty")]
    pub distances: Vec<Spacing>,
    /// Known angles of planes.
    #[serde(default, rename = "angle", skip_serializing_if = "Vec::is_empty")]
    pub angles: Vec<KnownAngle>,
}

const fn usual_u() -> f64 {
    10.0
}

const fn usual_u_angle() -> f64 {
    100.0
}

impl Default for FaceTable {
    fn default() -> Self {
        Self {
            u_um: usual_u(),
            u_urad: usual_u_angle(),
            tip_diameter_mm: 0.0,
            tip_mm: None,
            distances: Vec::new(),
            angles: Vec::new(),
        }
    }
}

impl FaceTable {
    /// Names of faces that are not in `touched` but have a known distance or angle. Each name occurs once.
    pub fn untouched(&self, touched: &[String]) -> BTreeSet<&str> {
        let distances = self.distances.iter().flat_map(|one| &one.between);
        let named = distances.chain(self.angles.iter().flat_map(|one| &one.between));
        named.filter(|name| !touched.contains(name)).map(String::as_str).collect()
    }
}

impl Validate for FaceTable {
    fn validate(&self) -> Result<(), Violation> {
        let distances = self.distances.iter().enumerate();
        let angles = self.angles.iter().enumerate();
        let of_distances =
            distances.clone().map(|(i, distance)| (format!("distance[{i}].u_um"), distance.u_um));
        let of_angles = angles.clone().map(|(i, angle)| (format!("angle[{i}].u_urad"), angle.u_urad));
        let of_table = [("u_um".to_owned(), Some(self.u_um)), ("u_urad".to_owned(), Some(self.u_urad))];
        let uncertainties = of_table.into_iter().chain(of_distances).chain(of_angles);
        for (key, u) in uncertainties.filter_map(|(key, u)| Some((key, u?))) {
            let problem = format!("the uncertainty is {u}");
            Violation::unless(u.is_finite() && u > 0.0, key, problem, "give a number above zero")?;
        }
        let problem = format!("the diameter is {} mm", self.tip_diameter_mm);
        let remedy = "give that of the tip's ball in millimetres";
        let is_possible = (0.0..=SPAN_MM_MAX).contains(&self.tip_diameter_mm);
        Violation::unless(is_possible, "tip_diameter_mm", problem, remedy)?;
        for at in self.tip_mm.iter().flatten() {
            let problem = format!("a coordinate is {at} mm");
            let is_near = (-SPAN_MM_MAX..=SPAN_MM_MAX).contains(at);
            Violation::unless(is_near, "tip_mm", problem, "give three numbers in millimetres")?;
        }
        for (i, Spacing { distance_mm, touched, .. }) in distances {
            let key = format!("distance[{i}].distance_mm");
            let problem = format!("the distance is {distance_mm} mm");
            let is_possible = *distance_mm > 0.0 && *distance_mm <= SPAN_MM_MAX;
            Violation::unless(is_possible, &*key, problem, "give millimetres above zero")?;
            let problem = "the tip does not fit between these faces";
            let fits = *touched != Touched::Inside || *distance_mm > self.tip_diameter_mm;
            Violation::unless(fits, key, problem, "correct it or tip_diameter_mm")?;
        }
        for (i, KnownAngle { angle_deg, .. }) in angles {
            let (key, problem) = (format!("angle[{i}].angle_deg"), format!("the angle is {angle_deg}"));
            Violation::unless((0.0..=90.0).contains(angle_deg), key, problem, "give degrees from 0 to 90")?;
        }
        let of_distances =
            self.distances.iter().enumerate().map(|(i, distance)| ("distance", i, &distance.between));
        let of_angles = self.angles.iter().enumerate().map(|(i, angle)| ("angle", i, &angle.between));
        for (kind, i, [first, second]) in of_distances.chain(of_angles) {
            let (key, problem) = (format!("{kind}[{i}].between"), format!("both faces are `{first}`"));
            Violation::unless(first != second, key, problem, "name two different faces")?;
        }
        ensure_pairs_differ("distance", self.distances.iter().map(|distance| &distance.between))?;
        ensure_pairs_differ("angle", self.angles.iter().map(|angle| &angle.between))
    }
}

/// A known quantity of two faces.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Known {
    /// Distance between two planes \[m\]. A plane contains the centre of the tip when the tip touches the face, so the
    /// stated distance is corrected for the diameter of the tip. The estimated planes are not exactly parallel. Therefore
    /// the distance is the height of one point of the second plane above the first plane. This point is the one nearest to
    /// `at_m`, the position at which the second face is touched.
    Distance { faces: [usize; 2], distance_m: f64, sigma_m: f64, at_m: Vector3<f64> },
    /// Angle between two planes that are not parallel.
    Angle { faces: [usize; 2], angle_rad: f64, sigma_rad: f64 },
    /// Two planes that are known to be parallel.
    Parallel { faces: [usize; 2], sigma_rad: f64 },
}

/// The faces that the rows touch, with their known geometry. Faces have the same numbers as their parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Faces {
    /// Names in the rows.
    pub(super) names: Vec<String>,
    /// Centre of the tip's ball in the flange frame, if known \[m\].
    pub(super) tip_m: Option<Vector3<f64>>,
    known: Vec<Known>,
}

/// Unit normal of a face, and its derivative by the coordinates of the face's `normal`.
/// The derivative is a symmetric matrix.
fn unit_normal(face: &Face) -> (Vector3<f64>, Matrix3<f64>) {
    let length = face.normal.norm();
    let normal = face.normal / length;
    (normal, (Matrix3::identity() - normal * normal.transpose()) / length)
}

impl Faces {
    /// Creates the faces `names`, in this order, with their known geometry from the table. Entries of the
    /// table for other faces are ignored. `centre_m` contains the approximate touched position of each
    /// face, in the frame of the robot's base.
    pub fn new(table: &FaceTable, names: &[String], centre_m: &[Vector3<f64>]) -> Self {
        /// Planes with a known angle below this value are treated as parallel \[deg\]. The derivatives of so small an angle
        /// are not defined, because the direction of the inclination is unknown.
        const PARALLEL_DEG: f64 = 0.1;
        let number = |name: &String| names.iter().position(|other| other == name);
        let numbers = |between: &[String; 2]| {
            let [first, second] = between.each_ref().map(number);
            Some([first?, second?])
        };
        let distances = table.distances.iter().filter_map(|spacing| {
            let faces = numbers(&spacing.between)?;
            let by_tip_mm = match spacing.touched {
                Touched::Outside => table.tip_diameter_mm,
                Touched::Inside => -table.tip_diameter_mm,
                Touched::Step => 0.0,
            };
            let distance_m = (spacing.distance_mm + by_tip_mm) * 1e-3;
            let sigma_m = spacing.u_um.unwrap_or(table.u_um) * 1e-6;
            Some(Known::Distance { faces, distance_m, sigma_m, at_m: *centre_m.get(faces[1])? })
        });
        let angles = table.angles.iter().filter_map(|angle| {
            let faces = numbers(&angle.between)?;
            let sigma_rad = angle.u_urad.unwrap_or(table.u_urad) * 1e-6;
            Some(if angle.angle_deg < PARALLEL_DEG {
                Known::Parallel { faces, sigma_rad }
            } else {
                Known::Angle { faces, angle_rad: angle.angle_deg.to_radians(), sigma_rad }
            })
        });
        let tip_m = table.tip_mm.map(|tip_mm| Vector3::from(tip_mm) * 1e-3);
        Self { names: names.to_vec(), tip_m, known: distances.chain(angles).collect() }
    }

    /// Whether any distance is known. A known distance determines the scale of the robot.
    pub fn has_distance(&self) -> bool {
        self.known.iter().any(|known| matches!(known, Known::Distance { .. }))
    }
}

impl Knowns for Faces {
    fn knowns(&self) -> usize {
        self.known.len()
    }

    fn rows_of(&self, known: usize) -> usize {
        if matches!(self.known.get(known), Some(Known::Parallel { .. })) { 3 } else { 1 }
    }

    fn stated(&self, known: usize) -> Option<(String, f64, Unit)> {
        let (what, [first, second], sigma, unit) = match *self.known.get(known)? {
            Known::Distance { faces, sigma_m, .. } => ("distance", faces, sigma_m, Unit::Metre),
            Known::Angle { faces, sigma_rad, .. } | Known::Parallel { faces, sigma_rad } => {
                ("angle", faces, sigma_rad, Unit::Radian)
            }
        };
        let (first, second) = (self.names.get(first)?, self.names.get(second)?);
        Some((format!("the {what} between faces `{first}` and `{second}`"), sigma, unit))
    }

    fn known(&self, known: usize, geometry: &Geometry) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let faces = &geometry.touch.faces;
        // Layout of the columns: for each face the three coordinates of its normal, then its distance.
        let first_column = |face: usize| FaceNumber::ALL.len() * face;
        let columns = first_column(faces.len());
        let set = |row: &mut RowDVector<f64>, face: usize, by_normal: RowVector3<f64>, by_distance: f64| {
            row.columns_mut(first_column(face), 3).copy_from(&by_normal);
            row[first_column(face) + FaceNumber::Distance.index()] = by_distance;
        };
        match *self.known.get(known)? {
            Known::Distance { faces: [first, second], distance_m, sigma_m, at_m } => {
                let (face_1, face_2) = (faces.get(first)?, faces.get(second)?);
                // `foot_m`, the point of the second plane nearest to the touched position,
                // and its height above the first plane.
                let (length_1, squared_2) = (face_1.normal.norm(), face_2.normal.norm_squared());
                let over_2 = face_2.normal.dot(&at_m) - face_2.distance_m;
                let foot_m = at_m - face_2.normal * (over_2 / squared_2);
                let height_m = (face_1.normal.dot(&foot_m) - face_1.distance_m) / length_1;
                let (normal_1, _) = unit_normal(face_1);
                // With `x` for the touched position: d foot / d n2 = -(over_2 I + n2 x^T) / n2^2 + 2 n2 n2^T over_2 / n2^4.
                let by_normal_2 = -(normal_1 * over_2 + at_m * normal_1.dot(&face_2.normal)) / squared_2
                    + face_2.normal * (2.0 * over_2 * normal_1.dot(&face_2.normal) / squared_2.powi(2));
                let by_distance_2 = normal_1.dot(&face_2.normal) / squared_2;
                let by_normal_1 = (foot_m - normal_1 * height_m) / length_1;
                let sign = if height_m < 0.0 { -1.0 } else { 1.0 };
                let scale = sign / sigma_m;
                let mut derivative = RowDVector::zeros(columns);
                set(&mut derivative, first, by_normal_1.transpose() * scale, -scale / length_1);
                set(&mut derivative, second, by_normal_2.transpose() * scale, by_distance_2 * scale);
                let residual = (height_m.abs() - distance_m) / sigma_m;
                Some((DVector::from_element(1, residual), DMatrix::from_rows(&[derivative])))
            }
            Known::Angle { faces: [first, second], angle_rad, sigma_rad } => {
                let (normal_1, by_1) = unit_normal(faces.get(first)?);
                let (normal_2, by_2) = unit_normal(faces.get(second)?);
                let cosine = normal_1.dot(&normal_2);
                // The angle of two planes does not depend on the signs of their normals.
                let sign = if cosine < 0.0 { -1.0 } else { 1.0 };
                let estimated_rad = (sign * cosine).clamp(-1.0, 1.0).acos();
                let slope = -sign / (estimated_rad.sin().max(f64::MIN_POSITIVE) * sigma_rad);
                let mut derivative = RowDVector::zeros(columns);
                set(&mut derivative, first, (by_1 * normal_2).transpose() * slope, 0.0);
                set(&mut derivative, second, (by_2 * normal_1).transpose() * slope, 0.0);
                let residual = (estimated_rad - angle_rad) / sigma_rad;
                Some((DVector::from_element(1, residual), DMatrix::from_rows(&[derivative])))
            }
            Known::Parallel { faces: [first, second], sigma_rad } => {
                let (normal_1, by_1) = unit_normal(faces.get(first)?);
                let (normal_2, by_2) = unit_normal(faces.get(second)?);
                // At zero, the angle has no derivative, but the cross product of the normals has one.
                let cross = normal_1.cross(&normal_2) / sigma_rad;
                let mut derivative = DMatrix::zeros(3, columns);
                let by_first = -normal_2.cross_matrix() * by_1 / sigma_rad;
                derivative.view_mut((0, first_column(first)), (3, 3)).copy_from(&by_first);
                let by_second = normal_1.cross_matrix() * by_2 / sigma_rad;
                derivative.view_mut((0, first_column(second)), (3, 3)).copy_from(&by_second);
                Some((DVector::from_column_slice(cross.as_slice()), derivative))
            }
        }
    }

    /// Each face has four columns.
    fn column(&self, id: ParameterId) -> Option<usize> {
        let ParameterId::Face { face, number } = id else { return None };
        Some(FaceNumber::ALL.len() * face + number.index())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::Chain;

    /// Compares the derivatives of each known quantity with finite differences of its residual.
    #[test]
    fn what_is_known_has_its_derivatives() {
        let named = |names: &[&str]| names.iter().map(ToString::to_string).collect::<Vec<_>>();
        let pair = |one: &str, other: &str| [one.to_owned(), other.to_owned()];
        let table = FaceTable {
            distances: vec![Spacing {
                between: pair("a", "b"),
                distance_mm: 100.0,
                touched: Touched::Outside,
                u_um: None,
            }],
            angles: vec![
                KnownAngle { between: pair("a", "c"), angle_deg: 90.0, u_urad: None },
                KnownAngle { between: pair("b", "c"), angle_deg: 60.0, u_urad: None },
                KnownAngle { between: pair("a", "b"), angle_deg: 0.0, u_urad: None },
            ],
            ..FaceTable::default()
        };
        let centre_m =
            [Vector3::new(0.5, 0.1, 0.3), Vector3::new(0.4, 0.2, 0.3), Vector3::new(0.4, 0.1, 0.4)];
        let faces = Faces::new(&table, &named(&["a", "b", "c"]), &centre_m);
        let mut geometry = Geometry::new(Chain::new(crate::kinematics::Pose::identity(), Vec::new()), None);
        geometry.touch.faces = vec![
            Face { normal: Vector3::new(1.0, 0.02, -0.01), distance_m: 0.5 },
            Face { normal: Vector3::new(-1.0, 0.01, 0.03), distance_m: -0.39 },
            Face { normal: Vector3::new(0.3, -0.2, 1.0), distance_m: 0.41 },
        ];
        for known in 0..faces.knowns() {
            let (residual, derivative) = faces.known(known, &geometry).unwrap();
            assert_eq!(residual.len(), faces.rows_of(known));
            for face in 0..3 {
                for number in FaceNumber::ALL {
                    let id = ParameterId::Face { face, number };
                    let at = |by: f64| {
                        let mut moved = geometry.clone();
                        *moved.parameter_mut(id).unwrap() += by;
                        faces.known(known, &moved).unwrap().0
                    };
                    let (step, column) = (1e-6, faces.column(id).unwrap());
                    let difference = (at(step) - at(-step)) / (2.0 * step);
                    let off = (&difference - derivative.column(column)).norm();
                    assert!(off < 1e-5 * (1.0 + derivative.norm()), "{known} {id}: {off}");
                }
            }
        }
    }
}
