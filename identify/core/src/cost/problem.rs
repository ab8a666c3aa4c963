//! [`LoopProblem`] applies a cost to the samples of one data set. The result is a least-squares problem for the solver.
//!
//! For parameter values `x` the model provides the geometry, from which a [`LoopPoint`] prepares both chains. For
//! each sample, [`LoopPoint`] interpolates the robot's joints at the sample's time and computes both chains. A
//! [`Scene`] contains these two chains. The cost computes residual and derivatives from the scene. Both are then
//! divided by the standard deviation of the residual.
//!
//! Known properties of an instrument ([`Knowns`], such as the distance between two sockets) are additional samples after the
//! measured ones. Their residuals are already in units of their standard deviations.

use nalgebra::Vector3;

use super::{DataSet, Residual, Scene};
use crate::instrument::Knowns;
use crate::kinematics::{BAR_JOINTS, Chain, ROD_LINK, Trace, Tracer, Turn};
use crate::model::{Geometry, Model, MovingJoints, Observation, ParameterId, RobotMotion};
use crate::solver::{LeastSquares, Linearisation, Prior};

/// Reason why a cost cannot use the observations.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CostError {
    /// An encoder that the cost needs is missing.
    #[error(
        "cost `{cost}` needs the encoder of bar joint {joint}, sample {sample} has none; choose another cost"
    )]
    NoEncoder {
        /// Name of the cost.
        cost: &'static str,
        /// Bar joint, counted from 1.
        joint: usize,
        /// Index of the sample, from 0.
        sample: usize,
    },
    /// A measured value is not finite.
    #[error("sample {sample} has a value that is not finite; remove it from the data")]
    NotFinite {
        /// Index of the sample, from 0.
        sample: usize,
    },
    /// The standard deviation of the residual must be positive.
    #[error("the standard deviation of a residual is {sigma}; give a number above zero")]
    BadSigma {
        /// The standard deviation as given.
        sigma: f64,
    },
}

/// The closed chain of robot and instrument as a least-squares problem.
#[derive(Debug)]
pub struct LoopProblem<'a, R, M> {
    model: &'a Model,
    motion: &'a M,
    observations: &'a [Observation],
    /// Sines and cosines of the readings of the bar's encoders, which are constant in a solve.
    readings: Vec<[Turn; BAR_JOINTS]>,
    residual: R,
    /// Parameter of each column.
    ids: Vec<ParameterId>,
    /// The numbers `0, 1, 2 ..`. They assign parameter `i` to column `i` if this problem is solved alone.
    own_columns: Vec<usize>,
    priors: Vec<Prior>,
    /// One over the standard deviation of a residual entry.
    whitening: f64,
    /// Known properties of the instrument.
    knowns: Option<&'a dyn Knowns>,
}

impl<'a, R: Residual, M: RobotMotion> LoopProblem<'a, R, M> {
    /// Creates the problem. `sigma` is the standard deviation of a residual entry, in the unit of the residual.
    /// Residuals are divided by `sigma`. Scales of robust losses are therefore in units of standard deviations. With a
    /// `sigma` of one, the residual is that of the cost.
    ///
    /// # Errors
    /// [`CostError`] if the observations do not contain the values that the cost needs, or if `sigma` is not positive.
    pub fn new(
        model: &'a Model,
        motion: &'a M,
        observations: &'a [Observation],
        residual: R,
        sigma: f64,
    ) -> Result<Self, CostError> {
        if !(sigma.is_finite() && sigma > 0.0) {
            return Err(CostError::BadSigma { sigma });
        }
        observations
            .iter()
            .enumerate()
            .try_for_each(|(sample, observation)| check_observation::<R>(sample, observation))?;
        let readings = observations.iter().map(readings).collect();
        let ids = model.columns().map(|parameter| parameter.id).collect();
        let own_columns = (0..model.columns().len()).collect();
        let priors = model.priors();
        let whitening = sigma.recip();
        Ok(Self {
            model,
            motion,
            observations,
            readings,
            residual,
            ids,
            own_columns,
            priors,
            whitening,
            knowns: None,
        })
    }

    /// Adds known properties of the instrument as further samples.
    #[must_use]
    pub fn with_knowns(self, knowns: &'a dyn Knowns) -> Self {
        Self { knowns: Some(knowns), ..self }
    }
}

/// Sines and cosines of the readings of the bar's encoders.
pub(super) fn readings(observation: &Observation) -> [Turn; BAR_JOINTS] {
    observation.bar_rad.map(Turn::from_angle)
}

/// Checks that the observation contains all values that the cost needs, and that they are finite.
fn check_observation<R: Residual>(sample: usize, observation: &Observation) -> Result<(), CostError> {
    for &joint in R::ENCODERS {
        if !observation.measured.get(joint).copied().unwrap_or(false) {
            return Err(CostError::NoEncoder { cost: R::NAME, joint: joint + 1, sample });
        }
    }
    let encoders = R::ENCODERS.iter().filter_map(|&joint| observation.bar_rad.get(joint));
    let force = [&observation.force.along_n, &observation.force.side];
    if encoders.chain([&observation.t_s]).chain(force).all(|value| value.is_finite()) {
        Ok(())
    } else {
        Err(CostError::NotFinite { sample })
    }
}

/// Both chains, prepared for one set of parameters. The fields `joints`, `robot` and `bar` are buffers for the current sample.
#[derive(Debug)]
pub struct LoopPoint {
    geometry: Geometry,
    robot_tracer: Tracer,
    bar_chain: Chain,
    bar_tracer: Tracer,
    /// y axis of the bar's base after the base's rotation about x, in the root frame.
    base_y: Vector3<f64>,
    joints: MovingJoints,
    robot: Trace,
    bar: Trace,
}

