//! The sensed double ball-bar: the aligned logs of a run, and one of five costs. The residual of each sample (`cost/bar`) is
//! the difference between the end of the robot and the end of the bar. A cost uses only those coordinates of this difference
//! that the available encoders determine.

use super::repetition::independent_segments;
use super::{Cause, Deviation, Instrument, Measures, Noise, ScaleFrom};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::cost::{
    AngleNoise, CostError, DataSet, FoundNoise, Length, LoopProblem, Position, PositionAngles, ROD_JOINT,
    Residual, Transform, WhitenedPose, WhitenedPoseOfFour, fill_in, loop_closures,
};
use crate::kinematics::{BAR_JOINTS, Chain, LinkParameter};
use crate::model::{
    Axis, ClockRelation, Geometry, JointState, Model, ModelError, Observation, Parameter, ParameterId,
    RobotMotion, Role,
};
use crate::prepare::Prepared;
use crate::solver::LossName;

/// Cost functions that need a ball-bar.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum CostName {
    /// Position and rotation, weighted by the noise of all angles; needs all five encoders, or all but that of joint 3.
    Pose,
    /// All entries of the difference between the transforms of robot and bar (thesis eq. 2.4); needs all five encoders.
    Transform,
    /// Position and two angles of the cardan (thesis eq. 2.3); needs encoders 1, 2, 4 and 5.
    PositionAngles,
    /// Position (thesis eq. 2.2); needs encoders 1 and 2.
    Position,
    /// Distance from the bar's base minus the length of the bar (thesis eq. 2.1); needs no encoder.
    Length,
}

impl CostName {
    /// All costs, in decreasing order of the number of parameters that they identify.
    pub const ALL: [Self; 5] =
        [Self::Pose, Self::Transform, Self::PositionAngles, Self::Position, Self::Length];

    /// Bar joints whose encoders are required, from 0.
    pub const fn encoders(self) -> &'static [usize] {
        match self {
            Self::Pose => WhitenedPoseOfFour::ENCODERS,
            Self::Transform => Transform::ENCODERS,
            Self::PositionAngles => PositionAngles::ENCODERS,
            Self::Position => Position::ENCODERS,
            Self::Length => Length::ENCODERS,
        }
    }

    /// The cost of the thesis that has the same residuals without weights. Used to find the
    /// parameters that a set of poses can identify.
    pub(crate) fn unweighted(self, measured: &[bool; BAR_JOINTS]) -> Self {
        match self {
            Self::Pose if lacks_rod_encoder(measured) => Self::PositionAngles,
            Self::Pose => Self::Transform,
            other => other,
        }
    }

    /// The cost that uses as many of the available encoders as possible.
    pub fn for_encoders(measured: &[bool; BAR_JOINTS]) -> Self {
        match measured {
            [true, true, _, true, true] => Self::Pose,
            [true, true, ..] => Self::Position,
            _ => Self::Length,
        }
    }

    /// Default loss. The costs of the thesis have no robust loss, because they are sums of squares.
    pub const fn usual_loss(self) -> LossName {
        match self {
            Self::Pose => LossName::Huber,
            _ => LossName::None,
        }
    }

    /// Name in files and reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pose => "pose",
            Self::Transform => "transform",
            Self::PositionAngles => "position_angles",
            Self::Position => "position",
            Self::Length => "length",
        }
    }

    /// Whether the cost identifies a parameter, see [`Residual::identifies`]. `measured` states for each
    /// bar joint whether it has an encoder.
    pub fn identifies(self, measured: &[bool; BAR_JOINTS], id: ParameterId, robot: &Chain) -> bool {
        match self {
            Self::Pose if lacks_rod_encoder(measured) => WhitenedPoseOfFour::identifies(id, robot),
            Self::Pose => WhitenedPose::identifies(id, robot),
            Self::Transform => Transform::identifies(id, robot),
            Self::PositionAngles => PositionAngles::identifies(id, robot),
            Self::Position => Position::identifies(id, robot),
            Self::Length => Length::identifies(id, robot),
        }
    }
}

/// Whether encoder 3, which measures the rotation about the rod, is missing. The cost `pose` does not require it.
const fn lacks_rod_encoder(measured: &[bool; BAR_JOINTS]) -> bool {
    !measured[ROD_JOINT]
}

