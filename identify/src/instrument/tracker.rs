//! A tracker that measures the position or the whole pose of a probe on the flange, row by row.

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, SVector, Vector3};

use super::{Instrument, Measures, Standing};
use crate::cost::{CostError, DataSet, LoopProblem, MeasuredPose, MeasuredPosition, PoseNoise, Residual};
use crate::kinematics::{Joints, Pose, rotation_vector};
use crate::logs;
use crate::model::{
    Axis, Clock, Geometry, JointState, Model, ModelError, Observation, ParameterId, PerObservation,
    Placement, Role,
};

/// A pose of the robot and what the tracker measured there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseRow {
    /// Joint variables of the model \[rad, m\].
    pub joints_rad: Joints,
    /// Of the probe, in the tracker's frame \[m\].
    pub position_m: Vector3<f64>,
    /// `tracker_from_probe`; used where every row has it.
    pub rotation: Option<Rotation3<f64>>,
}

impl From<&logs::MeasuredPose> for PoseRow {
    fn from(read: &logs::MeasuredPose) -> Self {
        Self { joints_rad: read.q_rad, position_m: read.position_m, rotation: read.rotation }
    }
}

/// How far what the robot says is from what was measured: between where it holds the probe and where the tracker sees it, or
/// of two lengths.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Apart {
    /// \[m\]
    pub position_m: f64,
    /// Angle \[rad\]; none where only positions were measured.
    pub rotation_rad: Option<f64>,
}

/// Median of the norm of three standard normal numbers.
pub(super) const MEDIAN_OF_THREE: f64 = 1.538;
/// The probe is expected within this of the flange \[m\]: decides only where the poses do not determine it.
const PROBE_SIGMA_M: f64 = 1.0;

/// Rows of one set-up.
#[derive(Debug, Clone)]
pub struct Tracker {
    at: Standing<PoseRow>,
    observations: Vec<Observation>,
    positions_m: Vec<Vector3<f64>>,
    poses: Option<Vec<Pose>>,
    /// What a measurement is worth, from the spread of the residuals.
    pub noise: PoseNoise,
}

impl Tracker {
    /// Of rows with how the robot stood at each.
    pub fn new(at: Standing<PoseRow>) -> Self {
        let pose = |row: &PoseRow| Some(Pose::from_parts(row.position_m.into(), row.rotation?));
        let observation = |row| Observation::bar(PerObservation::time_s(row), Default::default());
        Self {
            observations: (0..at.rows.len()).map(observation).collect(),
            positions_m: at.rows.iter().map(|row| row.position_m).collect(),
            poses: at.rows.iter().map(pose).collect(),
            noise: PoseNoise { position_m: 1.0, rotation_rad: 1.0 },
            at,
        }
    }

    /// Some of the rows.
    #[must_use]
    pub fn chosen(&self, rows: &[usize]) -> Self {
        Self { noise: self.noise, ..Self::new(self.at.chosen(rows)) }
    }

    /// Where the robot holds the probe minus where it was seen, at each row, along the root's axes \[m\].
    pub fn errors_m(&self, geometry: &Geometry) -> Vec<Vector3<f64>> {
        let (place, probe) = (geometry.tracker.place.pose(), geometry.tracker.probe.pose());
        let one = |(row, state): (&PoseRow, &JointState)| {
            let held_m = (geometry.robot_end(state) * probe).translation.vector;
            held_m - place.transform_point(&row.position_m.into()).coords
        };
        self.at.rows.iter().zip(&self.at.states).map(one).collect()
    }