impl LoopPoint {
    pub(super) fn new(geometry: Geometry) -> Self {
        let bar_chain = geometry.bar_chain();
        Self {
            robot_tracer: Tracer::new(&geometry.robot),
            bar_tracer: Tracer::new(&bar_chain),
            bar_chain,
            base_y: Vector3::new(0.0, geometry.base.rx_rad.cos(), geometry.base.rx_rad.sin()),
            geometry,
            joints: MovingJoints::default(),
            robot: Trace::default(),
            bar: Trace::default(),
        }
    }

    /// Computes both chains at one observation. `None` if the robot's log does not cover the observation.
    pub(super) fn scene<'a>(
        &'a mut self,
        motion: &impl RobotMotion,
        sample: usize,
        observation: &'a Observation,
        readings: &'a [Turn; BAR_JOINTS],
    ) -> Option<Scene<'a>> {
        if !self.geometry.joints_at(motion, observation.t_s, &mut self.joints) {
            return None;
        }
        // Compute the bar joints: readings corrected by offsets of the counter origin and by encoder errors.
        let joints = &self.joints;
        let errors_rad = self.geometry.encoder_errors_rad(readings);
        let origin_offsets_rad = self.geometry.offsets_of_origin(observation.origin);
        let correction_rad: [f64; BAR_JOINTS] =
            std::array::from_fn(|joint| origin_offsets_rad[joint] - errors_rad[joint]);
        let bar_joints =
            readings.iter().zip(correction_rad).map(|(reading, rad)| reading.and(Turn::from_angle(rad)));
        // Set the length of the rod, elongated by the force and by the direction of the bar.
        if let Some(rod) = self.geometry.bar_links.get(ROD_LINK) {
            let rod_m = rod.d_m + self.geometry.extension_m(&observation.force, readings);
            self.bar_tracer.set_d(ROD_LINK, rod_m);
            if let Some(rod) = self.bar_chain.links.get_mut(ROD_LINK) {
                rod.d_m = rod_m;
            }
        }
        self.robot_tracer.trace(&joints.corrected.q, &mut self.robot);
        self.bar_tracer.trace_turns(bar_joints, &mut self.bar);
        Some(Scene {
            geometry: &self.geometry,
            sample,
            observation,
            readings,
            bar_rad: std::array::from_fn(|joint| observation.bar_rad[joint] + correction_rad[joint]),
            bar_chain: &self.bar_chain,
            bar_tracer: &self.bar_tracer,
            joints,
            robot: &self.robot,
            bar: &self.bar,
            robot_rate: self.robot.moved_by(&joints.corrected.qd),
            base_y: self.base_y,
        })
    }
}

impl<R: Residual, M: RobotMotion> LoopProblem<'_, R, M> {
    /// Linearises the samples of the observations, for the geometry at the current parameters.
    fn linearised<'a>(&'a self, geometry: Geometry, columns: &'a [usize]) -> Linearisation<'a> {
        let mut point = LoopPoint::new(geometry);
        Box::new(move |sample, residual, block| {
            let (Some(observation), Some(readings)) =
                (self.observations.get(sample), self.readings.get(sample))
            else {
                return false;
            };
            let Some(scene) = point.scene(self.motion, sample, observation, readings) else { return false };
            let Some(local) = self.residual.local(&scene) else { return false };
            self.residual.residual(&scene, &local, residual);
            for (&column, &id) in columns.iter().zip(&self.ids) {
                self.residual.derivative(&scene, &local, id, block.column_mut(column));
            }
            if self.whitening != 1.0 {
                residual.iter_mut().for_each(|r| *r *= self.whitening);
                block.scale(self.whitening);
            }
            true
        })
    }
}

impl<R: Residual, M: RobotMotion> DataSet for LoopProblem<'_, R, M> {
    fn at_into<'a>(&'a self, x: &[f64], columns: &'a [usize]) -> Linearisation<'a> {
        let geometry = self.model.geometry(x);
        let Some(knowns) = self.knowns else { return self.linearised(geometry, columns) };
        let mut linearise_observation = self.linearised(geometry.clone(), columns);
        Box::new(move |sample, residual, block| {
            let Some(known) = sample.checked_sub(self.observations.len()) else {
                return linearise_observation(sample, residual, block);
            };
            let Some((value, derivatives)) = knowns.known(known, &geometry) else { return false };
            residual.copy_from_slice(value.as_slice());
            for (&column, id) in columns.iter().zip(&self.ids) {
                let Some(known_column) = knowns.column(*id) else { continue };
                let derivative = derivatives.column(known_column);
                block.column_mut(column).iter_mut().zip(derivative.iter()).for_each(|(to, from)| *to = *from);
            }
            true
        })
    }
}

impl<R: Residual, M: RobotMotion> LeastSquares for LoopProblem<'_, R, M> {
    fn columns(&self) -> usize {
        self.ids.len()
    }

    fn column_name(&self, column: usize) -> String {
        self.ids.get(column).map_or_else(|| format!("column {column}"), ToString::to_string)
    }

    fn samples(&self) -> usize {
        self.observations.len() + self.knowns.map_or(0, |knowns| knowns.knowns())
    }

    fn rows(&self) -> usize {
        R::ROWS
    }

    fn rows_of(&self, sample: usize) -> usize {
        let known = self.knowns.zip(sample.checked_sub(self.observations.len()));
        known.map_or(R::ROWS, |(knowns, known)| knowns.rows_of(known))
    }

    fn is_known(&self, sample: usize) -> bool {
        sample >= self.observations.len()
    }

    fn priors(&self) -> &[Prior] {
        &self.priors
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        self.at_into(x, &self.own_columns)
    }
}
