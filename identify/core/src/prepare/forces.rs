//! Computes the force along the bar at each sample, from a force log.
//!
//! A force log contains one of four quantities: the force along the bar, only its sign, a force vector in the frame of base
//! or flange, or joint torques (`torque`). Each sample receives the force at its time, as component along the bar. Samples
//! without a force are removed. A solve estimates the compliance or play of the bar from these forces.
//!
//! The force is computed only once, with the clocks and the base of the preparation. A solve changes the clocks by fractions
//! of a millisecond, in which the force changes little. Nominal geometry is accurate enough for the direction of the force.

use nalgebra::Vector3;
use serde::Serialize;
use shared::time::UtcNs;

use super::torque::{TorqueSample, forces_from_torques};
use super::{AlignedLog, Alignment};
use crate::kinematics::{Chain, Joints};
use crate::logs::{ForceClock, ForceKind, ForceLog, Row};
use crate::model::{BarForce, JointState, Observation, ParameterId, RobotMotion};
use crate::statistics::extremes;

/// Force at which the bar has moved about three quarters of the way from the middle to one side of its play \[N\].
const SIDE_N: f64 = 5.0;
/// If the force varies by less than this during a run, it contains no information \[N\].
const RANGE_MIN_N: f64 = 2.0;
/// Largest possible force on a ball-bar \[N\].
const FORCE_MAX_N: f64 = 20_000.0;
/// Half the time over which the robot's speeds and accelerations are computed from differences \[s\].
const RATE_REACH_S: f64 = 0.02;
/// Smallest fraction of the samples that must have a force.
const COVERED_MIN: f64 = 0.5;
/// If only the sign of the force is known: smallest fraction of the samples that must be under tension, and
/// smallest fraction under compression.
const EITHER_SIDE_MIN: f64 = 0.02;

/// The force on the bar in the samples of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BarForces {
    /// The measured quantity and its frame.
    pub kind: ForceKind,
    /// The clock of the force log's stamps.
    pub clock: ForceClock,
    /// Number of samples at times that the force log does not cover. These samples are left out.
    pub uncovered: usize,
    /// Smallest and largest force along the bar, with the signs of the log \[N\]. If only signs are known,
    /// smallest and largest sign.
    pub range: [f64; 2],
    /// Root mean square of the joint torques that gravity, friction, inertia and the force do not explain \[N m\]; `None` if
    /// the log does not contain torques.
    pub torque_rms_nm: Option<f64>,
}

impl BarForces {
    /// The parameter that a solve can estimate from these forces.
    pub fn parameter(&self) -> ParameterId {
        match self.kind {
            ForceKind::Sign => ParameterId::BarPlay,
            _ => ParameterId::BarCompliance,
        }
    }

    /// Unit of the range: `N`, or an empty text for signs.
    pub const fn unit(&self) -> &'static str {
        if matches!(self.kind, ForceKind::Sign) { "" } else { "N" }
    }
}

/// Why a force cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ForceError {
    /// The force log does not cover enough samples, because its stamps are on another clock or the log is of another run.
    #[error(
        "the force log covers {covered} of {samples} samples: on the {clock}'s clock it lasts from {from_s:+.1} to \
         {to_s:+.1} s, the samples from {first_s:+.1} to {last_s:+.1} s (about the middle of the run); check that it is \
         of this run and that its stamps are on that clock, which a line `# clock: bar` or `# clock: robot` states"
    )]
    NotCovered {
        /// Samples with a force.
        covered: usize,
        /// Number of all samples.
        samples: usize,
        /// `robot` or `bar`.
        clock: &'static str,
        /// Time of the first force \[s\].
        from_s: f64,
        /// Time of the last force \[s\].
        to_s: f64,
        /// Time of the first sample \[s\].
        first_s: f64,
        /// Time of the last sample \[s\].
        last_s: f64,
    },
    /// The force does not vary enough.
    #[error(
        "the {what} hardly varies ({low:.2} to {high:.2}{unit}) and carries no information; check column and unit, or \
         calibrate without it (--ignore-force)"
    )]
    Flat {
        /// Kind of force, in words.
        what: &'static str,
        /// Smallest value of the run.
        low: f64,
        /// Largest value of the run.
        high: f64,
        /// Unit with a blank before it.
        unit: &'static str,
    },
    /// The force is larger than a bar can bear, so its unit is probably wrong.
    #[error("the {what} reaches {most:.0} N, more than a ball-bar can bear; check its unit")]
    TooLarge {
        /// Kind of force, in words.
        what: &'static str,
        /// Largest absolute value of the force \[N\].
        most: f64,
    },
    /// The motion is not sufficient to separate the force from gravity and friction.
    #[error(
        "the joint torques do not determine the force along the bar: robot and bar moved too little to separate it from \
         gravity and friction; measure the force itself, or calibrate without it (--ignore-force)"
    )]
    Torques,
}

