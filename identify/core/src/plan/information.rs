//! Information of a path: the normal equations of the parameters that a calibration would estimate, and a scalar criterion, for
//! every search of this module. With covariance `P`, and `W` the mean of `J^T J` of positions, the position error is
//! `sqrt(tr(W P))`.
//!
//! Each pose contributes the whitened residual of the `pose` cost at the nominal geometry, for white noise and as many samples
//! as a calibration keeps. Encoder harmonics and all terms of the robot's axes are included with their priors. A calibration
//! includes only terms that held-out data support, so its accuracy is slightly better than expected here. Errors without a
//! parameter are not included.

use nalgebra::DMatrix;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use shared::config::{BallBarConfig, RobotConfig};

use crate::calibrate::IdentifyConfig;
use crate::calibrate::selection::links::inseparable_offsets;
use crate::cost::{AngleNoise, LoopProblem, Residual, WhitenedPose};
use crate::kinematics::{Chain, Joints, Trace, Tracer};
use crate::model::{
    DriveTrain, JointState, Model, ModelError, Observation, ParameterId, PerObservation, Role, TermGroup,
};
use crate::solver::{Normal, Normals, Options, ScaledCholesky, combined, stacked};

use super::optimum::{Optimum, optimum};

/// Number of postures for the mean of position errors.
const POSTURES: usize = 300;
/// Rate of the recording \[1/s\].
const SAMPLES_PER_S: f64 = 100.0;

/// Standard deviation of parameters that count as known, SI.
const KNOWN_SIGMA: f64 = 1e-9;

/// Expected RMS position errors over the robot's workspace after a calibration \[m\]; infinite if the position of the bar or
/// the clocks are undetermined.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExpectedPosition {
    /// For axes without errors.
    pub axes_exact_m: f64,
    /// With all terms of the axes, with the width of their priors.
    pub with_terms_m: f64,
    /// Also with the uncertainty of the plate's length, to which all lengths are proportional.
    pub with_plate_m: f64,
}

/// Criterion of a plan.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Criterion {
    /// RMS position error over the robot's workspace (I-optimal)
    #[default]
    Position,
    /// Volume of the ellipsoid of the robot's parameters (D-optimal)
    Determinant,
    /// The most uncertain parameter of the robot, in position errors over the workspace
    Worst,
}

/// Error from one group of terms alone.
#[derive(Debug, Clone, PartialEq)]
pub struct WithTerms {
    /// Group of the terms.
    pub group: TermGroup,
    /// RMS position error over the workspace \[m\].
    pub position_m: f64,
}

/// The parameters of a calibration, and their effect on positions.
#[derive(Debug, Clone)]
pub struct Information {
    model: Model,
    noise: AngleNoise,
    /// Number of samples per second that a calibration keeps \[1/s\].
    samples_per_s: f64,
    /// Prior information about the columns, for every path.
    prior: Normal,
    /// Prior standard deviation of each column, SI; infinite without a prior.
    prior_sigmas: Vec<f64>,
    /// Columns of the robot's links.
    link_columns: Vec<usize>,
    /// Mean of `J^T J` of positions over the workspace, for the columns of the links \[m²\].
    weight: DMatrix<f64>,
    criterion: Criterion,
    /// Columns of errors of the robot's axes and of the bar's length.
    term_columns: Vec<(TermGroup, usize)>,
    /// Column of the plate's length, which no path determines: the relative uncertainty of all lengths is that of the plate.
    plate_column: Option<usize>,
}

/// Poses of the bar and the robot.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Visited {
    /// Joints of the bar \[rad\].
    pub bar_rad: Vec<[f64; 5]>,
    /// Joints of the robot and their speeds.
    pub robot: Vec<JointState>,
}

