//! A tip on the flange that touches the parts of an artefact, whose pose is unknown. The tip is either a ball that is seated
//! in the sockets of a plate ([`Sockets`]), or a probe or dial gauge that touches the faces of a block ([`Faces`]).
//!
//! A row contains the joints of the robot and the number of the touched part. The residual is the difference between the tip
//! and this part. In addition to the robot, the fit estimates the positions of the tip and of the parts. Known quantities of
//! the parts, such as distances, determine the scale.

mod contact;
mod faces;
mod known;
mod sockets;
mod touch;

use nalgebra::Vector3;
use shared::output::named;

pub use contact::Contact;
pub use faces::{FaceTable, Faces, KnownAngle, Spacing, Touched};
pub use known::Knowns;
pub use sockets::{KnownDistance, PlacedSocket, SocketTable, Sockets};
pub use touch::Touch;

use super::description::nearest;
use super::rows::{Screened, Standing, sigma_by_median};
use super::{
    Cause, Deviation, Instrument, Measures, Mistake, Noise, RejectedRow, RowError, ScaleFrom, Section,
};
use crate::cost::{CostError, DataSet, LoopProblem, Residual};
use crate::kinematics::{Chain, Pose};
use crate::logs::TipRow;
use crate::model::{ClockRelation, Geometry, JointState, Model, ModelError, Owner, ParameterId, Role, SetUp};

/// Standard deviation of the prior of the tip's position on the flange \[m\]. The prior is weak: it has an effect only if
/// the poses do not determine the tip.
const TIP_SIGMA_M: f64 = 1.0;

/// Weight of the tip's prior in normal equations. The normal equations must be a sum over
/// `rows` rows that have the weight one.
fn tip_weight(rows: usize) -> f64 {
    /// Assumed error of a measured position \[m\].
    const ERROR_M: f64 = 1e-3;
    rows as f64 * (ERROR_M / TIP_SIGMA_M).powi(2)
}

/// Minimum number of measured coordinates or distances: twice the number of unknowns of tip, parts and links.
fn numbers_min(parts: usize, axes: usize) -> usize {
    const NUMBERS_OF_LINK: usize = 4;
    2 * (3 * (1 + parts) + NUMBERS_OF_LINK * axes)
}

/// Poses of the flange, each with the row that was measured there.
type TouchedPoses = Vec<(Pose, TipRow)>;

/// The touched parts of one rigid body, with their known quantities. Parts have the same numbers as their parameters.
pub trait Artefact: Knowns + Clone + Send + 'static {
    /// Residual of the rows.
    type Cost<'a>: Residual + 'a;
    /// Name of the instrument.
    const NAME: &'static str;
    /// Name of tip and parts in tables.
    const TIP_AND_PARTS: &'static str;
    /// Name of one part. The names of its parameters begin with it.
    const PART: &'static str;
    /// Message for a row whose tip is not at the part that the row states. In the message,
    /// the name of the stated part follows.
    const ELSEWHERE: &'static str;
    /// Median absolute value of errors whose standard deviation is one.
    const MEDIAN: f64;
    /// Minimum number of rows of each part. Zero if the number of rows was checked before.
    const PART_ROWS_MIN: usize;
    /// Minimum number of rows of each part that remain when outliers are excluded.
    const PART_ROWS_KEPT: usize;

    /// Names of the parts in the rows.
    fn names(&self) -> &[String];

    /// Quantity that determines the scale of all lengths.
    fn scale(&self) -> ScaleFrom;

    /// The residual of these rows.
    fn cost(rows: &[TipRow]) -> Self::Cost<'_>;

    /// Position of the tip on the flange \[m\].
    fn tip_m(geometry: &Geometry) -> Vector3<f64>;

    /// Position of the tip minus the position of a part. `tip_m` is the position of the tip in the robot's base \[m\]. NaN
    /// if the geometry does not contain the part.
    fn deviation(geometry: &Geometry, part: usize, tip_m: Vector3<f64>, reading_m: f64) -> Deviation;

    /// Start value and role of each parameter of tip and parts. `None` if the rows do not determine them.
    fn start(&self, touches: &TouchedPoses) -> Option<Vec<(ParameterId, f64, Role)>>;

    /// Causes of a change of the tip or the parts during a measurement.
    fn causes() -> Vec<Cause> {
        Vec::new()
    }

    /// Minimum number of rows for an arm with this number of axes. Zero if the number of rows was checked before.
    fn samples_min(&self, _axes: usize) -> usize {
        0
    }

    /// Whether the rows can reveal this mistake. A mistake that they cannot reveal is not tried.
    fn reveals(_: &Mistake) -> bool {
        true
    }
}