/// Properties of robot, clocks and bar that are needed to convert a measured force to the force along the bar.
pub(super) struct ForceContext<'a> {
    /// Reference time on the bar's clock.
    pub t_ref: UtcNs,
    /// The relation of robot clock and bar clock at the reference time.
    pub alignment: &'a Alignment,
    /// The robot's motion as a function of robot time since the reference time.
    pub motion: &'a AlignedLog,
    /// Chain of the nominal robot.
    pub robot: &'a Chain,
    /// Centre of the gimbal in the robot's base \[m\].
    pub base_m: Vector3<f64>,
    /// Direction of gravity in the robot's base frame.
    pub gravity: Vector3<f64>,
}

/// Adds the force to each sample, and removes samples without a force. Also returns, for each of the original samples,
/// whether it had a force.
///
/// # Errors
/// [`ForceError`] if the force log does not cover the samples, or if its values cannot be forces on a bar.
pub(super) fn put_on(
    observations: &mut Vec<Observation>,
    log: &ForceLog,
    around: &ForceContext<'_>,
) -> Result<(BarForces, Vec<bool>), ForceError> {
    let row_at = |observation: &Observation| log.values.at(around.log_time_s(log, observation.t_s));
    let rows: Vec<Option<Joints>> = observations.iter().map(row_at).collect();
    let covered = rows.iter().flatten().count();
    let samples = observations.len();
    if (covered as f64) < COVERED_MIN * samples as f64 {
        return Err(around.not_covered(log, observations, covered));
    }
    let has_force: Vec<bool> = rows.iter().map(Option::is_some).collect();
    let mut keep = has_force.iter();
    observations.retain(|_| keep.next().is_some_and(|has_force| *has_force));
    let rows: Vec<Joints> = rows.into_iter().flatten().collect();
    let (along, torque_rms_nm) = around.along_bar(log.kind, observations, &rows)?;
    let range = check(log.kind, &along)?;
    for (observation, &along) in observations.iter_mut().zip(&along) {
        observation.force = match log.kind {
            ForceKind::Sign => BarForce { along_n: 0.0, side: along },
            _ => BarForce { along_n: along, side: (along / SIDE_N).tanh() },
        };
    }
    let forces =
        BarForces { kind: log.kind, clock: log.clock, uncovered: samples - covered, range, torque_rms_nm };
    Ok((forces, has_force))
}

/// Checks the forces along the bar, and returns the smallest and the largest one.
fn check(kind: ForceKind, along: &[f64]) -> Result<[f64; 2], ForceError> {
    let [low, high] = extremes(along.iter().copied());
    let what = kind.describe();
    if kind == ForceKind::Sign {
        let least = EITHER_SIDE_MIN * along.len() as f64;
        let enough = |is_on_side: fn(&&f64) -> bool| along.iter().filter(is_on_side).count() as f64 >= least;
        if enough(|side| **side > 0.5) && enough(|side| **side < -0.5) {
            return Ok([low, high]);
        }
        return Err(ForceError::Flat { what, low, high, unit: "" });
    }
    if low.abs().max(high.abs()) > FORCE_MAX_N {
        return Err(ForceError::TooLarge { what, most: low.abs().max(high.abs()) });
    }
    if high - low < RANGE_MIN_N {
        return Err(ForceError::Flat { what, low, high, unit: " N" });
    }
    Ok([low, high])
}