impl Information {
    /// For a run of this length, with the parameters and number of samples of a calibration with default settings.
    ///
    /// # Errors
    /// [`ModelError`] if the model lacks a parameter.
    pub fn new(
        (robot, bar): (&RobotConfig, &BallBarConfig),
        (arm, bar_chain): (&Chain, &Chain),
        criterion: Criterion,
        duration_s: f64,
    ) -> Result<Self, ModelError> {
        let config = IdentifyConfig::default();
        let mut model = Model::ball_bar(arm, bar_chain).with_drives(DriveTrain::of(robot, arm));
        let identifies = WhitenedPose::identifies;
        config.set_roles(&mut model, &[], identifies)?;
        let mut terms = Vec::new();
        for group in config.groups(&model, |id| identifies(id, arm)) {
            terms.extend(group.ids.iter().map(|id| (group.group, *id)));
            model.set_roles(group.ids, Role::Prior { value: 0.0, sigma: group.sigma })?;
        }
        // Every whole run determines the skew well.
        model.set_role(ParameterId::ClockSkew, Role::Fixed)?;
        let plate = ParameterId::plate(model.axes());
        if bar.plate_u_um > 0.0 {
            let value = model.parameter(plate).map_or(bar.plate_m, |plate| plate.nominal);
            model.set_role(plate, Role::Prior { value, sigma: bar.plate_u_um * 1e-6 })?;
        }
        let links: Vec<(usize, ParameterId)> = model
            .columns()
            .enumerate()
            .filter(|(_, parameter)| matches!(parameter.id, ParameterId::Robot { .. }))
            .map(|(column, parameter)| (column, parameter.id))
            .collect();
        let weight = position_weight(arm, &links, &robot.joint_limits());
        let link_columns = links.into_iter().map(|(column, _)| column).collect();
        let term_columns =
            terms.into_iter().filter_map(|(group, id)| Some((group, model.column_of(id)?))).collect();
        let plate_column = model.column_of(plate);
        let mut prior = Normal::zeros(model.columns().len());
        prior.add_priors(&model.priors(), &model.start());
        let noise = config.noise.into();
        let kept = config.prepare.points_max as f64 / duration_s.max(1.0);
        let samples_per_s = if kept > 0.0 { kept.min(SAMPLES_PER_S) } else { SAMPLES_PER_S };
        let prior_sigmas =
            prior.matrix.diagonal().iter().map(|information| information.sqrt().recip()).collect();
        Ok(Self {
            model,
            noise,
            samples_per_s,
            prior,
            prior_sigmas,
            link_columns,
            weight,
            criterion,
            term_columns,
            plate_column,
        })
    }

    /// The information after a calibration with this covariance: `between` returns that of two parameters, `None` if one was
    /// not identified. In a new run the position of the bar, the encoder offsets and the clocks are estimated again.
    ///
    /// `None` if the calibration has none of the parameters, or the covariance is not positive definite.
    #[must_use]
    pub fn after(mut self, between: impl Fn(ParameterId, ParameterId) -> Option<f64>) -> Option<Self> {
        let encoder_harmonics = Some(TermGroup::EncoderHarmonics);
        let remains_valid = |id: ParameterId| !id.block().of_run || id.term() == encoder_harmonics;
        let columns: Vec<(usize, ParameterId)> = self
            .model
            .columns()
            .enumerate()
            .map(|(column, parameter)| (column, parameter.id))
            .filter(|(_, id)| remains_valid(*id) && between(*id, *id).is_some_and(|variance| variance > 0.0))
            .collect();
        if columns.is_empty() {
            return None;
        }
        let covariance = DMatrix::from_fn(columns.len(), columns.len(), |i, j| {
            between(columns[i].1, columns[j].1).unwrap_or_default()
        });
        let information = ScaledCholesky::new(covariance)?.inverse();
        for (i, (row, _)) in columns.iter().enumerate() {
            for (j, (column, _)) in columns.iter().enumerate() {
                // The calibration already includes the priors.
                self.prior.matrix[(*row, *column)] = information[(i, j)];
            }
        }
        Some(self)
    }

    /// The information for another run, with the bar at another position, after a run with these normal equations. `None` if that
    /// leaves a parameter undetermined.
    #[must_use]
    pub fn after_run(&self, normal: &Normal) -> Option<Self> {
        let covariance = self.covariance_of(normal)?;
        let between = |a, b| Some(covariance[(self.model.column_of(a)?, self.model.column_of(b)?)]);
        self.clone().after(between)
    }

    /// Normal equations of poses that are `period_s` apart; each represents all samples of its period.
    pub fn of(&self, poses: &Visited, period_s: f64) -> Normal {
        let folds = [(0..poses.bar_rad.len()).collect()];
        let normal = self.with_problem(poses, |problem, start| {
            let normals = Normals::new(problem, start, &Options::default(), &folds).ok()?;
            normals.of_folds().first().cloned()
        });
        let mut normal = normal.unwrap_or_else(|| Normal::zeros(self.columns()));
        normal.matrix *= period_s * self.samples_per_s;
        normal
    }

