//! Fits clocks, base and offsets to the angles. The result is more accurate than the correlation of speeds, and is valid
//! for runs of hours.
//!
//! The residual of a joint is `sin(margin) (b^ - b - offset)`. `b^` is the angle that follows from the robot's pose
//! (the *implied* angle), and `b` is the angle of the encoder. `margin` is the distance from singular poses, so samples
//! near singular poses have small weights. The nominal geometry has errors of millimetres. If the geometry were fixed,
//! these errors would hide the shift of the clocks, the offsets of a new origin, or a slipped encoder. All parameters
//! of both chains are therefore fitted too, each with a prior for its tolerance. The fitted chains are used only to
//! classify the samples ([`Residuals`]).

use std::sync::Arc;

use nalgebra::{Vector3, Vector5};

use super::clock::{EDGE_S, SHIFT_SIGMA_S, SKEW_SIGMA};
use crate::cost::{LoopProblem, Movement, Residual, Scene};
use crate::kinematics::{
    BAR_JOINTS, Chain, DhLink, ImpliedBar, Joints, LinkParameter, Trace, Tracer, Turn,
    singularity_margin_rad, wrapped,
};
use crate::logs::CubicSpline;
use crate::model::{
    ClockRelation, Geometry, Group, Model, ModelError, Observation, ParameterId, RobotMotion, Role,
};
use crate::prepare::AlignedLog;
use crate::prepare::samples::angle_errors::AngleErrors;
use crate::solver::{
    GoodShare, LeastSquares, Linearisation, Loss, Options, Prior, Schedule, Summary, minimise,
};
use crate::statistics::mean;
use crate::threads::rows;

/// Standard deviation of the parameters of the nominal chains \[m, rad\].
const CHAIN_SIGMA: f64 = 2e-3;
/// Standard deviation of the position of the base, which was found as centre of the sphere through the robot's positions \[m\].
const BASE_SIGMA_M: f64 = 0.01;
/// Standard deviation of the tilt of the bar's base \[rad\].
const TILT_SIGMA_RAD: f64 = 0.01;
/// Standard deviation of the amplitudes of the encoders' harmonics \[rad\].
const HARMONIC_SIGMA_RAD: f64 = 50e-6;
/// Standard deviation of the offsets that were found with nominal geometry \[rad\].
const OFFSET_SIGMA_RAD: f64 = 0.05;
/// How the robust loss is narrowed from round to round. The loss is wide at first, so that nearly all samples have weight.
/// If a clock steps during the run, the fit with the wide loss may converge to a compromise between the samples before and
/// after the step. A narrower loss is therefore tried, with which the fit converges to the larger of these two groups. The
/// number of rounds suffices to reduce the spread from a radian to a microradian.
const SCHEDULE: Schedule = Schedule {
    good: [GoodShare::NINE_TENTHS, GoodShare::HALF],
    narrowing: 0.5,
    better_max: Some(0.8),
    rounds_max: 30,
};
/// A round ends if an iteration reduces the cost by less than this fraction. The next round continues from the same parameters.
const ROUND_TOLERANCE: f64 = 1e-3;
/// The last round ends if an iteration reduces the cost by less than this fraction. The cost of a few thousand samples is a
/// few thousand, so such a small decrease moves no parameter by more than about a tenth of its standard deviation.
const LAST_TOLERANCE: f64 = 1e-6;
/// Smallest assumed standard deviation of a residual \[rad\]; smaller residuals are rounding errors.
const SIGMA_MIN_RAD: f64 = 1e-7;

/// Clock, geometry and offsets that fit both logs.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::prepare) struct AlignmentFit {
    /// Converts bar times, counted as in the samples of the fit, to times since the first stamp of the robot's log.
    pub clock: ClockRelation,
    /// Fitted chains and base.
    pub geometry: Geometry,
    /// Corrections to be added to the offsets, by origin \[rad\].
    pub offsets_by_rad: Vec<[f64; BAR_JOINTS]>,
    /// Robust standard deviation of the residual of an angle, estimated from the median over the samples \[rad\].
    pub sigma_rad: f64,
    /// The same standard deviation, estimated from the 90 % quantile \[rad\]. It is larger than `sigma_rad` if more than a
    /// tenth of the samples do not fit.
    pub sigma_of_most_rad: f64,
    /// Whether the fit converged to a minimum. Its residuals show errors of the run only if it did.
    pub converged: bool,
}

