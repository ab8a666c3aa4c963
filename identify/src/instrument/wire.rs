//! A draw-wire or telescoping bar that measures one length at each pose. Lengths have heavy tails (the wire sags, catches, is
//! read late), and a zero that slipped or a joint logged with another sign puts whole runs of rows off together: rows that do
//! not belong with the rest take no part, judged anew wherever a solve has come.

use nalgebra::{DMatrix, DVector, Vector3};

use super::screened::{RejectedRow, Screened};
use super::{Apart, Instrument, Measures, Standing};
use crate::cost::{CostError, DataSet, LoopProblem, MeasuredLength, Residual};
use crate::kinematics::Joints;
use crate::model::{
    Axis, Clock, Geometry, JointState, Model, ModelError, Observation, ParameterId, PerObservation, Role,
};

/// One pose and its length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LengthRow {
    /// Joint variables of the model \[rad, m\].
    pub joints_rad: Joints,
    /// Measured length \[m\].
    pub length_m: f64,
    /// Where the controller says the flange is \[m\]; used to find rows whose parts do not belong together.
    pub flange_m: Option<[f64; 3]>,
}

/// Rows of one set-up.
#[derive(Debug, Clone)]
pub struct Wire {
    rows: Screened<LengthRow>,
    /// Of those that take part.
    observations: Vec<Observation>,
}

impl Wire {
    /// Of rows with how the robot stood at each.
    pub fn new(all: Standing<LengthRow>) -> Self {
        Self { observations: observations(&all), rows: Screened::new(all) }
    }

    /// Some of the rows.
    #[must_use]
    pub fn chosen(&self, rows: &[usize]) -> Self {
        Self::new(self.rows.all.chosen(rows))
    }

    /// The same with lengths that are longer by so much each \[m\].
    #[must_use]
    pub(crate) fn plus(&self, by_m: &[f64]) -> Self {
        let mut all = self.rows.all.clone();
        all.rows.iter_mut().zip(by_m).for_each(|(row, by_m)| row.length_m += by_m);
        Self::new(all)
    }

    /// The same with a joint that turns the other way.
    #[must_use]
    pub(crate) fn with_sign_reversed(&self, joint: usize) -> Self {
        let mut all = self.rows.all.clone();
        all.states.iter_mut().for_each(|state| state.q[joint] = -state.q[joint]);
        Self::new(all)
    }

    /// Rows that take no part.
    pub fn rejected(&self) -> &[RejectedRow] {
        &self.rows.rejected
    }

    /// Predicted minus measured length of every row, whether it takes part or not \[m\].
    pub fn residuals_m(&self, geometry: &Geometry) -> Vec<f64> {
        let wire = geometry.wire;
        let residual = |(row, state): (&LengthRow, &JointState)| {
            let root_from_flange = geometry.robot_end(state);
            let attachment =
                root_from_flange.translation.vector + root_from_flange.rotation * wire.attachment_m;
            (attachment - wire.anchor_m).norm() + wire.offset_m - row.length_m
        };
        self.rows.all.rows.iter().zip(&self.rows.all.states).map(residual).collect()
    }
}

/// What was measured at each row.
fn observations(at: &Standing<LengthRow>) -> Vec<Observation> {
    let of =
        |(index, row): (usize, &LengthRow)| Observation::length(PerObservation::time_s(index), row.length_m);
    at.rows.iter().enumerate().map(of).collect()
}

impl Measures for Wire {
    fn samples(&self) -> usize {
        self.rows.at.rows.len()
    }

    /// A first anchor, the wire attached near the flange's origin; not where the positions do not span space.
    ///
    /// `|p - c|^2 = l^2` is linear in `c` and `|c|^2 - offset terms`: `2 p.c - k = |p|^2 - l^2`.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        /// Singular values below this part of the largest mean that the positions do not span space.
        const FLATNESS: f64 = 1e-6;
        let geometry = model.geometry(&[]);
        let positions: Vec<Vector3<f64>> =
            self.rows.at.states.iter().map(|state| geometry.robot_end(state).translation.vector).collect();
        let matrix =
            DMatrix::from_fn(positions.len(), 4, |i, j| if j < 3 { 2.0 * positions[i][j] } else { -1.0 });
        let right = DVector::from_iterator(
            positions.len(),
            positions.iter().zip(&self.rows.at.rows).map(|(p, row)| p.norm_squared() - row.length_m.powi(2)),
        );
        let svd = matrix.svd(true, true);
        if svd.singular_values.min() <= FLATNESS * svd.singular_values.max() {
            return Ok(false);
        }
        let Ok(solution) = svd.solve(&right, 0.0) else { return Ok(false) };
        for axis in Axis::ALL {
            model.set_value(ParameterId::Anchor(axis), solution[axis.index()])?;
        }
        let own =
            Axis::ALL.map(ParameterId::Attachment).into_iter().chain(Axis::ALL.map(ParameterId::Anchor));
        let own = own.chain([ParameterId::LengthOffset]);
        model.set_roles(own.filter(|id| !fix.contains(id)), Role::Free)?;
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        Ok(Box::new(LoopProblem::new(model, &self.rows.at, &self.observations, MeasuredLength, sigma)?))
    }

    fn reported(&self, sample: usize, _: &Clock) -> Option<JointState> {
        self.rows.at.states.get(sample).copied()
    }

    fn identifies(&self, id: ParameterId) -> bool {
        let of_clock = matches!(id, ParameterId::ClockShift | ParameterId::ClockSkew);
        MeasuredLength::sees(id) && !of_clock
    }

    fn adapt(&mut self, _: &Model) -> Option<f64> {
        None
    }

    /// Where most rows agree with each other.
    fn screen(&mut self, model: &Model) -> bool {
        let others = self.rows.screen(&self.residuals_m(&model.geometry(&[])));
        self.observations = observations(&self.rows.at);
        others
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.rows.at.independent(count, |_| 0)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        Instrument::Wire(Self::new(self.rows.at.chosen(samples)))
    }

    fn errors(&self, geometry: &Geometry) -> Vec<Apart> {
        let apart = |residual_m: f64| Apart { position_m: residual_m.abs(), rotation_rad: None };
        self.residuals_m(geometry).into_iter().map(apart).collect()
    }
}
