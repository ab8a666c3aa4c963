//! Computes the information of a path: the normal equations (Fisher information) of the parameters that a calibration would
//! estimate from it. From the normal equations follow the expected position error and the scalar criterion of every search
//! in this folder. Let `P` be the covariance of the parameters, and `W` the mean of `J^T J` over the workspace, where `J`
//! are the derivatives of positions. The position error is `sqrt(tr(W P))`.
//!
//! Each pose contributes the residual of the `pose` cost at the nominal geometry, divided by the residual's standard
//! deviation. Noise is white, and the number of samples is that of a calibration. Encoder harmonics and all terms of the
//! robot's axes are included with their priors. A calibration includes a term only if held-out data support it, so a
//! calibration is slightly more accurate than expected here. Errors that no parameter describes are not included.

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

/// Number of random postures over which position errors are averaged.
const POSTURES: usize = 300;
/// Sampling rate of the recording \[1/s\].
const SAMPLES_PER_S: f64 = 100.0;

/// Standard deviation of parameters that are treated as known, SI.
const KNOWN_SIGMA: f64 = 1e-9;

/// Expected RMS position errors over the robot's workspace after a calibration \[m\]. They are infinite if a parameter is
/// undetermined, for example the position of the bar or a clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExpectedPosition {
    /// Error if the robot's axes have no errors beyond their links, and the plate's length is known.
    pub axes_exact_m: f64,
    /// Error if all terms of the axes are estimated with their priors, and the plate's length is known.
    pub with_terms_m: f64,
    /// Error as in `with_terms_m`, if the plate's length is uncertain in addition. All estimated lengths are proportional
    /// to the plate's length.
    pub with_plate_m: f64,
}

/// Quantity that a plan minimises.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Criterion {
    /// RMS position error over the robot's workspace (I-optimal)
    #[default]
    Position,
    /// Volume of the confidence ellipsoid of the robot's parameters (D-optimal)
    Determinant,
    /// Largest RMS position error over the workspace that the uncertainty of a single robot parameter causes
    Worst,
}

/// Expected position error if only the terms of one group are estimated.
#[derive(Debug, Clone, PartialEq)]
pub struct WithTerms {
    /// Group of the terms.
    pub group: TermGroup,
    /// RMS position error over the workspace \[m\].
    pub position_m: f64,
}

/// The parameters of a calibration, their priors, and their effect on positions.
#[derive(Debug, Clone)]
pub struct Information {
    model: Model,
    noise: AngleNoise,
    /// Number of samples per second that a calibration keeps \[1/s\].
    samples_per_s: f64,
    /// Normal equations of the priors. They are added to those of every path.
    prior: Normal,
    /// Prior standard deviation of each column, SI; infinite without a prior.
    prior_sigmas: Vec<f64>,
    /// Columns of the robot's links.
    link_columns: Vec<usize>,
    /// The matrix `W`: mean of `J^T J` over the workspace, where `J` are the derivatives of positions with respect to the
    /// columns of the links \[m²\].
    weight: DMatrix<f64>,
    criterion: Criterion,
    /// Columns of the candidate terms (errors of the robot's axes and of the bar's length), with their groups.
    term_columns: Vec<(TermGroup, usize)>,
    /// Column of the plate's length. Paths do not determine this length, so the relative uncertainty of all lengths is
    /// that of the plate.
    plate_column: Option<usize>,
}

/// Poses of a path or a sample: joints of bar and robot.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Visited {
    /// Joints of the bar \[rad\].
    pub bar_rad: Vec<[f64; 5]>,
    /// Joints of the robot and their speeds.
    pub robot: Vec<JointState>,
}

impl Information {
    /// Prepares the information of runs with the length `duration_s`. Parameters and number of samples are those of a
    /// calibration with default settings.
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
        let mut model = Model::ball_bar(arm, bar_chain).with_drives(DriveTrain::from_robot(robot, arm));
        let identifies = WhitenedPose::identifies;
        config.set_roles(&mut model, &[], identifies)?;
        let mut terms = Vec::new();
        for group in config.groups(&model, |id| identifies(id, arm)) {
            terms.extend(group.ids.iter().map(|id| (group.group, *id)));
            model.set_roles(group.ids, Role::Prior { value: 0.0, sigma: group.sigma })?;
        }
        // Every complete run determines the clock skew well, so it is not estimated here.
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

