//! A draw-wire or telescoping bar that measures one length at each pose. Lengths have heavy tails (the wire sags, catches, is
//! read late), and a zero that slipped or a joint logged with another sign puts whole runs of rows off together: rows that do
//! not belong with the rest take no part, judged anew wherever a solve has come.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{Apart, Instrument, Measures, Standing, quantile};
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

/// Why a row takes no part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rejection {
    /// Controller position and joint angles do not belong together.
    FlangeContradicts {
        /// Between the two positions \[m\].
        distance_m: f64,
    },
    /// The length is far from what all others say.
    GrossResidual {
        /// Predicted minus measured \[m\].
        residual_m: f64,
    },
    /// The rows around it are off together.
    FaultyRun {
        /// Median size of the residuals of neighbouring rows \[m\].
        median_m: f64,
    },
}

/// A row that takes no part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RejectedRow {
    /// Row from 0.
    pub row: usize,
    /// Why.
    pub why: Rejection,
}

/// Rows of one set-up.
#[derive(Debug, Clone)]
pub struct Wire {
    all: Standing<LengthRow>,
    /// Rows of `all` that do not belong with the rest, ascending.
    rejected: Vec<RejectedRow>,
    /// The others.
    at: Standing<LengthRow>,
    observations: Vec<Observation>,
}

impl Wire {
    /// Of rows with how the robot stood at each.
    pub fn new(all: Standing<LengthRow>) -> Self {
        let mut wire = Self { rejected: Vec::new(), at: all.clone(), observations: Vec::new(), all };
        wire.leave_out(Vec::new());
        wire
    }

    /// Some of the rows.
    #[must_use]
    pub fn chosen(&self, rows: &[usize]) -> Self {
        Self::new(self.all.chosen(rows))
    }

    /// The same with lengths that are longer by so much each \[m\].
    #[must_use]
    pub(crate) fn plus(&self, by_m: &[f64]) -> Self {
        let mut all = self.all.clone();
        all.rows.iter_mut().zip(by_m).for_each(|(row, by_m)| row.length_m += by_m);
        Self::new(all)
    }

    /// The same with a joint that turns the other way.
    #[must_use]
    pub(crate) fn with_sign_reversed(&self, joint: usize) -> Self {
        let mut all = self.all.clone();
        all.states.iter_mut().for_each(|state| state.q[joint] = -state.q[joint]);
        Self::new(all)
    }

    /// Rows that take no part.
    pub fn rejected(&self) -> &[RejectedRow] {
        &self.rejected
    }

    fn leave_out(&mut self, rejected: Vec<RejectedRow>) {
        let observation = |(index, row): (usize, &LengthRow)| {
            Observation::length(PerObservation::time_s(index), row.length_m)
        };
        self.at = self.all.chosen(&without(&(0..self.all.rows.len()).collect::<Vec<_>>(), &rejected));
        self.observations = self.at.rows.iter().enumerate().map(observation).collect();
        self.rejected = rejected;
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
        self.all.rows.iter().zip(&self.all.states).map(residual).collect()
    }
}

/// Rows that a fit should not see: single fitting rows with gross residuals, and every row, fitting or not, inside a run of
/// which the fitting rows are mostly off; by the residuals of all rows \[m\], on the scale of the `kept` ones.
pub(crate) fn faulty(residuals_m: &[f64], fitting: &[usize], kept: &[usize]) -> Vec<RejectedRow> {
    /// Standard deviations beyond which a single row is gross: no row of a normal distribution is, and few of a heavy tail.
    const GROSS: f64 = 8.0;
    /// And the median of neighbouring rows: what independent ones reach less than once in a million times.
    const RUN: f64 = 3.0;
    let sigma_m = robust_sigma(kept.iter().map(|&row| residuals_m[row]));
    let single = |&row: &usize| {
        let residual_m = residuals_m[row];
        let gross = residual_m.abs() > GROSS * sigma_m;
        gross.then_some(RejectedRow { row, why: Rejection::GrossResidual { residual_m } })
    };
    let in_run = |row: usize| {
        let median_m = neighbours_m(residuals_m, fitting, row);
        let faulty = median_m > RUN * sigma_m;
        faulty.then_some(RejectedRow { row, why: Rejection::FaultyRun { median_m } })
    };
    let mut found: Vec<RejectedRow> = (0..residuals_m.len()).filter_map(in_run).collect();
    let alone: Vec<usize> = without(fitting, &found);
    found.extend(alone.iter().filter_map(single));
    found.sort_by_key(|rejected| rejected.row);
    found
}

/// Standard deviation of residuals that are mostly normal, by their median size.
fn robust_sigma(residuals: impl Iterator<Item = f64>) -> f64 {
    /// Median absolute deviation from zero to standard deviation of a normal distribution.
    const SIGMA_PER_MEDIAN: f64 = 1.4826;
    // Data without any noise still need a unit.
    (SIGMA_PER_MEDIAN * median_size(residuals)).max(1e-9)
}

/// Median of the absolute values; zero of none.
pub(crate) fn median_size(values: impl Iterator<Item = f64>) -> f64 {
    let mut sizes: Vec<f64> = values.map(f64::abs).collect();
    sizes.sort_by(f64::total_cmp);
    quantile(&sizes, 0.5)
}

/// Median size of the residuals of the fitting rows just before or just after a row, whichever is larger: a run ends
/// sharply, and a row at its edge belongs to it.
fn neighbours_m(residuals_m: &[f64], fitting: &[usize], row: usize) -> f64 {
    const ROWS_EACH_SIDE: usize = 5;
    let at = fitting.partition_point(|&f| f < row);
    let before = at + usize::from(fitting.get(at) == Some(&row));
    let sides = [before.saturating_sub(ROWS_EACH_SIDE)..before, at..(at + ROWS_EACH_SIDE).min(fitting.len())];
    // A side with few rows says nothing.
    let whole = sides.into_iter().filter(|side| side.len() == ROWS_EACH_SIDE);
    whole.map(|side| median_size(fitting[side].iter().map(|&row| residuals_m[row]))).fold(0.0, f64::max)
}

/// Rows that are not rejected.
pub(crate) fn without(rows: &[usize], rejected: &[RejectedRow]) -> Vec<usize> {
    rows.iter().copied().filter(|row| rejected.binary_search_by_key(row, |one| one.row).is_err()).collect()
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

    /// Where most rows agree with each other.
    fn screen(&mut self, model: &Model) -> bool {
        let residuals_m = self.residuals_m(&model.geometry(&[]));
        let fitting: Vec<usize> = (0..residuals_m.len()).collect();
        let rejected = faulty(&residuals_m, &fitting, &without(&fitting, &self.rejected));
        let row = |one: &RejectedRow| one.row;
        let same = rejected.iter().map(row).eq(self.rejected.iter().map(row));
        if same || 2 * rejected.len() > fitting.len() {
            return false;
        }
        self.leave_out(rejected);
        true
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.at.independent(count)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        Instrument::Wire(Self::new(self.at.chosen(samples)))
    }

    fn errors(&self, geometry: &Geometry) -> Vec<Apart> {
        let apart = |residual_m: f64| Apart { position_m: residual_m.abs(), rotation_rad: None };
        self.residuals_m(geometry).into_iter().map(apart).collect()
    }
}
