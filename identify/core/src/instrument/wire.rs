//! A draw-wire or telescoping bar that measures one length at each pose, from an anchor to an attachment on the flange. The
//! residual is `(1 + scale) |attachment - anchor| + offset - length` ([`MeasuredLength`]). In addition to the robot, the fit
//! estimates anchor, attachment, offset and scale.
//!
//! The errors of lengths have heavy tails, because the wire sags, sticks or is read too late. A step of the offset, or a
//! joint that was logged with the wrong sign, changes the residuals of whole runs of rows. Rows that contradict the other
//! rows are excluded. After each solve, the excluded rows are determined again.

use nalgebra::{DMatrix, DVector, Vector3};

use super::cause::numbered;
use super::rows::{MEDIAN_OF_ONE, RowNoise, Screened, Standing};
use super::{
    Cause, Deviation, Instrument, Measures, Mistake, Noise, RejectedRow, Rejection, RowError, ScaleFrom,
    set_scale_prior,
};
use crate::cost::{CostError, DataSet, LoopProblem, MeasuredLength, Residual};
use crate::kinematics::Chain;
use crate::logs::LengthRow;
use crate::model::{
    Axis, ClockRelation, Geometry, Group, JointState, Model, ModelError, Owner, ParameterId, Role, SetUp,
};
use crate::statistics::median_size;

/// Minimum number of rows of a fit. It is twice the number of unknowns of the wire, which is seven.
const ROWS_MIN: usize = 14;
/// Minimum number of rows of each anchor, if there is more than one. The equations for the start value of an anchor have
/// four unknowns, and some rows are held out.
const ANCHOR_ROWS_MIN: usize = 8;
/// Minimum number of rows of each attachment, if there is more than one. It is twice the number
/// of its coordinates, which is three.
const ATTACHMENT_ROWS_MIN: usize = 6;

/// Rows of one file, and the noise of their lengths.
#[derive(Debug, Clone)]
pub struct Wire {
    rows: Screened<LengthRow>,
    /// Noise of the rows, estimated from the residuals and the stated uncertainties.
    noise: RowNoise,
    /// Standard uncertainty of the scale \[ppm\]; zero means exact.
    scale_u_ppm: f64,
}

impl Wire {
    /// Creates the instrument for a robot that stood still at each row. `rows` are in the
    /// order in which the robot visited them.
    pub fn new(rows: &[LengthRow]) -> Self {
        let rows = Screened::new(Standing::new(rows, |row| row.joints_rad));
        Self { rows, noise: RowNoise::ALIKE, scale_u_ppm: ScaleFrom::Wire.usual_u_ppm() }
    }

    /// Sets the standard uncertainty of the scale to the value that the mapping states \[ppm\]. Zero means that the scale
    /// is exact. `None` keeps the default.
    #[must_use]
    pub fn with_scale_u_ppm(self, stated: Option<f64>) -> Self {
        Self { scale_u_ppm: stated.unwrap_or(self.scale_u_ppm), ..self }
    }

    /// Noise of each of these rows, relative to the median row.
    fn relative_noise_of(&self, rows: &[LengthRow]) -> Vec<f64> {
        self.noise.relative(rows.iter().map(|row| row.uncertainty_m))
    }

    /// The same instrument with other rows and the same noise.
    fn with_rows(&self, all: Standing<LengthRow>) -> Self {
        Self { rows: Screened::new(all), noise: self.noise, scale_u_ppm: self.scale_u_ppm }
    }

    /// The same instrument with other measured lengths \[m\].
    fn with_lengths(&self, lengths_m: impl Iterator<Item = f64>) -> Instrument {
        let mut all = self.rows.all.clone();
        all.rows.iter_mut().zip(lengths_m).for_each(|(row, length_m)| row.length_m = length_m);
        self.with_rows(all).into()
    }
}

/// Predicted minus measured lengths \[m\].
fn residuals_m(rows: &Standing<LengthRow>, geometry: &Geometry) -> Vec<f64> {
    let wire = &geometry.wire;
    let residual = |(row, state): (&LengthRow, &JointState)| {
        let Some((anchor_m, attachment_m)) = wire.at(row.set_up) else { return f64::NAN };
        let attachment_m = geometry.robot_end(state).transform_point(&(*attachment_m).into()).coords;
        (1.0 + geometry.scale) * (attachment_m - anchor_m).norm() + wire.offset_m - row.length_m
    };
    rows.rows.iter().zip(&rows.states).map(residual).collect()
}