    /// The information for a new run, after a calibration has determined the parameters. `between` returns the covariance of
    /// two parameters in that calibration, or `None` if the calibration did not identify one of them. The new run estimates
    /// position of the bar, encoder offsets and clocks again.
    ///
    /// Returns `None` if the calibration identified none of the parameters, or if its covariance is not positive definite.
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
                // The information from the calibration replaces the priors, because it already includes them.
                self.prior.matrix[(*row, *column)] = information[(i, j)];
            }
        }
        Some(self)
    }

    /// The information for a second run with the bar at another position. `normal` are the normal equations of the first
    /// run. `None` if the first run leaves a parameter undetermined.
    #[must_use]
    pub fn after_run(&self, normal: &Normal) -> Option<Self> {
        let covariance = self.covariance_of(normal)?;
        let between = |a, b| Some(covariance[(self.model.column_of(a)?, self.model.column_of(b)?)]);
        self.clone().after(between)
    }

    /// Normal equations of poses that are `period_s` apart. Each pose represents all samples of its period.
    pub fn normal(&self, poses: &Visited, period_s: f64) -> Normal {
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

    /// Optimal fractions of a run's time for each of these poses, assuming that the motion between poses takes no time. The
    /// fractions minimise the mean squared position error over the workspace \[m²\], when all terms of the axes are
    /// estimated. `None` if the poses leave a parameter undetermined.
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

    /// Expected covariance of all columns, with the priors. The columns `fixed` are treated as known. `None` if the poses
    /// leave a column undetermined.
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

    /// Expected covariance of all columns, SI; `None` if the poses leave a parameter undetermined.
    pub fn covariance_of(&self, normal: &Normal) -> Option<DMatrix<f64>> {
        self.covariance(normal, [])
    }

    /// Value of the criterion for normal equations; smaller is better. Infinite if a parameter is undetermined. The plate
    /// is treated as known, because its contribution is the same for all paths.
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
                // The sum of logarithms is half of the logarithm of the determinant. The result is the geometric mean
                // of the ellipsoid's semi-axes.
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

    /// Expected RMS position error over the workspace after a calibration that estimates the terms of
    /// these groups only \[m\].
    pub fn position_with(&self, normal: &Normal, groups: &[TermGroup]) -> f64 {
        let others = self.term_columns.iter().filter(|(group, _)| !groups.contains(group));
        let fixed = others.map(|(_, column)| column).chain(&self.plate_column);
        self.criterion_value(normal, Criterion::Position, fixed)
    }

    /// [`Self::position_with`] for each candidate group alone, without the other groups.
    pub fn with_each(&self, normal: &Normal) -> Vec<WithTerms> {
        let mut groups: Vec<TermGroup> = self.term_columns.iter().map(|(group, _)| *group).collect();
        groups.dedup();
        let alone = |group| WithTerms { group, position_m: self.position_with(normal, &[group]) };
        groups.into_iter().map(alone).collect()
    }

    /// Groups of link parameters of which the data determine only a combination. There are two types of groups: offsets
    /// along parallel axes, and parameters with a combination that the priors determine better than the data do. A parameter
    /// that the data do not determine at all forms a group of its own.
    pub fn not_separated(&self, normal: &Normal) -> Vec<Vec<ParameterId>> {
        let Some(covariance) = self.covariance_of(normal) else { return Vec::new() };
        let links = self.link_columns.len();
        let relative_covariance = DMatrix::from_fn(links, links, |i, j| {
            let [row, column] = [self.link_columns[i], self.link_columns[j]];
            covariance[(row, column)] / (self.prior_sigmas[row] * self.prior_sigmas[column])
        });
        // The priors determine the directions in which more than half of the prior variance remains.
        let by_prior = combined(relative_covariance, |remaining| remaining > 0.5);
        let ids: Vec<ParameterId> = self.model.columns().map(|parameter| parameter.id).collect();
        let named = |group: Vec<usize>| -> Vec<ParameterId> {
            let columns = group.into_iter().map(|row| self.link_columns[row]);
            // The plate is omitted, because its measured uncertainty is the same for every path.
            columns.filter(|column| Some(*column) != self.plate_column).map(|column| ids[column]).collect()
        };
        let of_data = by_prior.into_iter().map(named).filter(|group| !group.is_empty());
        inseparable_offsets(&self.model.geometry(&[]).robot).into_iter().chain(of_data).collect()
    }

    /// Name and expected standard deviation of each parameter, SI, in the order of the columns.
    pub fn sigmas(&self, normal: &Normal) -> Vec<(ParameterId, f64)> {
        let Some(covariance) = self.covariance_of(normal) else { return Vec::new() };
        let sigma = |column: usize| covariance[(column, column)].max(0.0).sqrt();
        self.model.columns().enumerate().map(|(column, parameter)| (parameter.id, sigma(column))).collect()
    }
}

/// Mean of `J^T J` over random postures within the joint limits, where `J` are the derivatives of the end's position with
/// respect to `columns` \[m²\].
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
