//! Accuracy of the calibrated robot in its workspace: the position error over the whole range of its joints.
//! Used for the report. The method is Monte Carlo:
//!
//! 1. `Workspace::new` draws random postures, and draws robots from the covariance of the solution. A drawn robot has
//!    the parameter errors `dp`.
//! 2. In each posture, a drawn robot has the position error `J dp`, where `J` are the derivatives with
//!    respect to the parameters.
//! 3. Motions of the whole robot relative to its base are removed from the tolerances of links (`base_motions`).
//! 4. `expected` computes mean, quantiles and confidence bounds from the errors of all robots in all postures.
//!
//! Step 3 is needed because some link errors act like a motion of the whole robot. For example, if a link follows a linear
//! axis or parallel axes, its error displaces all following links by the same motion. Another pose of the instrument would
//! have the same effect, so no measurement separates the two, and the motion does not count as an error.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVectorView, SymmetricEigen, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{ChiSquared, Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::budget::Budget;
use super::cube::{Cube, CubeError};
use crate::calibrate::Calibration;
use crate::calibrate::validation::deployment::{Deployed, Deployment};
use crate::instrument::standing;
use crate::kinematics::{Joints, Trace, Tracer};
use crate::model::{JointState, Model, Owner, ParameterId, TermGroup};
use crate::solver::{Covariance, UncertaintySource};
use crate::statistics::{mean, quantile, rms};

/// Number of random postures, which are uniformly distributed over the joint limits.
const POSTURES: usize = 400;
/// Number of robots drawn from the covariance.
const DRAWS: usize = 400;

/// An expected position error, with its confidence bounds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Expected {
    /// Mean over the workspace \[m\].
    pub mean_m: f64,
    /// 95 % quantile over the workspace \[m\].
    pub p95_m: f64,
    /// Upper 97.5 % confidence bound of `p95_m` \[m\].
    pub p95_upper_m: f64,
    /// 95 % confidence interval of the mean \[m\].
    pub interval_m: [f64; 2],
}

/// Expected position errors in one posture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceError {
    /// Position in the robot's base \[m\].
    pub position_m: [f64; 3],
    /// Error with the nominal geometry, root mean square \[m\].
    pub before_m: f64,
    /// Error with the calibrated geometry, root mean square \[m\].
    pub after_m: f64,
}

/// Position error of the robot's end over random postures within the joint limits.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WorkspaceError {
    /// Error with the nominal geometry.
    pub before: Expected,
    /// Error with the calibrated geometry, with links and joint errors compensated. Computed from the
    /// covariance of the solution.
    pub after: Expected,
    /// Error if a controller applies only some parameters of the model. Empty until the deployments are fitted.
    pub deployed: BTreeMap<Deployment, Expected>,
    /// The combination of parameters that contributes most to the remaining error. Each entry consists of a parameter's name
    /// and its fraction of the combination, 0 to 1. The largest fraction is first.
    pub weakest: Vec<(String, f64)>,
    /// Uncertainty budget of the position error.
    pub budget: Budget,
    /// Errors in each of the postures.
    pub places: Vec<PlaceError>,
    /// Errors over the five poses of ISO 9283; `None` if the robot reaches no cube.
    pub cube: Option<CubeError>,
}

/// Random postures, the change of position that the calibration causes in each posture, and the derivatives of
/// positions with respect to the robot's parameters.
#[derive(Debug, Clone)]
struct Postures {
    states: Vec<JointState>,
    /// Positions of the calibrated robot's end.
    positions_m: Vec<Vector3<f64>>,
    /// Position of the calibrated robot minus that of the nominal robot.
    corrected_m: Vec<Vector3<f64>>,
    /// Derivatives of the positions with respect to the parameters: three rows per posture, one column per parameter.
    by_parameter: DMatrix<f64>,
}

/// Effects of uncertain parameters on the robot's position over its workspace. A source is an independent cause of
/// uncertainty ([`UncertaintySource`]), such as the errors of the samples or a prior.
#[derive(Debug, Clone)]
pub(in crate::evaluate) struct Workspace {
    /// Columns of the covariance that belong to the robot, see [`robot_columns`].
    columns: Vec<(usize, ParameterId)>,
    /// Change of these parameters for an error of one standard deviation in each source: one row per parameter,
    /// one column per source.
    spread: DMatrix<f64>,
    /// Drawn errors of the sources, in standard deviations: one row per source, one column per robot drawn from the covariance.
    drawn: DMatrix<f64>,
    postures: Postures,
    /// For each source, the motion of the whole robot that is nearest to the effect of the source. It is zero if the source
    /// is not the tolerance of a link. One column per source; the six rows correspond to the columns of
    /// [`Postures::by_base`].
    base_motions: DMatrix<f64>,
}

