//! Simulates experiments with known true parameters. Results are the readings of the bar's encoders and the robot's log.
//!
//! 1. A path is defined by the bar's joints ([`crate::plan`]), so the robot's end is always on the bar's sphere.
//! 2. The robot's joints follow from the inverse kinematics of its *true* chain.
//! 3. Encoder counts and robot log are sampled from this motion, each on its own clock.
//! 4. [`Effects`] adds errors that no estimator models.
//!
//! Simulation and estimator share only the kinematics and the names of parameters. If they shared more, an error in the
//! shared code would cancel in a simulation and remain undetected.

mod arm;
mod comparison;
pub mod contact;
mod effects;
mod motion;
mod pairs;
mod probing;
mod rows;
mod sample;
pub mod touch;
mod truth;
mod wire;
mod write;

pub use arm::ArmErrors;
pub use comparison::{ComparedParameter, Comparison, position_errors_m, true_model};
pub use effects::Effects;
use effects::{BarEncoders, RobotReading};
pub use motion::{BarLoad, BarPath, Motion, PathLoad};
pub use pairs::{LEAD_ROWS, Pairs, pairs};
pub use rows::{RowSimulationError, RowTruth, SimulatedRows};
pub use truth::{ClockTruth, EncoderTruth, StaticErrors, THESIS_ERRORS, Truth, parameter_names};
pub use wire::{ATTACHMENT_M, wire_rows};
pub use write::{SimulationFiles, SimulationWriteError, write};

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};
use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::time::UtcNs;

use crate::kinematics::{Chain, InverseError, Joints, ball_bar_chain, robot_chain};
use crate::logs::RobotLog;
pub use crate::plan::Design;
use crate::plan::{Constraints, Path, PlanError, PlannedPath, Route, random_route};

/// The clocks of robot and bar, and how they are related.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Clocks {
    /// Time of the first bar sample \[UTC ns\].
    pub bar_start: UtcNs,
    /// Reading of the robot's clock at the first bar sample \[ns\], with an arbitrary origin.
    pub robot_at_bar_start_ns: i64,
    /// Rate of the robot's clock relative to the bar's clock, minus one.
    pub skew: f64,
}

impl Default for Clocks {
    /// A run in 2026. The robot's controller was started 1.03 hours before the run, and its clock is 25 ppm fast.
    fn default() -> Self {
        Self {
            bar_start: UtcNs(1_780_000_000_000_000_000),
            robot_at_bar_start_ns: 3_712_345_678_901,
            skew: 25e-6,
        }
    }
}

/// All inputs of a simulated experiment. Equal experiments give equal results, bit for bit.
#[derive(Debug, Clone)]
pub struct Experiment<'a> {
    /// Configuration of the nominal robot.
    pub robot: &'a RobotConfig,
    /// Nominal ball-bar with its encoders.
    pub bar: &'a BallBarConfig,
    /// Position of the bar and limits of the motion.
    pub design: Design,
    /// Errors of the true parameters, relative to the nominal parameters.
    pub errors: StaticErrors,
    /// Additional errors of single parameters by name \[mm|mrad\].
    pub added_errors: BTreeMap<String, f64>,
    /// Effects that no estimator models.
    pub effects: Effects,
    /// Force along the bar and its effect on the bar's length. The robot's log contains the force.
    pub load: BarLoad,
    /// Clocks of bar and robot.
    pub clocks: Clocks,
    /// Path of the experiment; `None` for a random path.
    pub path: Option<PlannedPath>,
    /// Seed of path, encoder offsets and noise.
    pub seed: u64,
    /// Seed of the phases of gear and encoder harmonics; `None` to use `seed`. Two experiments with the same `robot_seed`
    /// and different values of `seed` are two runs of the same robot and bar.
    pub robot_seed: Option<u64>,
}

impl<'a> Experiment<'a> {
    /// The default experiment with this robot and bar. It includes only the static errors of the thesis.
    pub fn new(robot: &'a RobotConfig, bar: &'a BallBarConfig) -> Self {
        Self {
            robot,
            bar,
            design: Design::for_robot(robot),
            errors: StaticErrors::Thesis,
            added_errors: BTreeMap::new(),
            effects: Effects::default(),
            load: BarLoad::default(),
            clocks: Clocks::default(),
            path: None,
            seed: 1,
            robot_seed: None,
        }
    }
}

/// Result of a simulated experiment.
#[derive(Debug, Clone)]
pub struct Simulated {
    /// The bar's recording: one valid record every 10 ms.
    pub cycles: Vec<CycleRecord>,
    /// Encoders in bus order.
    pub encoders: Vec<EncoderInfo>,
    /// The robot's log.
    pub robot_log: RobotLog,
    /// True parameters of robot and bar.
    pub truth: Truth,
    /// The error-free motion.
    pub motion: Motion,
}

/// Why an experiment cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError {
    /// The robot has fewer than six axes, so it cannot follow the bar.
    #[error(
        "{robot} has {axes} axes, a run on the ball-bar needs six or more; for any arm use `identify simulate contact`"
    )]
    Axes {
        /// Name of the robot.
        robot: String,
        /// Number of its axes.
        axes: usize,
    },
    /// The errors of the thesis are those of an arm with six axes.
    #[error("{robot} has {axes} axes, the errors of the thesis are for six; give --errors drawn, or none")]
    ThesisAxes {
        /// Name of the robot.
        robot: String,
        /// Number of its axes.
        axes: usize,
    },
    /// No random path was found.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The true robot cannot follow the path.
    #[error(
        "the robot cannot follow the bar {t_s:.3} s after the start: {source}; give smaller errors or another --base"
    )]
    Follow {
        /// Time on the path \[s\].
        t_s: f64,
        /// Error of the inverse kinematics.
        source: InverseError,
    },
    /// A size of an effect is negative or not finite.
    #[error("effects.{name} is {value_urad} urad; give a finite number that is not negative")]
    Effect {
        /// Key of the effect.
        name: &'static str,
        /// Value of the size.
        value_urad: f64,
    },
    /// The path has too few points or rows to interpolate.
    #[error(
        "the path has too few points to interpolate; increase `points` of the study, or give a longer path"
    )]
    Empty,
    /// A size of the force is negative or not finite.
    #[error("load.{name} is {value}; give a finite number that is not negative")]
    Load {
        /// Key of the size.
        name: &'static str,
        /// Value of the size.
        value: f64,
    },
}