/// The rows of one file, and the noise of the tip.
#[derive(Debug, Clone)]
pub struct Tip<A> {
    rows: Screened<TipRow>,
    artefact: A,
    /// Standard deviation of a coordinate or distance of the tip, estimated from the residuals \[m\].
    noise_m: f64,
}

impl<A: Artefact> Tip<A> {
    fn of_rows(all: Standing<TipRow>, artefact: A) -> Self {
        Self { rows: Screened::new(all), artefact, noise_m: TIP_SIGMA_M }
    }

    /// The same instrument with other rows of the same parts.
    fn with_rows(&self, all: Standing<TipRow>) -> Instrument {
        Self { rows: Screened::new(all), artefact: self.artefact.clone(), noise_m: self.noise_m }.into()
    }

    /// Difference between the tip of a row and a part.
    fn deviation(geometry: &Geometry, row: &TipRow, state: &JointState, part: usize) -> Deviation {
        let tip_m = geometry.robot_end(state).transform_point(&A::tip_m(geometry).into()).coords;
        A::deviation(geometry, part, tip_m, row.reading_m)
    }
}

impl<A: Artefact> Measures for Tip<A> {
    fn name(&self) -> &'static str {
        A::NAME
    }

    fn cost(&self) -> &'static str {
        <A::Cost<'_>>::NAME
    }

    /// The rows may contradict the known quantities in the table of sockets or faces.
    fn doubts(&self, geometry: &Geometry) -> Vec<String> {
        const NAMED: usize = 3;
        let contradicted = self.artefact.contradicted(geometry);
        let other_table = (!contradicted.is_empty()).then(|| {
            format!(
                "The rows contradict the table of sockets or faces: {}. Correct the table or increase its uncertainty: with this one \
                 it biases the result.",
                named(&contradicted, NAMED)
            )
        });
        other_table.into_iter().collect()
    }

    fn scale(&self) -> ScaleFrom {
        self.artefact.scale()
    }

    fn noise(&self) -> Noise {
        Noise::Length(self.noise_m)
    }

    fn samples(&self) -> usize {
        self.rows.at.rows.len()
    }

    fn parts(&self) -> &'static str {
        A::TIP_AND_PARTS
    }

    /// One section for each part.
    fn sections(&self) -> Vec<Section> {
        let rows = &self.rows.all.rows;
        let section = |(part, name): (usize, &String)| Section {
            name: name.clone(),
            parameters: format!("{}{}", A::PART, part + 1),
            samples: (0..rows.len()).filter(|row| rows[*row].part == part).collect(),
        };
        self.artefact.names().iter().enumerate().map(section).collect()
    }

    /// For each excluded row, names the part that is nearest to the tip.
    fn remarks(&self, geometry: &Geometry) -> Vec<(usize, String)> {
        let (names, all) = (self.artefact.names(), &self.rows.all);
        let remark = |rejected: &RejectedRow| {
            let (row, state) = (all.rows.get(rejected.row)?, all.states.get(rejected.row)?);
            let off_m = |part| Self::deviation(geometry, row, state, part).signed_m().abs();
            let other = nearest(names, row.part, off_m);
            Some((rejected.row, format!("{} `{}`{other}", A::ELSEWHERE, names[row.part])))
        };
        self.rows.rejected.iter().filter_map(remark).collect()
    }

    /// Adds the parameters of tip and touched parts.
    fn fitted_out(&self, robot: Model) -> Model {
        robot.with_set_ups(<A::Cost<'_>>::OWNER, [self.artefact.names().len(), 1]).without_clocks()
    }

    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        let geometry = model.geometry(&[]);
        let used = self.rows.at.states.iter().zip(&self.rows.at.rows);
        let touches: TouchedPoses = used.map(|(state, row)| (geometry.robot_end(state), *row)).collect();
        let Some(start) = self.artefact.start(&touches) else { return Ok(false) };
        for (id, start, role) in start {
            // The start value of the tip fits the nominal robot. A fixed tip has its expected position instead.
            let expected = if let Role::Prior { value, .. } = role { value } else { start };
            let (value, role) = if fix.contains(&id) { (expected, Role::Fixed) } else { (start, role) };
            model.set_value(id, value)?;
            model.set_role(id, role)?;
        }
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let Self { rows: Screened { at, .. }, artefact, noise_m } = self;
        let cost = A::cost(&at.rows);
        let problem = LoopProblem::new(model, &at.states, &at.observations, cost, sigma * noise_m)?;
        Ok(Box::new(problem.with_knowns(artefact)))
    }

    fn reported(&self, sample: usize, _: &ClockRelation) -> Option<JointState> {
        self.rows.at.states.get(sample).copied()
    }

    /// Only the tip can change. The parts are on one rigid body.
    fn causes(&self, _: &Geometry) -> Vec<Cause> {
        A::causes()
    }

    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool {
        <A::Cost<'_>>::depends_on(id, robot) && id.owner() != Owner::Clocks
    }

    /// Estimates the standard deviation from the median of the residuals, because most of them are normally distributed.
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        self.noise_m = sigma_by_median(self.residuals_m(&model.geometry(&[])).into_iter(), A::MEDIAN);
        Some(self.noise_m)
    }

    /// Excludes outliers. If more than half of the rows are outliers, or if a part would keep too few rows, nothing changes.
    fn screen(&mut self, model: &Model) -> bool {
        let residuals_m = self.residuals_m(&model.geometry(&[]));
        let parts = self.artefact.names().len();
        let cover_all_parts = |rows: &[TipRow]| {
            let rows_of = |part: usize| rows.iter().filter(|row| row.part == part).count();
            (0..parts).all(|part| rows_of(part) >= A::PART_ROWS_KEPT)
        };
        self.rows.screen(&residuals_m, &vec![1.0; residuals_m.len()], cover_all_parts)
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.rows.at.independent(count, |row| row.part)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        self.with_rows(self.rows.at.chosen(samples))
    }

    fn group(&mut self, groups: &[usize], seed: u64) {
        self.rows.group(groups, seed);
    }

    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        let all = self.rows.all.rows.iter().zip(&self.rows.all.states);
        all.map(|(row, state)| Self::deviation(geometry, row, state, row.part)).collect()
    }

    fn rejected(&self) -> &[RejectedRow] {
        &self.rows.rejected
    }

    fn samples_min(&self) -> usize {
        self.artefact.samples_min(self.rows.all.states.first().map_or(0, |state| state.q.len()))
    }

    fn contradicting(&self, _: &Chain) -> Result<Vec<RejectedRow>, RowError> {
        self.rows.all.ensure_finite(|row| [row.reading_m].into_iter())?;
        let part = |row: &TipRow| SetUp { station: row.part, target: 0 };
        self.rows.all.ensure_each_has_rows(part, [(A::PART, A::PART_ROWS_MIN), ("tip", 0)])?;
        Ok(Vec::new())
    }

    /// Finds rows whose tip is at another part than the row states. No model can predict such rows.
    fn misplaced(&self, model: &Model) -> Vec<RejectedRow> {
        let mut screened = self.clone();
        screened.screen(model);
        screened.rows.rejected
    }

    fn judges_gross(&self) -> bool {
        true
    }

    fn mistakes(&self, axes: usize) -> Vec<Mistake> {
        let all = Mistake::of_joints(axes).into_iter().chain([Mistake::ModifiedTable]);
        all.filter(A::reveals).collect()
    }

    fn undone(&self, mistake: Mistake, robot: &Chain) -> Vec<Instrument> {
        let Mistake::Joints(mistake) = mistake else { return Vec::new() };
        vec![self.with_rows(self.rows.all.undone(mistake, robot))]
    }
}
