//! A draw-wire or telescoping bar that measures one length at each pose. Lengths have heavy tails (the wire sags, catches, is
//! read late), and a zero that slipped or a joint logged with another sign puts whole runs of rows off together: rows that do
//! not belong with the rest take no part, judged anew wherever a solve has come.

use nalgebra::{DMatrix, DVector, Vector3};

use super::row_noise::{MEDIAN_OF_ONE, RowNoise};
use super::screened::{RejectedRow, Screened};
use super::{Cause, Deviation, Instrument, Measures, Noise, ScaleFrom, Standing};
use crate::cost::{CostError, DataSet, LoopProblem, MeasuredLength, Residual};
use crate::kinematics::Joints;
use crate::logs;
use crate::model::{
    Axis, Clock, Geometry, Group, JointState, Model, ModelError, Observation, Owner, ParameterId,
    PerObservation, Role, SetUp,
};

/// One pose and its length.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LengthRow {
    /// Joint variables of the model \[rad, m\].
    pub joints_rad: Joints,
    /// Measured length \[m\].
    pub length_m: f64,
    /// Where the controller says the flange is \[m\]; used to find rows whose parts do not belong together.
    pub flange_m: Option<[f64; 3]>,
    /// Standard uncertainty of the length, where it is stated \[m\].
    pub uncertainty_m: Option<f64>,
    /// Anchor and attachment.
    pub set_up: SetUp,
}

impl From<&logs::MeasuredLength> for LengthRow {
    fn from(read: &logs::MeasuredLength) -> Self {
        let logs::MeasuredLength { q_rad, length_m, flange_m, uncertainty_m, anchor, attachment, .. } = *read;
        let set_up = SetUp { station: anchor, target: attachment };
        Self { joints_rad: q_rad, length_m, flange_m, uncertainty_m, set_up }
    }
}

/// Rows of one set-up.
#[derive(Debug, Clone)]
pub struct Wire {
    rows: Screened<LengthRow>,
    /// From the spread of the residuals and what is stated of the rows.
    noise: RowNoise,
    /// Of those that take part, with the set-up of each and its noise over that of the median one.
    observations: Vec<Observation>,
    set_ups: Vec<SetUp>,
    relative_noise: Vec<f64>,
}

impl Wire {
    /// Of rows with how the robot stood at each.
    pub fn new(all: Standing<LengthRow>) -> Self {
        Self::of(Screened::new(all), RowNoise::ALIKE)
    }

    fn of(rows: Screened<LengthRow>, noise: RowNoise) -> Self {
        let (observations, set_ups) = observations(&rows.at);
        let relative_noise = noise.relative(rows.at.rows.iter().map(|row| row.uncertainty_m));
        Self { rows, noise, observations, set_ups, relative_noise }
    }

    /// The same with rows that count as another wire has found.
    #[must_use]
    pub(crate) fn weighed_as(&self, other: &Self) -> Self {
        Self::of(self.rows.clone(), other.noise)
    }

    /// A model with the anchors and attachments of the rows.
    pub fn fitted_out(&self, model: Model) -> Model {
        let set_ups = self.rows.all.rows.iter().map(|row| row.set_up);
        model.with_set_ups(Owner::Wire, SetUp::counts(set_ups)).without_clocks()
    }

    /// Some of the rows.
    #[must_use]
    pub fn chosen(&self, rows: &[usize]) -> Self {
        Self::of(Screened::new(self.rows.all.chosen(rows)), self.noise)
    }

    /// The same with lengths that are longer by so much each \[m\].
    #[must_use]
    pub(crate) fn plus(&self, by_m: &[f64]) -> Self {
        let mut all = self.rows.all.clone();
        all.rows.iter_mut().zip(by_m).for_each(|(row, by_m)| row.length_m += by_m);
        Self::of(Screened::new(all), self.noise)
    }

    /// The same with all lengths multiplied by a factor: in another unit.
    #[must_use]
    pub(crate) fn times(&self, factor: f64) -> Self {
        let mut all = self.rows.all.clone();
        all.rows.iter_mut().for_each(|row| row.length_m *= factor);
        Self::of(Screened::new(all), self.noise)
    }

    /// What was measured at each row \[m\].
    pub(crate) fn lengths_m(&self) -> impl Iterator<Item = f64> {
        self.rows.all.rows.iter().map(|row| row.length_m)
    }

    /// The same with a joint that turns the other way.
    #[must_use]
    pub(crate) fn with_sign_reversed(&self, joint: usize) -> Self {
        let mut all = self.rows.all.clone();
        all.states.iter_mut().for_each(|state| state.q[joint] = -state.q[joint]);
        Self::of(Screened::new(all), self.noise)
    }

    /// Predicted minus measured length of every row, whether it takes part or not \[m\].
    pub fn residuals_m(&self, geometry: &Geometry) -> Vec<f64> {
        residuals_m(&self.rows.all, geometry)
    }
}

/// Predicted minus measured lengths \[m\].
fn residuals_m(at: &Standing<LengthRow>, geometry: &Geometry) -> Vec<f64> {
    let wire = &geometry.wire;
    let residual = |(row, state): (&LengthRow, &JointState)| {
        let Some((anchor_m, attachment_m)) = wire.at(row.set_up) else { return f64::NAN };
        let attachment_m = geometry.robot_end(state).transform_point(&(*attachment_m).into()).coords;
        (attachment_m - anchor_m).norm() + wire.offset_m - row.length_m
    };
    at.rows.iter().zip(&at.states).map(residual).collect()
}