/// Computes the expected position errors of the nominal robot and of the calibrated robot. Each is compared with
/// robots drawn from the covariance of the solution.
///
/// `joint_limits` are the limits of the joints of the model. The drawn robots have errors in links and joints,
/// including links fixed at uncertain values and excluded terms of joint errors. All other parameters only define the
/// robot's base frame, so no errors are drawn for them.
pub fn workspace_error(calibration: &Calibration, joint_limits: &[[f64; 2]]) -> WorkspaceError {
    Workspace::new(calibration, joint_limits).error(calibration, joint_limits)
}

impl Workspace {
    /// Draws the robots. The arguments are those of [`workspace_error`].
    pub(in crate::evaluate) fn new(calibration: &Calibration, joint_limits: &[[f64; 2]]) -> Self {
        /// Singular values up to this size count as zero. They occur if the end moves only along a line, because
        /// a rotation about this line then has no effect.
        const SINGULAR: f64 = 1e-9;
        let covariance = &calibration.solution().covariance;
        let columns = robot_columns(calibration);
        let postures = Postures::new(calibration.model(), &columns, random_postures(joint_limits));
        let spread = covariance.spread().by_source.select_rows(columns.iter().map(|(column, _)| column));
        let base_from_positions = postures.by_base().svd(true, true).pseudo_inverse(SINGULAR);
        let base_from_positions =
            base_from_positions.unwrap_or_else(|_| DMatrix::zeros(6, 3 * postures.states.len()));
        let mut base_motions = base_from_positions * (&postures.by_parameter * &spread);
        for (mut motion, source) in base_motions.column_iter_mut().zip(&covariance.spread().sources) {
            if !is_tolerance_of_link(*source, calibration) {
                motion.fill(0.0);
            }
        }
        Self { columns, spread, drawn: drawn_sources(covariance), postures, base_motions }
    }

    /// Errors of the nominal and the calibrated robot. The arguments are those of [`Self::new`].
    pub(in crate::evaluate) fn error(
        &self,
        calibration: &Calibration,
        joint_limits: &[[f64; 2]],
    ) -> WorkspaceError {
        let moved_m = self.moved_m(&self.postures);
        let drawn_m = &moved_m * &self.drawn;
        let [before, after] = self.postures.errors(&drawn_m);
        WorkspaceError {
            before,
            after,
            deployed: BTreeMap::new(),
            places: self.postures.places(&drawn_m),
            weakest: self.weakest(&moved_m),
            budget: Budget::new(calibration, &moved_m),
            cube: self.cube_error(calibration.model(), joint_limits),
        }
    }

    /// Expected error with each deployment. A deployment applies only some parameters of the model.
    pub(in crate::evaluate) fn deployed<'a>(
        &self,
        parts: impl Iterator<Item = &'a Deployed>,
    ) -> BTreeMap<Deployment, Expected> {
        let drawn_m = self.moved_m(&self.postures) * &self.drawn;
        let error = |part: &Deployed| expected(&self.postures.difference_m(&part.model), &drawn_m);
        parts.map(|part| (part.deployment, error(part))).collect()
    }

    fn cube_error(&self, model: &Model, joint_limits: &[[f64; 2]]) -> Option<CubeError> {
        let cube = Cube::largest(&model.geometry(&model.start()).robot, joint_limits)?;
        let postures = Postures::new(model, &self.columns, cube.postures.into_iter());
        let [before, after] = postures.errors(&(self.moved_m(&postures) * &self.drawn));
        Some(CubeError { edge_m: cube.edge_m, centre_m: cube.centre_m.into(), before, after })
    }

    /// Displacement of the robot's end for an error of one standard deviation in each source, after motions of the whole
    /// robot are removed: three rows per posture, one column per source \[m\].
    fn moved_m(&self, postures: &Postures) -> DMatrix<f64> {
        &postures.by_parameter * &self.spread - postures.by_base() * &self.base_motions
    }

    /// The combination of parameters that contributes most to position errors. It is `S v`, where the covariance is `S S^T`,
    /// `v` is the eigenvector of `K^T K` with the largest eigenvalue, and `K` is `moved_m`.
    fn weakest(&self, moved_m: &DMatrix<f64>) -> Vec<(String, f64)> {
        /// Parameters with a smaller fraction of the combination are not reported.
        const PART_MIN: f64 = 0.05;
        let Self { columns, spread, postures: Postures { by_parameter, .. }, .. } = self;
        if spread.is_empty() {
            return Vec::new();
        }
        let by_parameter_squared = by_parameter.tr_mul(by_parameter);
        let eigen = SymmetricEigen::new(moved_m.tr_mul(moved_m));
        let direction = spread * eigen.eigenvectors.column(eigen.eigenvalues.imax());
        // The effect on positions makes metres and radians comparable.
        let effect = |i: usize| direction[i] * direction[i] * by_parameter_squared[(i, i)];
        let whole: f64 = (0..columns.len()).map(effect).sum();
        let mut parts: Vec<(String, f64)> = columns
            .iter()
            .enumerate()
            .map(|(i, (_, id))| (id.to_string(), effect(i) / whole.max(f64::MIN_POSITIVE)))
            .filter(|(_, part)| *part > PART_MIN)
            .collect();
        parts.sort_by(|a, b| b.1.total_cmp(&a.1));
        parts
    }
}