/// Residuals: implied minus measured joints. Weights are small near singular poses, where errors of the geometry are amplified.
#[derive(Debug, Clone, Copy)]
struct ImpliedAngles {
    measured: [bool; BAR_JOINTS],
}

/// The bar at one sample, computed from the robot's pose.
struct Implied {
    bar: ImpliedBar,
    /// Weight of each joint.
    weights: [f64; BAR_JOINTS],
}

impl ImpliedAngles {
    /// Weight of each joint at the bar joints `bar_rad`; 0 for joints without encoder.
    fn weights(&self, bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        let weight = singularity_margin_rad(bar_links, bar_rad).sin();
        self.measured.map(|measured| if measured { weight } else { 0.0 })
    }
}

impl Residual for ImpliedAngles {
    type Local = Implied;

    const NAME: &'static str = "angles";
    const ROWS: usize = BAR_JOINTS;
    const ENCODERS: &'static [usize] = &[];

    fn depends_on(id: ParameterId, _: &Chain) -> bool {
        prior_sigma(id).is_some()
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Implied> {
        let (chain, tracer) = (scene.bar_chain, scene.bar_tracer);
        let measured_rad = &scene.observation.bar_rad;
        let encoders_rad = std::array::from_fn(|joint| self.measured[joint].then_some(measured_rad[joint]));
        let bar = ImpliedBar::new(chain, tracer, scene.robot.end(), &encoders_rad).ok()?;
        Some(Implied { bar, weights: self.weights(&chain.links, measured_rad) })
    }

    fn residual(&self, scene: &Scene<'_>, Implied { bar, weights }: &Implied, out: &mut [f64]) {
        for (joint, out) in out.iter_mut().enumerate() {
            *out = weights[joint] * wrapped(bar.joints_rad[joint] - scene.bar_rad[joint]);
        }
    }

    fn derivative(
        &self,
        scene: &Scene<'_>,
        Implied { bar, weights }: &Implied,
        id: ParameterId,
        out: &mut [f64],
    ) {
        if let ParameterId::EncoderWave { joint, order, phase } = id {
            out[joint] = weights[joint] * phase.wave(order, scene.readings[joint]);
            return;
        }
        let implied = match (scene.movement(id), id) {
            (Movement::Robot(twist), _) => bar.by_pose(&twist),
            (Movement::Bar(_), _) => {
                let link = if let ParameterId::Bar { link, .. } = id { Some(link) } else { None };
                let Some(twist) = scene.bar_twist(&bar.trace, id) else { return };
                bar.by_bar(link, &twist)
            }
            (Movement::None, _) => return,
        };
        for (joint, out) in out.iter_mut().enumerate() {
            *out = weights[joint] * implied[joint];
        }
    }
}

/// Standard deviation of a parameter about its start value; `None` for fixed parameters.
fn prior_sigma(id: ParameterId) -> Option<f64> {
    match id {
        // `theta` of a bar link is fixed, because it has the same effect as the offset of the encoder, which is
        // fitted. `beta` of a robot link is fixed too.
        ParameterId::Bar { parameter: LinkParameter::Theta, .. }
        | ParameterId::Robot { parameter: LinkParameter::Beta, .. } => None,
        ParameterId::Robot { .. } | ParameterId::Bar { .. } => Some(CHAIN_SIGMA),
        ParameterId::Base { .. } => Some(BASE_SIGMA_M),
        ParameterId::BaseRotation { .. } => Some(TILT_SIGMA_RAD),
        ParameterId::EncoderWave { .. } => Some(HARMONIC_SIGMA_RAD),
        ParameterId::ClockShift => Some(SHIFT_SIGMA_S),
        ParameterId::ClockSkew => Some(SKEW_SIGMA),
        _ => None,
    }
}

/// Least-squares problem with the residuals [`ImpliedAngles`]. The first columns are the parameters of the model: clocks,
/// base and both chains. The other columns are the offsets of the encoders, five for each origin:
///
/// ```text
/// | clocks, base, chains | origin 0: joints 1 to 5 | origin 1: joints 1 to 5 | ...
/// ```
struct WithOffsets<'a> {
    chains: LoopProblem<'a, ImpliedAngles, AlignedLog>,
    residual: ImpliedAngles,
    /// Links of the nominal bar, from which the weights are computed. The weights depend only on `theta`, which is not fitted.
    bar_links: &'a [DhLink],
    observations: &'a [Observation],
    chain_columns: usize,
    origin_count: usize,
    sigma_rad: f64,
    priors: Vec<Prior>,
}