/// Whether a number can be the size of an error or effect.
fn is_size(value: f64) -> bool {
    value.is_finite() && value >= 0.0
}

/// Independent streams of random numbers. Drawing more numbers from one stream does not change the others.
#[derive(Debug, Clone, Copy)]
enum RandomStream {
    Path = 1,
    StaticErrors = 2,
    EncoderOffsets = 3,
    RobotEffects = 4,
    EncoderEffects = 5,
    Load = 6,
    Postures = 7,
    Wire = 8,
}

fn random(seed: u64, stream: RandomStream) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream as u64);
    random
}

/// Simulates an experiment: computes the path, the true motion, the robot's log and the bar's recording.
///
/// # Errors
/// [`SimulateError`] if base, bar length and robot do not allow a path, or the size of an effect is invalid.
pub fn run(experiment: &Experiment<'_>) -> Result<Simulated, SimulateError> {
    let (path, start_rad) = experiment.drive()?;
    let (truth, motion, load_random) = experiment.motion(path, start_rad)?;
    let robot_log = sample::robot_log(experiment, &motion, load_random)?;
    let (cycles, encoders, encoder_truth) = sample::recording(experiment, &motion);
    let truth = Truth { encoders: encoder_truth, ..truth };
    Ok(Simulated { cycles, encoders, robot_log, truth, motion })
}

impl Experiment<'_> {
    /// The path of the experiment, and the nominal robot's joints at its start \[rad\].
    ///
    /// # Errors
    /// [`SimulateError::Plan`] if robot and bar do not allow a random path.
    pub fn drive(&self) -> Result<(Path, Joints), SimulateError> {
        self.check()?;
        if let Some(planned) = &self.path {
            return Ok((planned.path.clone(), planned.robot_start_rad));
        }
        let Self { robot, design, .. } = self;
        let [nominal_robot, nominal_bar] = self.nominal();
        let constraints = Constraints::new(&nominal_robot, &nominal_bar, &robot.joint_limits(), design);
        let Route { path, robot_rad } =
            random_route(&constraints, &mut random(self.seed, RandomStream::Path))?;
        Ok((path, robot_rad.first().copied().unwrap_or_default()))
    }

    /// Chains of the nominal robot and of the nominal bar on its base.
    fn nominal(&self) -> [Chain; 2] {
        let mut bar = ball_bar_chain(self.bar);
        bar.root_from_base = nalgebra::Translation3::from(self.design.base_m).into();
        [robot_chain(self.robot, self.bar), bar]
    }

    /// The true parameters, the motion of the true bar and robot along a path, and the random generator for the
    /// noise of the force.
    fn motion<P: BarPath>(
        &self,
        path: P,
        start_rad: Joints,
    ) -> Result<(Truth, Motion<P>, ChaCha8Rng), SimulateError> {
        self.check()?;
        let [nominal_robot, nominal_bar] = self.nominal();
        let mut truth = Truth::new(self, &nominal_robot, &nominal_bar);
        truth.parameters.extend(self.robot_reading().terms());
        let mut load_random = random(self.seed, RandomStream::Load);
        let motion = Motion {
            path,
            robot: truth.robot_chain(&nominal_robot),
            bar: truth.bar_chain(&nominal_bar),
            start_rad,
            limits: self.robot.joint_limits(),
            pull: PathLoad::new(self.load, &mut load_random),
        };
        Ok((truth, motion, load_random))
    }

    fn robot_reading(&self) -> RobotReading {
        let (phases, noise) = self.phases_and_noise(RandomStream::RobotEffects);
        RobotReading::new(self.robot, &self.effects, phases, noise)
    }

    fn bar_reading(&self) -> BarEncoders {
        let (phases, noise) = self.phases_and_noise(RandomStream::EncoderEffects);
        BarEncoders::new(&self.effects, phases, noise)
    }

    /// Random generators for the readings of robot or encoders. The first generates the phases of harmonics. The second
    /// generates the noise. It is `None` if `robot_seed` and `seed` are equal; the first then generates the noise as well.
    fn phases_and_noise(&self, stream: RandomStream) -> (ChaCha8Rng, Option<ChaCha8Rng>) {
        let robot_seed = self.robot_seed.unwrap_or(self.seed);
        (random(robot_seed, stream), (robot_seed != self.seed).then(|| random(self.seed, stream)))
    }

    /// Checks the number of axes and all sizes before the simulation.
    ///
    /// # Errors
    /// [`SimulateError`].
    pub fn check(&self) -> Result<(), SimulateError> {
        self.effects.check()?;
        let axes = self.robot.axes();
        if axes < 6 {
            return Err(SimulateError::Axes { robot: self.robot.name.clone(), axes });
        }
        if axes > 6 && self.errors == StaticErrors::Thesis {
            return Err(SimulateError::ThesisAxes { robot: self.robot.name.clone(), axes });
        }
        let sizes = self.load.sizes();
        match sizes.iter().find(|(_, size)| !is_size(*size)) {
            Some(&(name, value)) => Err(SimulateError::Load { name, value }),
            None => Ok(()),
        }
    }
}