    /// Calls `evaluate` with the least-squares problem of these poses and its start values.
    fn with_problem<T>(
        &self,
        poses: &Visited,
        evaluate: impl FnOnce(&LoopProblem<'_, WhitenedPose, Vec<JointState>>, &[f64]) -> Option<T>,
    ) -> Option<T> {
        let Visited { bar_rad, robot: motion } = poses;
        let observation = |(i, bar): (usize, &[f64; 5])| Observation::bar(PerObservation::time_s(i), *bar);
        let observations: Vec<Observation> = bar_rad.iter().enumerate().map(observation).collect();
        let residual = WhitenedPose::new(&self.model.geometry(&[]), motion, &observations, self.noise);
        let problem = LoopProblem::new(&self.model, motion, &observations, residual, 1.0).ok()?;
        evaluate(&problem, &self.model.start())
    }

    /// Optimal parts of time of these poses in a run of this length, without motion between them, for the mean squared position
    /// error over the workspace with all terms of the axes \[m²\]. `None` if they leave a parameter undetermined.
    pub fn optimum(&self, poses: &Visited, duration_s: f64) -> Option<Optimum> {
        let (_, rows) = self.with_problem(poses, |problem, start| stacked(problem, start))?;
        let mut prior = self.prior.matrix.clone();
        if let Some(column) = self.plate_column {
            prior[(column, column)] += KNOWN_SIGMA.powi(-2);
        }
        let mut weight = DMatrix::zeros(self.columns(), self.columns());
        for (i, &row) in self.link_columns.iter().enumerate() {
            for (j, &column) in self.link_columns.iter().enumerate() {
                weight[(row, column)] = self.weight[(i, j)];
            }
        }
        optimum(&prior, (&rows, WhitenedPose::ROWS), duration_s * self.samples_per_s, &weight)
    }

    /// Number of columns of the normal equations.
    pub fn columns(&self) -> usize {
        self.model.columns().len()
    }

    /// Expected covariance of all columns with the priors, with some columns fixed; `None` if the poses leave a column
    /// undetermined.
    fn covariance<'c>(
        &self,
        normal: &Normal,
        fixed: impl IntoIterator<Item = &'c usize>,
    ) -> Option<DMatrix<f64>> {
        let mut normal = normal.clone();
        normal += &self.prior;
        for &column in fixed {
            normal.matrix[(column, column)] += KNOWN_SIGMA.powi(-2);
        }
        let factor = ScaledCholesky::new(normal.matrix)?;
        factor.is_complete().then(|| factor.inverse())
    }

    /// Expected covariance of all columns, SI; `None` if a parameter is undetermined.
    pub fn covariance_of(&self, normal: &Normal) -> Option<DMatrix<f64>> {
        self.covariance(normal, [])
    }

    /// Criterion of normal equations, smaller is better; infinite if a parameter is undetermined. The plate counts as known,
    /// because its contribution is the same for all paths.
    pub fn score(&self, normal: &Normal) -> f64 {
        self.criterion_value(normal, self.criterion, &self.plate_column)
    }