/// What was measured at each row, and with which anchor and attachment.
fn observations(at: &Standing<LengthRow>) -> (Vec<Observation>, Vec<SetUp>) {
    let of = |(index, row): (usize, &LengthRow)| {
        (Observation::length(PerObservation::time_s(index), row.length_m), row.set_up)
    };
    at.rows.iter().enumerate().map(of).unzip()
}

/// A first anchor for a wire that is attached near the flange's origin, at `positions_m`; none where these do not span space.
///
/// `|p - c|^2 = l^2` is linear in `c` and `|c|^2 - offset terms`: `2 p.c - k = |p|^2 - l^2`.
fn anchor(positions_m: &[Vector3<f64>], lengths_m: &[f64]) -> Option<Vector3<f64>> {
    /// Singular values below this part of the largest mean that the positions do not span space.
    const FLATNESS: f64 = 1e-6;
    let rows = positions_m.len();
    let matrix = DMatrix::from_fn(rows, 4, |i, j| if j < 3 { 2.0 * positions_m[i][j] } else { -1.0 });
    let right = positions_m.iter().zip(lengths_m).map(|(p, length_m)| p.norm_squared() - length_m.powi(2));
    let svd = matrix.svd(true, true);
    if svd.singular_values.min() <= FLATNESS * svd.singular_values.max() {
        return None;
    }
    let solution = svd.solve(&DVector::from_iterator(rows, right), 0.0).ok()?;
    Some(Vector3::new(solution[0], solution[1], solution[2]))
}

impl Measures for Wire {
    fn name(&self) -> &'static str {
        "wire"
    }

    fn cost(&self) -> &'static str {
        MeasuredLength::NAME
    }

    fn scale(&self) -> ScaleFrom {
        ScaleFrom::Wire
    }

    fn noise(&self) -> Noise {
        Noise::Length(1.0)
    }

    fn samples(&self) -> usize {
        self.rows.at.rows.len()
    }

    /// First anchors; not where the positions of one do not span space.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        let geometry = model.geometry(&[]);
        let rows = || self.rows.at.rows.iter().zip(&self.rows.at.states);
        let mut free = vec![ParameterId::LengthOffset];
        for station in 0..geometry.wire.anchors_m.len() {
            let own = rows().filter(|(row, _)| row.set_up.station == station);
            let (positions_m, lengths_m): (Vec<Vector3<f64>>, Vec<f64>) =
                own.map(|(row, state)| (geometry.robot_end(state).translation.vector, row.length_m)).unzip();
            // Of what no row has nothing follows.
            if positions_m.is_empty() {
                continue;
            }
            let Some(anchor_m) = anchor(&positions_m, &lengths_m) else { return Ok(false) };
            for axis in Axis::ALL {
                let id = ParameterId::Anchor { station, axis };
                model.set_value(id, anchor_m[axis.index()])?;
                free.push(id);
            }
        }
        for target in 0..geometry.wire.attachments_m.len() {
            if rows().any(|(row, _)| row.set_up.target == target) {
                free.extend(Axis::ALL.map(|axis| ParameterId::Attachment { target, axis }));
            }
        }
        model.set_roles(free.into_iter().filter(|id| !fix.contains(id)), Role::Free)?;
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let residual = MeasuredLength { relative_noise: &self.relative_noise, set_ups: &self.set_ups };
        Ok(Box::new(LoopProblem::new(model, &self.rows.at, &self.observations, residual, sigma)?))
    }

    fn reported(&self, sample: usize, _: &Clock) -> Option<JointState> {
        self.rows.at.states.get(sample).copied()
    }

    fn identifies(&self, id: ParameterId) -> bool {
        MeasuredLength::depends_on(id) && id.group() != Group::Clock
    }

    /// Which row is worth more than the median one; what that is worth is left to who solves: residuals stay in metres.
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        let rows = &self.rows.at;
        if rows.rows.iter().any(|row| row.uncertainty_m.is_some()) {
            let stated = rows.rows.iter().map(|row| row.uncertainty_m);
            let errors_m = residuals_m(rows, &model.geometry(&[])).into_iter().map(f64::abs);
            let noise = RowNoise::behind(errors_m.zip(stated), MEDIAN_OF_ONE);
            *self = Self::of(self.rows.clone(), noise);
        }
        None
    }

    /// Where most rows agree with each other.
    fn screen(&mut self, model: &Model) -> bool {
        let residuals_m = self.residuals_m(&model.geometry(&[]));
        let others = self.rows.screen(&residuals_m, &self.relative_noise());
        *self = Self::of(self.rows.clone(), self.noise);
        others
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.rows.at.independent(count, |row| row.set_up.station)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        Instrument::Wire(Self::of(Screened::new(self.rows.at.chosen(samples)), self.noise))
    }

    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        self.residuals_m(geometry).into_iter().map(Deviation::of_length).collect()
    }

    fn rejected(&self) -> &[RejectedRow] {
        &self.rows.rejected
    }

    /// Whether a row takes part or not.
    fn causes(&self, Geometry { wire, .. }: &Geometry) -> Vec<Cause> {
        (0..wire.anchors_m.len()).map(Cause::Anchor).chain([Cause::LengthOffset]).collect()
    }

    fn relative_noise(&self) -> Vec<f64> {
        self.noise.relative(self.rows.all.rows.iter().map(|row| row.uncertainty_m))
    }
}
