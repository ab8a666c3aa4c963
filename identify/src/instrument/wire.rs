//! A draw-wire or telescoping bar that measures one length at each pose.

use nalgebra::{DMatrix, DVector, Vector3};

use super::tracker::Standing;
use super::{Instrument, Measures, standing};
use crate::calibrate::{HoldOut, split};
use crate::cost::{CostError, DataSet, LoopProblem, MeasuredLength, Residual};
use crate::kinematics::{Chain, Joints};
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
    rows: Vec<LengthRow>,
    motion: Standing,
    observations: Vec<Observation>,
    /// Group of each row: rows of one group are held out together.
    groups: Vec<usize>,
    seed: u64,
}

impl Wire {
    /// Rows with how the robot stood at each, and their groups; `seed` decides which groups come together.
    pub fn new(rows: &[LengthRow], states: &[JointState], groups: &[usize], seed: u64) -> Self {
        let observation = |(index, row): (usize, &LengthRow)| {
            Observation::length(PerObservation::time_s(index), row.length_m)
        };
        Self {
            observations: rows.iter().enumerate().map(observation).collect(),
            motion: Standing(states.to_vec()),
            rows: rows.to_vec(),
            groups: groups.to_vec(),
            seed,
        }
    }

    /// All rows of a file.
    pub fn of_file(rows: &[LengthRow], robot: &Chain, hold_out: HoldOut, seed: u64) -> Self {
        let joints = || rows.iter().map(|row| row.joints_rad);
        Self::new(rows, &standing(joints()), &hold_out.groups(robot, joints()), seed)
    }

    /// Some of the rows.
    #[must_use]
    pub fn chosen(&self, rows: &[usize]) -> Self {
        let (mut chosen, mut states, mut groups) = (Vec::new(), Vec::new(), Vec::new());
        for &row in rows {
            chosen.push(self.rows[row]);
            states.push(self.motion.0[row]);
            groups.push(self.groups[row]);
        }
        Self::new(&chosen, &states, &groups, self.seed)
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
        self.rows.iter().zip(&self.motion.0).map(residual).collect()
    }
}

impl Measures for Wire {
    fn samples(&self) -> usize {
        self.rows.len()
    }

    /// A first anchor, the wire attached near the flange's origin; not where the positions do not span space.
    ///
    /// `|p - c|^2 = l^2` is linear in `c` and `|c|^2 - offset terms`: `2 p.c - k = |p|^2 - l^2`.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        /// Singular values below this part of the largest mean that the positions do not span space.
        const FLATNESS: f64 = 1e-6;
        let geometry = model.geometry(&[]);
        let positions: Vec<Vector3<f64>> =
            self.motion.0.iter().map(|state| geometry.robot_end(state).translation.vector).collect();
        let matrix =
            DMatrix::from_fn(positions.len(), 4, |i, j| if j < 3 { 2.0 * positions[i][j] } else { -1.0 });
        let right = DVector::from_iterator(
            positions.len(),
            positions.iter().zip(&self.rows).map(|(p, row)| p.norm_squared() - row.length_m.powi(2)),
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
        Ok(Box::new(LoopProblem::new(model, &self.motion, &self.observations, MeasuredLength, sigma)?))
    }

    fn reported(&self, sample: usize, _: &Clock) -> Option<JointState> {
        self.motion.0.get(sample).copied()
    }

    fn tells(&self, id: ParameterId) -> bool {
        let of_clock = matches!(id, ParameterId::ClockShift | ParameterId::ClockSkew);
        MeasuredLength::sees(id) && !of_clock
    }

    fn adapt(&mut self, _: &Model) -> Option<f64> {
        None
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        split::all_in_folds(&self.groups, count, self.seed)
    }

    fn thinned(&self, every: usize) -> Instrument {
        Instrument::Wire(self.chosen(&(0..self.rows.len()).step_by(every).collect::<Vec<_>>()))
    }
}