    fn criterion_value<'c>(
        &self,
        normal: &Normal,
        criterion: Criterion,
        fixed: impl IntoIterator<Item = &'c usize>,
    ) -> f64 {
        let Some(covariance) = self.covariance(normal, fixed) else { return f64::INFINITY };
        let of_links = covariance.select_rows(&self.link_columns).select_columns(&self.link_columns);
        match criterion {
            Criterion::Position => (&self.weight * of_links).trace().max(0.0).sqrt(),
            Criterion::Determinant => {
                // Half of the logarithm of the determinant: the geometric mean of the ellipsoid's axes.
                let Some(factor) = of_links.cholesky() else { return f64::INFINITY };
                let half_log: f64 = factor.l().diagonal().iter().map(|entry| entry.ln()).sum();
                (half_log / self.link_columns.len().max(1) as f64).exp()
            }
            Criterion::Worst => {
                let effect = |i: usize| (self.weight[(i, i)] * of_links[(i, i)]).max(0.0).sqrt();
                (0..self.link_columns.len()).map(effect).fold(0.0, f64::max)
            }
        }
    }

    /// Expected position errors after a calibration on a path.
    pub fn position(&self, normal: &Normal) -> ExpectedPosition {
        ExpectedPosition {
            axes_exact_m: self.position_with(normal, &[]),
            with_terms_m: self.criterion_value(normal, Criterion::Position, &self.plate_column),
            with_plate_m: self.criterion_value(normal, Criterion::Position, []),
        }
    }

    /// Expected RMS position error over the workspace after a calibration that estimates terms of these groups \[m\].
    pub fn position_with(&self, normal: &Normal, groups: &[TermGroup]) -> f64 {
        let others = self.term_columns.iter().filter(|(group, _)| !groups.contains(group));
        let fixed = others.map(|(_, column)| column).chain(&self.plate_column);
        self.criterion_value(normal, Criterion::Position, fixed)
    }

    /// [`Self::position_with`] for each candidate group alone.
    pub fn with_each(&self, normal: &Normal) -> Vec<WithTerms> {
        let mut groups: Vec<TermGroup> = self.term_columns.iter().map(|(group, _)| *group).collect();
        groups.dedup();
        let alone = |group| WithTerms { group, position_m: self.position_with(normal, &[group]) };
        groups.into_iter().map(alone).collect()
    }

    /// Groups of link parameters of which the data determine only a combination: offsets along parallel axes, and parameters
    /// with a combination that their priors determine better. A group of one is a parameter that the data do not determine.
    pub fn not_separated(&self, normal: &Normal) -> Vec<Vec<ParameterId>> {
        let Some(covariance) = self.covariance_of(normal) else { return Vec::new() };
        let links = self.link_columns.len();
        let relative_covariance = DMatrix::from_fn(links, links, |i, j| {
            let [row, column] = [self.link_columns[i], self.link_columns[j]];
            covariance[(row, column)] / (self.prior_sigmas[row] * self.prior_sigmas[column])
        });
        let eigen = relative_covariance.symmetric_eigen();
        // Projector on the directions that the priors determine: more than half of their prior variance remains.
        let mut by_prior = DMatrix::<f64>::zeros(links, links);
        for (direction, remaining) in eigen.eigenvectors.column_iter().zip(eigen.eigenvalues.iter()) {
            if *remaining > 0.5 {
                by_prior += direction * direction.transpose();
            }
        }
        let ids: Vec<ParameterId> = self.model.columns().map(|parameter| parameter.id).collect();
        let named = |group: Vec<usize>| -> Vec<ParameterId> {
            let columns = group.into_iter().map(|row| self.link_columns[row]);
            // The plate has its measured uncertainty for every path.
            columns.filter(|column| Some(*column) != self.plate_column).map(|column| ids[column]).collect()
        };
        let of_data = combined(&by_prior).into_iter().map(named).filter(|group| !group.is_empty());
        inseparable_offsets(&self.model.geometry(&[]).robot).into_iter().chain(of_data).collect()
    }

    /// Name and expected standard deviation of each parameter, SI, in the order of the columns.
    pub fn sigmas(&self, normal: &Normal) -> Vec<(ParameterId, f64)> {
        let Some(covariance) = self.covariance_of(normal) else { return Vec::new() };
        let sigma = |column: usize| covariance[(column, column)].max(0.0).sqrt();
        self.model.columns().enumerate().map(|(column, parameter)| (parameter.id, sigma(column))).collect()
    }
}

/// Mean of `J^T J` of the end's position over postures within the joint limits \[m²\].
fn position_weight(arm: &Chain, columns: &[(usize, ParameterId)], joint_limits: &[[f64; 2]]) -> DMatrix<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let tracer = Tracer::new(arm);
    let mut trace = Trace::default();
    let mut rows = DMatrix::zeros(3 * POSTURES, columns.len());
    for posture in 0..POSTURES {
        tracer.trace(&Joints::random(joint_limits, &mut random), &mut trace);
        let mut jacobian = rows.rows_mut(3 * posture, 3);
        for (mut column, (_, id)) in jacobian.column_iter_mut().zip(columns) {
            if let ParameterId::Robot { link, parameter } = *id
                && let Some(twist) = trace.twist(link, parameter)
            {
                column.copy_from(&twist.linear);
            }
        }
    }
    rows.tr_mul(&rows) / POSTURES as f64
}