/// Estimates the noise of some rows from their residuals. `None` if no row states its uncertainty.
fn estimate_noise(rows: &Standing<LengthRow>, geometry: &Geometry) -> Option<RowNoise> {
    let stated = || rows.rows.iter().map(|row| row.uncertainty_m);
    let errors_m = residuals_m(rows, geometry).into_iter().map(f64::abs);
    stated().any(|stated| stated.is_some()).then(|| RowNoise::behind(errors_m.zip(stated()), MEDIAN_OF_ONE))
}

/// Checks that the rows were measured with this robot. `contradicting` are the rows that contradict the robot's file. If
/// there are few of them, their joints are wrong. If they are most of the rows, the file is of another robot.
fn ensure_this_robot(contradicting: &[RejectedRow], rows: usize) -> Result<(), RowError> {
    let rejected = contradicting.len();
    if 2 * rejected <= rows {
        return Ok(());
    }
    let distances_m = contradicting.iter().filter_map(|one| match one.why {
        Rejection::FlangeContradicts { distance_m } => Some(distance_m),
        _ => None,
    });
    Err(RowError::OtherRobot { rejected, rows, median_mm: median_size(distances_m) * 1e3 })
}

/// Start value of the anchor from the measured lengths. The wire is assumed to be attached at the flange's origin.
/// `positions_m` are the positions of this origin. `None` if the positions lie in a plane.
///
/// With the anchor `c`, `|p - c|^2 = l^2` is linear in `c` and `k = |c|^2`: `2 p.c - k = |p|^2 - l^2`. `k` is estimated as
/// a fourth unknown, so it also absorbs some of a constant offset of the lengths.
fn start_anchor(positions_m: &[Vector3<f64>], lengths_m: &[f64]) -> Option<Vector3<f64>> {
    /// The positions are treated as lying in a plane if the ratio of the smallest to the largest
    /// singular value is not larger than this.
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

    /// Adds the parameters of the anchors and attachments that occur in the rows.
    fn fitted_out(&self, robot: Model) -> Model {
        let set_ups = self.rows.all.rows.iter().map(|row| row.set_up);
        robot.with_set_ups(Owner::Wire, SetUp::counts(set_ups)).without_clocks()
    }

    /// Sets start values of the anchors and frees the parameters of the wire. Returns false if the flange positions at
    /// the rows of an anchor lie in a plane.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        let geometry = model.geometry(&[]);
        let rows = || self.rows.at.rows.iter().zip(&self.rows.at.states);
        let mut free = vec![ParameterId::LengthOffset];
        for station in 0..geometry.wire.anchors_m.len() {
            let of_anchor = rows().filter(|(row, _)| row.set_up.station == station);
            let (positions_m, lengths_m): (Vec<Vector3<f64>>, Vec<f64>) = of_anchor
                .map(|(row, state)| (geometry.robot_end(state).translation.vector, row.length_m))
                .unzip();
            // An anchor without rows cannot be estimated.
            if positions_m.is_empty() {
                continue;
            }
            let Some(anchor_m) = start_anchor(&positions_m, &lengths_m) else { return Ok(false) };
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
        set_scale_prior(model, self.scale_u_ppm, fix)?;
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let Standing { rows, states, observations, .. } = &self.rows.at;
        let residual = MeasuredLength { rows, relative_noise: self.relative_noise_of(rows) };
        Ok(Box::new(LoopProblem::new(model, states, observations, residual, sigma)?))
    }

    fn reported(&self, sample: usize, _: &ClockRelation) -> Option<JointState> {
        self.rows.at.states.get(sample).copied()
    }

    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool {
        MeasuredLength::depends_on(id, robot) && id.group() != Group::Clock
    }

    /// Updates the relative noise of the rows. Returns `None`, because residuals stay in
    /// metres. The solver estimates their sigma.
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        self.noise = estimate_noise(&self.rows.at, &model.geometry(&[])).unwrap_or(self.noise);
        None
    }

    fn weigh_by(&mut self, model: &Model, samples: &[usize]) {
        let chosen = self.rows.all.chosen(samples);
        self.noise = estimate_noise(&chosen, &model.geometry(&[])).unwrap_or(self.noise);
    }

    /// Excludes outliers. If more than half of the rows are outliers, nothing changes.
    fn screen(&mut self, model: &Model) -> bool {
        let residuals_m = self.residuals_m(&model.geometry(&[]));
        self.rows.screen(&residuals_m, &self.relative_noise(), |_| true)
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.rows.at.independent(count, |row| row.set_up.station)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        self.with_rows(self.rows.at.chosen(samples)).into()
    }

    fn group(&mut self, groups: &[usize], seed: u64) {
        self.rows.group(groups, seed);
    }

    fn samples_min(&self) -> usize {
        ROWS_MIN
    }

    /// Finds rows whose joint angles and flange position, both reported by the controller, contradict each other.
    fn contradicting(&self, robot: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        /// Maximum distance between the reported flange position and the one computed from the joint angles \[m\]. It is
        /// larger than the rounding of controllers and the error of nominal links.
        const TOLERANCE_M: f64 = 5e-3;
        let all = &self.rows.all;
        all.ensure_finite(|row| row.flange_m.into_iter().flatten())?;
        if let Some(row) = all.rows.iter().position(|row| !(row.length_m.is_finite() && row.length_m > 0.0)) {
            return Err(RowError::BadRow { row: row + 1, what: "a length that is not above zero" });
        }
        let needed = [("anchor", ANCHOR_ROWS_MIN), ("attachment", ATTACHMENT_ROWS_MIN)];
        all.ensure_each_has_rows(|row| row.set_up, needed)?;
        let mut contradicting: Vec<RejectedRow> = Vec::new();
        for (row, (measured, state)) in all.rows.iter().zip(&all.states).enumerate() {
            let Some(reported_m) = measured.flange_m.map(Vector3::from) else { continue };
            let distance_m = (robot.forward(&state.q).translation.vector - reported_m).norm();
            if distance_m > TOLERANCE_M {
                contradicting.push(RejectedRow { row, why: Rejection::FlangeContradicts { distance_m } });
            }
        }
        ensure_this_robot(&contradicting, all.rows.len())?;
        Ok(contradicting)
    }

    fn judges_gross(&self) -> bool {
        true
    }

    fn mistakes(&self, axes: usize) -> Vec<Mistake> {
        let others = [Mistake::ModifiedTable].into_iter().chain(Mistake::LENGTH_UNITS);
        Mistake::of_joints(axes).into_iter().chain(others).collect()
    }

    fn undone(&self, mistake: Mistake, robot: &Chain) -> Vec<Instrument> {
        let all = &self.rows.all;
        match mistake {
            Mistake::Joints(mistake) => vec![self.with_rows(all.undone(mistake, robot)).into()],
            Mistake::LengthUnit(thousandths) => {
                let factor = f64::from(thousandths) * 1e-3;
                vec![self.with_lengths(all.rows.iter().map(|row| row.length_m * factor))]
            }
            _ => Vec::new(),
        }
    }

    fn lengths_m(&self) -> Vec<f64> {
        self.rows.all.rows.iter().map(|row| row.length_m).collect()
    }

    fn longer_by(&self, by_m: &[f64]) -> Option<Instrument> {
        let lengths_m = self.rows.all.rows.iter().zip(by_m).map(|(row, by_m)| row.length_m + by_m);
        Some(self.with_lengths(lengths_m))
    }

    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        residuals_m(&self.rows.all, geometry).into_iter().map(Deviation::of_length).collect()
    }

    fn rejected(&self) -> &[RejectedRow] {
        &self.rows.rejected
    }

    /// The position of each anchor, and the offset of the lengths, can change.
    fn causes(&self, Geometry { wire, .. }: &Geometry) -> Vec<Cause> {
        let anchor = |station| {
            let name = format!("the anchor{} of the wire", numbered("", station));
            Cause::new(name, Axis::ALL.map(|axis| ParameterId::Anchor { station, axis }))
        };
        let offset = Cause::new("the zero of the wire", [ParameterId::LengthOffset]);
        (0..wire.anchors_m.len()).map(anchor).chain([offset]).collect()
    }

    /// Noise of each row relative to the median row, including rows that are not used.
    fn relative_noise(&self) -> Vec<f64> {
        self.relative_noise_of(&self.rows.all.rows)
    }
}