    /// Name of the cost: positions alone or whole poses.
    pub fn cost(&self) -> &'static str {
        if self.poses.is_some() { MeasuredPose::NAME } else { MeasuredPosition::NAME }
    }

    /// Robot and tracker apart, in every row.
    pub fn apart(&self, geometry: &Geometry) -> Vec<Apart> {
        let (place, probe) = (geometry.tracker.place.pose(), geometry.tracker.probe.pose());
        let one = |(row, state): (&PoseRow, &JointState)| {
            let held = geometry.robot_end(state) * probe;
            let seen_m = place.transform_point(&row.position_m.into()).coords;
            let angle = |rotation: Rotation3<f64>| {
                rotation_vector((held.rotation.inverse() * place.rotation * rotation).matrix()).norm()
            };
            Apart {
                position_m: (held.translation.vector - seen_m).norm(),
                rotation_rad: row.rotation.map(angle),
            }
        };
        self.at.rows.iter().zip(&self.at.states).map(one).collect()
    }

    fn boxed<'a, R: Residual + 'a>(
        &'a self,
        model: &'a Model,
        residual: R,
        sigma: f64,
    ) -> Result<Box<dyn DataSet + 'a>, CostError> {
        Ok(Box::new(LoopProblem::new(model, &self.at, &self.observations, residual, sigma)?))
    }
}

impl Measures for Tracker {
    fn samples(&self) -> usize {
        self.at.rows.len()
    }

    /// Not where the positions lie on a line.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        let geometry = model.geometry(&[]);
        let flanges: Vec<Pose> = self.at.states.iter().map(|state| geometry.robot_end(state)).collect();
        let Some([place, probe]) = placements(&flanges, &self.at.rows) else { return Ok(false) };
        for axis in Axis::ALL {
            for (id, value) in [
                (ParameterId::Tracker(axis), place.position_m),
                (ParameterId::TrackerRotation(axis), place.rotation_rad),
                (ParameterId::Probe(axis), probe.position_m),
                (ParameterId::ProbeRotation(axis), probe.rotation_rad),
            ] {
                let role = match id {
                    id if fix.contains(&id) => Role::Fixed,
                    ParameterId::Probe(_) => Role::Prior { value: 0.0, sigma: PROBE_SIGMA_M },
                    // Positions alone do not determine how the probe is turned.
                    ParameterId::ProbeRotation(_) if self.poses.is_none() => Role::Fixed,
                    _ => Role::Free,
                };
                if role != Role::Fixed {
                    model.set_value(id, value[axis.index()])?;
                }
                model.set_role(id, role)?;
            }
        }
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        match &self.poses {
            Some(measured) => self.boxed(model, MeasuredPose { measured, noise: self.noise }, sigma),
            None => {
                let residual = MeasuredPosition { measured_m: &self.positions_m };
                self.boxed(model, residual, sigma * self.noise.position_m)
            }
        }
    }

    fn reported(&self, sample: usize, _: &Clock) -> Option<JointState> {
        self.at.states.get(sample).copied()
    }

    fn identifies(&self, id: ParameterId) -> bool {
        let of_clock = matches!(id, ParameterId::ClockShift | ParameterId::ClockSkew);
        let sees = if self.poses.is_some() { MeasuredPose::sees(id) } else { MeasuredPosition::sees(id) };
        sees && !of_clock
    }

    /// Standard deviations of a coordinate and of an angle that are behind errors which are mostly normal, by their medians.
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        /// Data without any noise still need a unit.
        const LEAST: f64 = 1e-9;
        let errors = self.apart(&model.geometry(&[]));
        let median = |of: fn(&Apart) -> f64| {
            let mut sizes: Vec<f64> = errors.iter().map(of).collect();
            sizes.sort_by(f64::total_cmp);
            (quantile(&sizes, 0.5) / MEDIAN_OF_THREE).max(LEAST)
        };
        self.noise = PoseNoise {
            position_m: median(|error| error.position_m),
            rotation_rad: median(|error| error.rotation_rad.unwrap_or(0.0)),
        };
        Some(self.noise.position_m)
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.at.independent(count, |_| 0)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        Instrument::Tracker(self.chosen(samples))
    }

    fn errors(&self, geometry: &Geometry) -> Vec<Apart> {
        self.apart(geometry)
    }
}