/// Columns of the covariance whose parameters move the robot's end at standstill: its links and joint errors, except delays.
fn robot_columns(calibration: &Calibration) -> Vec<(usize, ParameterId)> {
    let covariance = &calibration.solution().covariance;
    (0..calibration.model().columns().len())
        .filter(|column| covariance.sigma(*column).is_some())
        .chain(covariance.beside())
        .map(|index| (index, calibration.solved.covariance_columns[index]))
        .filter(|(_, column)| column.data_set == 0 && column.id.owner() == Owner::Robot)
        .filter(|(_, column)| column.id.term() != Some(TermGroup::Delay))
        .map(|(index, column)| (index, column.id))
        .collect()
}

/// Draws errors of the sources, in standard deviations. Each column is one robot drawn from the covariance.
fn drawn_sources(covariance: &Covariance) -> DMatrix<f64> {
    let sources = &covariance.spread().sources;
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let mut drawn = DMatrix::from_fn(sources.len(), DRAWS, |_, _| StandardNormal.sample(&mut random));
    // Standard deviations from a few folds are themselves uncertain. The errors are therefore drawn from a
    // multivariate t distribution (Kotz and Nadarajah 2004).
    if let Some((freedom, chi_squared)) =
        covariance.sigmas_from.freedom().and_then(|freedom| Some((freedom, ChiSquared::new(freedom).ok()?)))
    {
        for mut draw in drawn.column_iter_mut() {
            let scale = (freedom / chi_squared.sample(&mut random)).sqrt();
            let samples = draw.iter_mut().zip(sources).filter(|(_, source)| source.is_statistical());
            samples.for_each(|(value, _)| *value *= scale);
        }
    }
    drawn
}

/// Whether a source is the tolerance of a link parameter. The parameter can be estimated or fixed.
fn is_tolerance_of_link(source: UncertaintySource, calibration: &Calibration) -> bool {
    let (UncertaintySource::Prior { column }
    | UncertaintySource::Contradicted { column }
    | UncertaintySource::Considered { column }) = source
    else {
        return false;
    };
    let id = calibration.solved.covariance_columns[column].id;
    id.owner() == Owner::Robot && id.term().is_none()
}

/// Random postures with joint variables that are uniformly distributed over the limits \[rad, m\].
pub fn random_postures(joint_limits: &[[f64; 2]]) -> impl ExactSizeIterator<Item = Joints> + '_ {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let posture =
        move |_| joint_limits.iter().map(|[low, high]| low + (high - low) * random.random::<f64>()).collect();
    (0..POSTURES).map(posture)
}