impl LeastSquares for WithOffsets<'_> {
    fn columns(&self) -> usize {
        self.chain_columns + self.origin_count * BAR_JOINTS
    }

    fn samples(&self) -> usize {
        self.chains.samples()
    }

    fn rows(&self) -> usize {
        BAR_JOINTS
    }

    fn priors(&self) -> &[Prior] {
        &self.priors
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let (of_chains, of_offsets) = x.split_at(self.chain_columns.min(x.len()));
        let (mut linearised_chains, offsets) = (self.chains.at(of_chains), of_offsets.to_vec());
        Box::new(move |sample, residual, block| {
            let Some(observation) = self.observations.get(sample) else { return false };
            if !linearised_chains(sample, residual, block) {
                return false;
            }
            let weights = self.residual.weights(self.bar_links, &observation.bar_rad);
            for joint in 0..BAR_JOINTS {
                let slope = -weights[joint] / self.sigma_rad;
                let offset = observation.origin * BAR_JOINTS + joint;
                residual[joint] += slope * offsets.get(offset).copied().unwrap_or(0.0);
                if let Some(entry) = block.column_mut(self.chain_columns + offset).get_mut(joint) {
                    *entry = slope;
                }
            }
            true
        })
    }
}

/// Fits clocks, base, offsets and, within their tolerances, all parameters of both chains to `samples`.
///
/// `coarse` is the clock that was found so far, for the samples' times. If `start` is given, the fit starts from the
/// geometry of this earlier fit. Otherwise it starts from the nominal geometry, with the bar upright at `base_m`. `None` if
/// the samples do not determine the fit.
pub(in crate::prepare) fn refine(
    log: &Arc<CubicSpline<Joints>>,
    [robot, bar]: [&Chain; 2],
    base_m: Vector3<f64>,
    measured: &[bool; BAR_JOINTS],
    samples: &[Observation],
    coarse: ClockRelation,
    start: Option<&AlignmentFit>,
) -> Option<AlignmentFit> {
    // Times are counted from the mean of the samples' times, because shift and skew are then nearly independent.
    let middle_s = mean(samples.iter().map(|sample| sample.t_s));
    let motion = AlignedLog::new(log.clone(), coarse.robot_time_s(middle_s));
    let about_middle = samples.iter().map(|sample| Observation { t_s: sample.t_s - middle_s, ..*sample });
    let stays = |sample: &Observation| motion.covers((1.0 + coarse.skew) * sample.t_s, EDGE_S);
    let observations: Vec<Observation> = about_middle.filter(stays).collect();
    let origin_count = observations.iter().map(|sample| sample.origin + 1).max().unwrap_or(0);
    let model = prior_model(robot, bar, base_m, coarse.skew).ok()?;
    let residual = ImpliedAngles { measured: *measured };
    let chain_columns = model.columns().len();
    let mut x = model.start();
    let ids = model.columns().map(|parameter| parameter.id);
    if let Some(mut geometry) = start.map(|fit| fit.geometry.clone()) {
        // The clock starts from `coarse`, not from the earlier fit, because times are counted from another instant in each fit.
        for (x, id) in x.iter_mut().zip(ids).filter(|(_, id)| id.group() != Group::Clock) {
            *x = geometry.parameter_mut(id).map_or(*x, |value| *value);
        }
    }
    x.resize(chain_columns + origin_count * BAR_JOINTS, 0.0);
    // `spread_rad` estimates the standard deviation of a residual at the parameters `x`. `solve` improves `x` with a loss
    // for a given standard deviation, and `round` is such a solve with the tolerance of a round.
    let spread_rad = |x: &[f64], good: GoodShare| {
        residual_sigma_rad(&model, &motion, &observations, residual, x, good).max(SIGMA_MIN_RAD)
    };
    let solve = |x: &[f64], sigma_rad: f64, cost_tolerance: f64| -> Option<(Vec<f64>, Summary)> {
        let problem = WithOffsets {
            chains: LoopProblem::new(&model, &motion, &observations, residual, sigma_rad).ok()?,
            residual,
            bar_links: &bar.links,
            observations: &observations,
            chain_columns,
            origin_count,
            sigma_rad,
            priors: priors(&model, origin_count),
        };
        let loss = Loss::intermediate(1.0, BAR_JOINTS);
        minimise(&problem, x, &Options { loss, cost_tolerance, ..Options::default() }).ok()
    };
    let round = |x: &[f64], sigma_rad: f64| solve(x, sigma_rad, ROUND_TOLERANCE).map(|(x, _)| x).ok_or(());
    let (x, sigma_rad) = SCHEDULE.converge(x, spread_rad, round).ok()?;
    let (x, summary) = solve(&x, sigma_rad, LAST_TOLERANCE)?;
    let (chain, offsets) = x.split_at(chain_columns);
    let geometry = model.geometry(chain);
    let by_joint = |of_origin: &[f64]| std::array::from_fn(|joint| of_origin[joint]);
    Some(AlignmentFit {
        clock: motion.solved(geometry.clock).counted_from(-middle_s),
        geometry,
        offsets_by_rad: offsets.chunks_exact(BAR_JOINTS).map(by_joint).collect(),
        sigma_rad,
        sigma_of_most_rad: spread_rad(&x, GoodShare::NINE_TENTHS),
        converged: summary.termination.converged(),
    })
}