/// White noise of the angles, from which the weights of the cost `pose` are computed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NoiseConfig {
    /// Standard deviation of each bar encoder \[urad\].
    pub encoder_urad: f64,
    /// Standard deviation of each robot joint \[urad\].
    pub robot_urad: f64,
}

impl Default for NoiseConfig {
    fn default() -> Self {
        Self { encoder_urad: 5.0, robot_urad: 15.0 }
    }
}

impl From<NoiseConfig> for AngleNoise {
    fn from(config: NoiseConfig) -> Self {
        Self { encoder_rad: config.encoder_urad * 1e-6, robot_rad: config.robot_urad * 1e-6 }
    }
}

/// One run of the ball-bar, with the cost that is minimised.
#[derive(Debug, Clone)]
pub struct BallBar {
    /// Aligned logs of robot and bar.
    pub prepared: Prepared,
    /// The cost that is minimised.
    pub cost: CostName,
    /// Configured noise of the angles, for the cost `pose`.
    pub configured: NoiseConfig,
    /// Noise estimated from the residuals. `None` before the first estimate.
    pub estimated: Option<FoundNoise>,
    /// For each bar joint, whether it has an encoder in all runs that are solved together.
    pub measured: [bool; BAR_JOINTS],
    /// Standard uncertainty of each known length of the bar \[m\]. The known lengths determine the scale.
    pub sigmas_m: Vec<(ParameterId, f64)>,
}

impl BallBar {
    /// Noise of the angles. Before the first estimate it is the configured noise, afterwards the estimated one.
    pub fn angle_noise(&self) -> AngleNoise {
        self.estimated.map_or_else(|| self.configured.into(), |estimate| estimate.noise)
    }

    /// The residuals of all samples, divided by `sigma`.
    fn loop_problem<'a, R: Residual + 'a>(
        &'a self,
        model: &'a Model,
        residual: R,
        sigma: f64,
    ) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let Prepared { motion, observations, .. } = &self.prepared;
        Ok(Box::new(LoopProblem::new(model, motion, observations, residual, sigma)?))
    }
}