impl Postures {
    fn new(
        model: &Model,
        columns: &[(usize, ParameterId)],
        of_joints: impl ExactSizeIterator<Item = Joints>,
    ) -> Self {
        let mut nominal = model.clone();
        nominal.reset_to_nominal(|_| true);
        let geometry = model.geometry(&model.start());
        let (tracer, mut end) = (Tracer::new(&geometry.robot), Trace::default());
        let states = standing(of_joints);
        let by_parameter = DMatrix::zeros(3 * states.len(), columns.len());
        let mut postures = Self { states, positions_m: Vec::new(), corrected_m: Vec::new(), by_parameter };
        for (posture, reported) in postures.states.iter().enumerate() {
            let joints = geometry.at_rest(*reported);
            tracer.trace(&joints.corrected.q, &mut end);
            postures.positions_m.push(end.position_m());
            let mut rows = postures.by_parameter.rows_mut(3 * posture, 3);
            for (mut column, (_, id)) in rows.column_iter_mut().zip(columns) {
                if let Some(twist) = geometry.end_twist(&joints, &end, *id) {
                    column.copy_from(&twist.linear);
                }
            }
        }
        postures.corrected_m = postures.difference_m(&nominal);
        postures
    }

    /// Position of the calibrated robot's end minus that of another model, for each posture \[m\].
    fn difference_m(&self, other: &Model) -> Vec<Vector3<f64>> {
        let other = other.geometry(&other.start());
        let ends = self.states.iter().map(|state| other.robot_end(state).translation.vector);
        self.positions_m.iter().zip(ends).map(|(calibrated, other)| calibrated - other).collect()
    }

    /// Derivatives of the positions with respect to a translation and a rotation of the base. With the position `p`,
    /// each posture has the three rows `[I, -[p]x]`.
    fn by_base(&self) -> DMatrix<f64> {
        let mut by_base = DMatrix::zeros(3 * self.states.len(), 6);
        for (posture, position_m) in self.positions_m.iter().enumerate() {
            by_base.fixed_view_mut::<3, 3>(3 * posture, 0).fill_with_identity();
            by_base.fixed_view_mut::<3, 3>(3 * posture, 3).copy_from(&-position_m.cross_matrix());
        }
        by_base
    }

    /// Root mean square error of each posture over all draws, with the nominal and with the calibrated geometry.
    fn places(&self, drawn_m: &DMatrix<f64>) -> Vec<PlaceError> {
        let of_posture = |(posture, (position_m, corrected_m)): (usize, (&Vector3<f64>, &Vector3<f64>))| {
            let drawn = |draw| Vector3::from(drawn_m.fixed_view::<3, 1>(3 * posture, draw));
            let draws = 0..drawn_m.ncols();
            PlaceError {
                position_m: (*position_m).into(),
                before_m: rms(draws.clone().map(|draw| (corrected_m + drawn(draw)).norm())),
                after_m: rms(draws.map(|draw| drawn(draw).norm())),
            }
        };
        self.positions_m.iter().zip(&self.corrected_m).enumerate().map(of_posture).collect()
    }

    /// Expected errors of the nominal and the calibrated robot.
    fn errors(&self, drawn_m: &DMatrix<f64>) -> [Expected; 2] {
        [&self.corrected_m, &vec![Vector3::zeros(); self.states.len()]]
            .map(|difference_m| expected(difference_m, drawn_m))
    }
}

/// Expected error of a robot model, averaged over drawn robots. In each posture, `difference_m` is the position
/// of the calibrated robot minus the position of this model. `drawn_m` are the errors of the drawn robots
/// relative to the calibrated robot.
fn expected(difference_m: &[Vector3<f64>], drawn_m: &DMatrix<f64>) -> Expected {
    let of_draw = |draw: DVectorView<'_, f64>| -> Vec<f64> {
        let drawn = |posture: usize| Vector3::from(draw.fixed_rows::<3>(3 * posture));
        difference_m.iter().enumerate().map(|(posture, by_m)| (by_m + drawn(posture)).norm()).collect()
    };
    let errors_m: Vec<Vec<f64>> = drawn_m.column_iter().map(of_draw).collect();
    let mut means: Vec<f64> = errors_m.iter().map(mean).collect();
    let mut p95s: Vec<f64> = errors_m.iter().map(|errors| quantile(&mut errors.clone(), 0.95)).collect();
    let mut all: Vec<f64> = errors_m.into_iter().flatten().collect();
    let p95_m = quantile(&mut all, 0.95);
    Expected {
        mean_m: mean(&all),
        p95_m,
        // With five poses, the quantile of one robot is interpolated between its two largest errors. It can therefore be
        // smaller than the quantile over all robots.
        p95_upper_m: quantile(&mut p95s, 0.975).max(p95_m),
        interval_m: [0.025, 0.975].map(|part| quantile(&mut means, part)),
    }
}