/// Quantile of sorted numbers, linear between them; zero of none.
pub(crate) fn quantile(sorted: &[f64], part: f64) -> f64 {
    let place = part * sorted.len().saturating_sub(1) as f64;
    let at = |index: usize| sorted.get(index).copied().unwrap_or(0.0);
    let below = place.floor();
    at(below as usize) + (place - below) * (at(place.ceil() as usize) - at(below as usize))
}

/// Rounds of the alternation; each at least halves what is left of the error.
const ROUNDS: usize = 60;
/// Positions that spread less than this part of their largest spread along the second axis lie on a line.
const FLATNESS: f64 = 1e-6;

/// Where tracker and probe are if the robot is as `flanges` says, without a first guess.
///
/// `T s_k = p_k + R_k y`, alternating: for a known probe `y` the tracker's place `T` is the rigid motion between two
/// clouds of points (Umeyama 1991), for a known `T` the probe is linear. It needs no turns between the poses, where
/// closed forms for `A X = Z B` need turns about two axes; the probe's rotation is the mean of what each pose says.
fn placements(flanges: &[Pose], rows: &[PoseRow]) -> Option<[Placement; 2]> {
    let mut place = Pose::identity();
    let mut probe_m = Vector3::zeros();
    for _ in 0..ROUNDS {
        let held: Vec<Vector3<f64>> =
            flanges.iter().map(|flange| flange.translation.vector + flange.rotation * probe_m).collect();
        let seen: Vec<Vector3<f64>> = rows.iter().map(|row| row.position_m).collect();
        place.rotation = rotation_between(&seen, &held)?;
        let (position_m, offset_m) = positions(flanges, rows, &place.rotation);
        place.translation = position_m.into();
        probe_m = offset_m;
    }
    let turns = rows.iter().zip(flanges).filter_map(|(row, flange)| {
        Some(*(flange.rotation.inverse() * place.rotation * row.rotation?).matrix())
    });
    let probe = Pose::from_parts(probe_m.into(), nearest_rotation(&turns.sum()));
    Some([Placement::of(&place), Placement::of(&probe)])
}

fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64
}

/// The rotation that takes one cloud onto the other.
fn rotation_between(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Rotation3<f64>> {
    let (from_mean, to_mean) = (mean(from), mean(to));
    let products = from.iter().zip(to).map(|(a, b)| (b - to_mean) * (a - from_mean).transpose());
    let sum: Matrix3<f64> = products.sum();
    let spread = sum.singular_values();
    if spread[1] <= FLATNESS * spread[0] {
        return None;
    }
    Some(nearest_rotation(&sum))
}

/// The rotation nearest to a matrix; identity for one that points nowhere.
pub(super) fn nearest_rotation(matrix: &Matrix3<f64>) -> Rotation3<f64> {
    let svd = matrix.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Rotation3::identity() };
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    Rotation3::from_matrix_unchecked(u * flip * v_t)
}

/// Place of the tracker and of the probe for a known rotation of the tracker: linear.
fn positions(flanges: &[Pose], rows: &[PoseRow], rotation: &Rotation3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let mut normal = DMatrix::<f64>::zeros(6, 6);
    let mut right = DVector::<f64>::zeros(6);
    let weak = flanges.len() as f64 * (1e-3 / PROBE_SIGMA_M).powi(2);
    for axis in 3..6 {
        normal[(axis, axis)] = weak;
    }
    for (flange, row) in flanges.iter().zip(rows) {
        let apart = flange.translation.vector - rotation * row.position_m;
        for i in 0..3 {
            let turned = flange.rotation.matrix().row(i).transpose();
            let unit = Vector3::ith(i, 1.0);
            let line = SVector::<f64, 6>::from_iterator(unit.iter().chain((-turned).iter()).copied());
            normal += line * line.transpose();
            right += line * apart[i];
        }
    }
    let solved = normal.cholesky().map(|factor| factor.solve(&right));
    let at = |i: usize| solved.as_ref().map_or(0.0, |x| x[i]);
    (Vector3::new(at(0), at(1), at(2)), Vector3::new(at(3), at(4), at(5)))
}