impl Measures for BallBar {
    fn name(&self) -> &'static str {
        "ball-bar"
    }

    fn cost(&self) -> &'static str {
        self.cost.name()
    }

    fn residual_unit_of(&self) -> Option<CostName> {
        Some(self.cost)
    }

    fn scale(&self) -> ScaleFrom {
        ScaleFrom::Plate
    }

    fn noise(&self) -> Noise {
        Noise::Angles(self.angle_noise())
    }

    /// The robot's end minus the bar's end: the position, and for the costs `pose` and `transform` also the rotation. For
    /// the cost `length`: the distance of the robot's end from the gimbal, minus the bar's length.
    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        let Prepared { motion, observations, .. } = &self.prepared;
        let mut closures = loop_closures(geometry, motion, observations).into_iter().peekable();
        let deviation = |observation: &Observation| {
            // A sample outside the robot's log has no residual. Its deviation is NaN.
            let closure = closures.next_if(|closure| closure.t_s == observation.t_s);
            let Some(closure) = closure else { return Deviation::of_place(Vector3::repeat(f64::NAN)) };
            let position = Deviation::of_place(closure.position_error_m);
            match self.cost {
                CostName::Length => Deviation::of_length(closure.off_sphere_m),
                CostName::Position | CostName::PositionAngles => position,
                CostName::Pose | CostName::Transform => {
                    Deviation { rotation_rad: Some(closure.turned_rad.norm()), ..position }
                }
            }
        };
        observations.iter().map(deviation).collect()
    }

    fn causes(&self, _: &Geometry) -> Vec<Cause> {
        let encoder = |link| {
            let id = ParameterId::Bar { link, parameter: LinkParameter::Theta };
            Cause::new(format!("the encoder of joint {}", link + 1), [id])
        };
        let base = Cause::new("the base of the bar", Axis::ALL.map(|axis| ParameterId::Base { axis }));
        (0..BAR_JOINTS).map(encoder).chain([base, Cause::clock()]).collect()
    }

    fn time_s(&self, sample: usize) -> Option<f64> {
        self.prepared.observations.get(sample).map(|observation| observation.t_s)
    }

    fn first_s(&self) -> Option<f64> {
        Some(self.prepared.first_s)
    }

    /// Two reasons: another encoder map than the recorded one is used, or the motion repeats itself.
    fn doubts(&self, _: &Geometry) -> Vec<String> {
        let used = &self.prepared.encoder_map.used;
        let other_map = (!used.is_as_recorded()).then(|| {
            format!(
                "Joints or directions of the encoders differ from those in the recording. Used instead (recorded joint -> joint): \
                 {used}. Check which encoder is plugged into which terminal, and correct ball_bar.toml."
            )
        });
        let repeats = "The motion repeats itself: another alignment in time fits nearly as well. Use a path that does not repeat, or \
                       log robot and bar for longer.";
        let repeats = self.prepared.alignment.ambiguous.then(|| repeats.to_owned());
        other_map.into_iter().chain(repeats).collect()
    }

    fn prepared(&self) -> Option<&Prepared> {
        Some(&self.prepared)
    }

    fn autocorrelation(&self) -> Option<[f64; 2]> {
        self.estimated.map(|estimate| [estimate.autocorrelation, estimate.autocorrelation_sigma])
    }

    fn samples(&self) -> usize {
        self.prepared.observations.len()
    }

    /// Sets the roles of the known lengths only. The preparation sets start values, and the
    /// configuration sets the other roles.
    ///
    /// With the cost `pose`, each known length gets a prior. The other costs would decrease if all lengths became shorter.
    /// Therefore known lengths stay fixed with these costs, and their uncertainty is considered.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        for &(id, sigma) in &self.sigmas_m {
            let Some(&Parameter { nominal: value, role, .. }) = model.parameter(id) else { continue };
            if self.cost == CostName::Pose && !fix.contains(&id) {
                model.set_role(id, Role::Prior { value, sigma })?;
            } else if !role.is_estimated() {
                model.set_role(id, Role::Considered { sigma })?;
            }
        }
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let Prepared { motion, observations, .. } = &self.prepared;
        let geometry = || model.geometry(&[]);
        let noise = self.angle_noise();
        match self.cost {
            CostName::Pose if lacks_rod_encoder(&self.measured) => {
                let residual = WhitenedPoseOfFour::new(&geometry(), motion, observations, noise);
                self.loop_problem(model, residual, sigma)
            }
            CostName::Pose => {
                self.loop_problem(model, WhitenedPose::new(&geometry(), motion, observations, noise), sigma)
            }
            CostName::Transform => self.loop_problem(model, Transform, sigma),
            CostName::PositionAngles => self.loop_problem(model, PositionAngles, sigma),
            CostName::Position => self.loop_problem(model, Position, sigma),
            CostName::Length => self.loop_problem(model, Length, sigma),
        }
    }

    fn reported(&self, sample: usize, clock: &ClockRelation) -> Option<JointState> {
        let t_s = self.prepared.observations.get(sample)?.t_s;
        self.prepared.motion.at(clock.robot_time_s(t_s))
    }

    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool {
        self.cost.identifies(&self.measured, id, robot)
    }

    /// Sets the angles of bar joints without encoder to the values that follow from the robot's pose. Returns `None`,
    /// because [`Measures::learn_noise`] estimates the noise.
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        if !self.cost.encoders().is_empty() {
            fill_in(&model.geometry(&[]), &self.prepared.motion, &mut self.prepared.observations);
        }
        None
    }

    fn learn_noise(&mut self, model: &Model) {
        if self.cost != CostName::Pose {
            return;
        }
        let Prepared { motion, observations, .. } = &self.prepared;
        let (geometry, columns) = (model.geometry(&[]), model.columns().count());
        let start = self.configured.into();
        self.estimated = if lacks_rod_encoder(&self.measured) {
            WhitenedPoseOfFour::noise(&geometry, motion, observations, columns, start)
        } else {
            WhitenedPose::noise(&geometry, motion, observations, columns, start)
        };
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        let times_s: Vec<f64> = self.prepared.observations.iter().map(|one| one.t_s).collect();
        independent_segments(&self.prepared.motion, &times_s, count)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        let observations = samples.iter().map(|&sample| self.prepared.observations[sample]).collect();
        let prepared = Prepared { observations, ..self.prepared.clone() };
        Self { prepared, ..self.clone() }.into()
    }
}
