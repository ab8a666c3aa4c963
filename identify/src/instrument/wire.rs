//! A draw-wire or telescoping bar that measures one length at each pose.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{Instrument, Measures, Standing};
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
    at: Standing<LengthRow>,
    observations: Vec<Observation>,
}

impl Wire {
    /// Of rows with how the robot stood at each.
    pub fn new(at: Standing<LengthRow>) -> Self {
        let observation = |(index, row): (usize, &LengthRow)| {
            Observation::length(PerObservation::time_s(index), row.length_m)
        };
        Self { observations: at.rows.iter().enumerate().map(observation).collect(), at }
    }

    /// Predicted minus measured length of every row \[m\].
    pub fn residuals_m(&self, geometry: &Geometry) -> Vec<f64> {
        let wire = geometry.wire;
        let residual = |(row, state): (&LengthRow, &JointState)| {
            let root_from_flange = geometry.robot_end(state);
            let attachment =
                root_from_flange.translation.vector + root_from_flange.rotation * wire.attachment_m;
            (attachment - wire.anchor_m).norm() + wire.offset_m - row.length_m
        };
        self.at.rows.iter().zip(&self.at.states).map(residual).collect()
    }
}

impl Measures for Wire {
    fn samples(&self) -> usize {
        self.at.rows.len()
    }

    /// A first anchor, the wire attached near the flange's origin; not where the positions do not span space.
    ///
    /// `|p - c|^2 = l^2` is linear in `c` and `|c|^2 - offset terms`: `2 p.c - k = |p|^2 - l^2`.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        /// Singular values below this part of the largest mean that the positions do not span space.
        const FLATNESS: f64 = 1e-6;
        let geometry = model.geometry(&[]);
        let positions: Vec<Vector3<f64>> =
            self.at.states.iter().map(|state| geometry.robot_end(state).translation.vector).collect();
        let matrix =
            DMatrix::from_fn(positions.len(), 4, |i, j| if j < 3 { 2.0 * positions[i][j] } else { -1.0 });
        let right = DVector::from_iterator(
            positions.len(),
            positions.iter().zip(&self.at.rows).map(|(p, row)| p.norm_squared() - row.length_m.powi(2)),
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
        Ok(Box::new(LoopProblem::new(model, &self.at, &self.observations, MeasuredLength, sigma)?))
    }

    fn reported(&self, sample: usize, _: &Clock) -> Option<JointState> {
        self.at.states.get(sample).copied()
    }

    fn tells(&self, id: ParameterId) -> bool {
        let of_clock = matches!(id, ParameterId::ClockShift | ParameterId::ClockSkew);
        MeasuredLength::sees(id) && !of_clock
    }

    fn adapt(&mut self, _: &Model) -> Option<f64> {
        None
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.at.independent(count)
    }

    fn thinned(&self, every: usize) -> Instrument {
        Instrument::Wire(Self::new(self.at.chosen(&self.at.every(every))))
    }
}
