//! [`LoopProblem`]: a cost over the samples of one data set, as a least-squares problem for the solver.
//!
//! At parameter values `x` the model gives the geometry. For each sample, [`LoopPoint`] reads the robot's joints at the
//! sample's time and traces both chains into a [`Scene`]; from it the cost computes residual and derivatives, which are then
//! divided by the residual's standard deviation. Known properties of an instrument ([`Knowns`], such as the distance between two
//! sockets) follow as one sample each, with their own standard deviation and derivatives by their own parameters.

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

/// The closed chain as a least-squares problem.
#[derive(Debug)]
pub struct LoopProblem<'a, R, M> {
    model: &'a Model,
    motion: &'a M,
    observations: &'a [Observation],
    /// Sines and cosines of the bar's readings, which are constant in a solve.
    readings: Vec<[Turn; BAR_JOINTS]>,
    residual: R,
    /// Parameter of each column.
    ids: Vec<ParameterId>,
    /// `0, 1, 2 ..`: each parameter in its own column.
    own_columns: Vec<usize>,
    priors: Vec<Prior>,
    /// One over the standard deviation of a residual entry.
    whitening: f64,
    /// Known properties of the instrument.
    knowns: Option<&'a dyn Knowns>,
}

impl<'a, R: Residual, M: RobotMotion> LoopProblem<'a, R, M> {
    /// `sigma` is the standard deviation of a residual entry in its own unit. Residuals are divided by it, so that priors and
    /// robust scales are in units of sigma. With `sigma` one and without priors the residual is as the cost defines it.
    ///
    /// # Errors
    /// [`CostError`] if the observations lack what the cost needs.
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

    /// The problem with known properties of the instrument as further samples.
    #[must_use]
    pub fn with_knowns(self, knowns: &'a dyn Knowns) -> Self {
        Self { knowns: Some(knowns), ..self }
    }
}

/// Sines and cosines of the readings of the bar's encoders.
pub(super) fn readings(observation: &Observation) -> [Turn; BAR_JOINTS] {
    observation.bar_rad.map(Turn::of)
}

/// Checks that the observation has finite values of all that the cost needs.
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

/// Chains prepared for one set of parameters, with scratch buffers.
#[derive(Debug)]
pub struct LoopPoint {
    geometry: Geometry,
    robot_tracer: Tracer,
    bar_chain: Chain,
    bar_tracer: Tracer,
    /// y axis of the bar's base after its rotation about x, in the root frame.
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

    /// Both chains at one observation; `None` if the robot's log does not cover it.
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
        let joints = &self.joints;
        let errors_rad = self.geometry.encoder_errors_rad(readings);
        let origin_offsets_rad = self.geometry.offsets_of_origin(observation.origin);
        let correction_rad: [f64; BAR_JOINTS] =
            std::array::from_fn(|joint| origin_offsets_rad[joint] - errors_rad[joint]);
        let bar_joints = readings.iter().zip(correction_rad).map(|(reading, rad)| reading.and(Turn::of(rad)));
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
    /// The observations as samples, for a geometry that was built from the parameters.
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