impl ForceContext<'_> {
    /// Converts a bar time since the reference time to a time since the first stamp of the force log \[s\].
    fn log_time_s(&self, log: &ForceLog, t_s: f64) -> f64 {
        let (reference_ns, rate) = match log.clock {
            ForceClock::Bar => (self.t_ref.0, 1.0),
            ForceClock::Robot => {
                (self.t_ref.0.saturating_add(self.alignment.clock_difference_ns), 1.0 + self.alignment.skew)
            }
        };
        // Integer stamps have more digits than a float, so they are subtracted before the conversion.
        let since_first_s = (i128::from(reference_ns) - i128::from(log.values.first_stamp_ns)) as f64 * 1e-9;
        since_first_s + rate * t_s
    }

    /// State of the robot at a bar time since the reference time. Speeds and accelerations are differences over a few
    /// hundredths of a second. Differences from one row of the robot's log to the next would be mostly noise, and the sign
    /// of the computed friction would change with the noise.
    fn state(&self, t_s: f64) -> JointState {
        let state_later = |by_s: f64| self.motion.at(t_s + self.alignment.skew * t_s + by_s);
        let here = state_later(0.0).unwrap_or_default();
        let (before, after) = (state_later(-RATE_REACH_S), state_later(RATE_REACH_S));
        let (Some(before), Some(after)) = (before, after) else { return here };
        let speed = |i: usize| (after.q[i] - before.q[i]) / (2.0 * RATE_REACH_S);
        let acceleration =
            |i: usize| (after.q[i] - 2.0 * here.q[i] + before.q[i]) / (RATE_REACH_S * RATE_REACH_S);
        JointState { q: here.q, qd: here.q.with_numbers(speed), qdd: here.q.with_numbers(acceleration) }
    }

    /// The error for a force log that covers too few samples. The times in the error count from the reference time.
    fn not_covered(&self, log: &ForceLog, observations: &[Observation], covered: usize) -> ForceError {
        let middle_s = self.log_time_s(log, 0.0);
        ForceError::NotCovered {
            covered,
            samples: observations.len(),
            clock: log.clock.name(),
            from_s: -middle_s,
            to_s: log.values.duration_s() - middle_s,
            first_s: observations.first().map_or(0.0, |sample| sample.t_s),
            last_s: observations.last().map_or(0.0, |sample| sample.t_s),
        }
    }

    /// Converts each row of the force log to the component along the bar, in the direction from the gimbal to the flange.
    /// Also returns the root mean square of the unexplained torques, if the log contains torques \[N m\].
    fn along_bar(
        &self,
        kind: ForceKind,
        observations: &[Observation],
        rows: &[Joints],
    ) -> Result<(Vec<f64>, Option<f64>), ForceError> {
        let samples = observations.iter().zip(rows);
        if kind == ForceKind::JointTorques {
            let torque_sample = |(observation, row): (&Observation, &Joints)| {
                let state = self.state(observation.t_s);
                TorqueSample::new(self.robot, self.base_m, self.gravity, &state, *row)
            };
            let torques: Vec<TorqueSample> = samples.map(torque_sample).collect();
            let found = forces_from_torques(&torques).ok_or(ForceError::Torques)?;
            return Ok((found.along_n, Some(found.rms_nm)));
        }
        let component = |(observation, row): (&Observation, &Joints)| {
            // A row with a single number contains the component along the bar, or its sign.
            let &[x, y, z] = row.as_ref() else { return row[0] };
            let force = Vector3::new(x, y, z);
            let end = self.robot.forward(&self.state(observation.t_s).q);
            let direction = (end.translation.vector - self.base_m).normalize();
            if kind == ForceKind::InFlange {
                direction.dot(&(end.rotation * force))
            } else {
                direction.dot(&force)
            }
        };
        Ok((samples.map(component).collect(), None))
    }
}