/// Model of nominal robot and bar in which each free parameter has its prior. The bar is upright at `base_m`.
fn prior_model(robot: &Chain, bar: &Chain, base_m: Vector3<f64>, skew: f64) -> Result<Model, ModelError> {
    let standing = Chain { root_from_base: nalgebra::Translation3::from(base_m).into(), ..bar.clone() };
    let mut model = Model::ball_bar(robot, &standing);
    model.set_value(ParameterId::ClockSkew, skew)?;
    let roles: Vec<(ParameterId, f64, f64)> = model
        .parameters()
        .iter()
        .filter_map(|parameter| Some((parameter.id, parameter.value, prior_sigma(parameter.id)?)))
        .collect();
    for (id, value, sigma) in roles {
        model.set_role(id, Role::Prior { value, sigma })?;
    }
    Ok(model)
}

/// Priors of the model's parameters and of the offsets.
fn priors(model: &Model, origin_count: usize) -> Vec<Prior> {
    let first = model.columns().len();
    let offsets = (0..origin_count * BAR_JOINTS).map(|offset| Prior {
        column: first + offset,
        value: 0.0,
        sigma: OFFSET_SIGMA_RAD,
    });
    model.priors().into_iter().chain(offsets).collect()
}

/// Robust standard deviation of a residual at the parameters `x`, estimated from the quantile `good` of the samples \[rad\].
fn residual_sigma_rad(
    model: &Model,
    motion: &AlignedLog,
    observations: &[Observation],
    residual: ImpliedAngles,
    x: &[f64],
    good: GoodShare,
) -> f64 {
    let (chain, offsets) = x.split_at(model.columns().len().min(x.len()));
    let residuals = Residuals::new(motion, model.geometry(chain), residual.measured);
    let encoders = residual.measured.iter().filter(|measured| **measured).count();
    let squared = rows(observations.len(), |sample| {
        let observation = &observations[sample];
        let mut bar_rad = observation.bar_rad;
        for (joint, angle) in bar_rad.iter_mut().enumerate() {
            *angle += offsets.get(observation.origin * BAR_JOINTS + joint).copied().unwrap_or(0.0);
        }
        let errors = residuals.errors(observation.t_s, &bar_rad)?;
        let weights = residual.weights(&residuals.bar.links, &bar_rad);
        let squared = errors.error_rad.iter().zip(weights).map(|(error, weight)| (weight * error).powi(2));
        Some((squared.sum(), encoders))
    });
    good.spread(squared.into_iter().flatten())
}

/// Computes the residuals of single samples at a fitted geometry.
pub(in crate::prepare) struct Residuals<'a> {
    motion: &'a AlignedLog,
    geometry: Geometry,
    robot_tracer: Tracer,
    bar: Chain,
    bar_tracer: Tracer,
    measured: [bool; BAR_JOINTS],
}

/// Comparison of the measured and the implied joints of one sample.
struct SampleErrors {
    /// Measured minus implied joints; 0 for joints without encoder \[rad\].
    error_rad: [f64; BAR_JOINTS],
    /// Speeds of the implied joints, from the speeds in the robot's log \[rad/s\].
    implied_rad_s: [f64; BAR_JOINTS],
    /// Distance of the bar from a singular pose \[rad\].
    margin_rad: f64,
}

impl<'a> Residuals<'a> {
    pub fn new(motion: &'a AlignedLog, geometry: Geometry, measured: [bool; BAR_JOINTS]) -> Self {
        let bar = geometry.bar_chain();
        let [robot_tracer, bar_tracer] = [&geometry.robot, &bar].map(Tracer::new);
        Self { motion, robot_tracer, bar_tracer, bar, geometry, measured }
    }

    /// Errors and speeds of a sample, multiplied by the sine of the distance from singular poses. `None` outside the robot's
    /// log or at a singular pose.
    pub fn of_sample(
        &self,
        sample: usize,
        origin: usize,
        t_s: f64,
        bar_rad: &[f64; BAR_JOINTS],
    ) -> Option<AngleErrors> {
        let errors = self.errors(t_s, bar_rad)?;
        let weight = errors.margin_rad.sin();
        let speed =
            |joint: usize| if self.measured[joint] { errors.implied_rad_s[joint] * weight } else { 0.0 };
        Some(AngleErrors {
            sample,
            t_s,
            origin,
            margin_rad: errors.margin_rad,
            error_rad: errors.error_rad.map(|error| error * weight),
            speed_rad_s: std::array::from_fn(speed),
        })
    }

    /// Whether the robot's log has values at bar time `t_s`.
    pub fn covers(&self, t_s: f64) -> bool {
        self.motion.at(self.geometry.clock.robot_time_s(t_s)).is_some()
    }

    /// Errors of a sample without weights. `None` outside the robot's log or at a singular pose.
    fn errors(&self, t_s: f64, bar_rad: &[f64; BAR_JOINTS]) -> Option<SampleErrors> {
        let state = self.motion.at(self.geometry.clock.robot_time_s(t_s))?;
        let mut robot = Trace::default();
        self.robot_tracer.trace(&self.geometry.corrected(&state).q, &mut robot);
        let encoders_rad = std::array::from_fn(|joint| self.measured[joint].then_some(bar_rad[joint]));
        let implied = ImpliedBar::new(&self.bar, &self.bar_tracer, robot.end(), &encoders_rad).ok()?;
        let encoder_error_rad = self.geometry.encoder_errors_rad(&bar_rad.map(Turn::from_angle));
        let error_rad = std::array::from_fn(|joint| {
            if self.measured[joint] {
                wrapped(bar_rad[joint] - encoder_error_rad[joint] - implied.joints_rad[joint])
            } else {
                0.0
            }
        });
        let rates = robot.joint_twists().zip(state.qd).map(|(twist, qd)| implied.by_pose(&twist) * qd);
        let implied_rad_s = rates.fold(Vector5::zeros(), |sum, rate| sum + rate).into();
        let margin_rad = singularity_margin_rad(&self.bar.links, &implied.joints_rad);
        Some(SampleErrors { error_rad, implied_rad_s, margin_rad })
    }
}
