//! Describes why a run was refused, for reports: where in the run the error is ([`Place`]), and the residuals
//! that show it ([`Deviations`]).

use super::align::refine::Residuals;
use super::samples::angle_errors::{AngleErrors, LocalShift, local_shifts};
use super::{PrepareError, Prepared};
use crate::kinematics::BAR_JOINTS;
use crate::model::{ClockRelation, Geometry, Observation};

/// Where in a run an error is, as far as it is known.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Place {
    /// Bar joint, 1 to 5.
    pub joint: Option<u8>,
    /// Bar time since the first valid sample \[s\].
    pub bar_s: Option<f64>,
    /// The same instant, as time since the first stamp of the robot's log \[s\]. It is known only after the
    /// alignment of the clocks.
    pub robot_s: Option<f64>,
}

/// Residuals of each encoder at the geometry that fits best. Errors of the model vary smoothly along the run. Faults of the
/// run, such as a clock step, appear as steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Deviations {
    /// Joints with an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// Samples in the order of time. Each entry contains the bar time since the first valid sample \[s\] and the residuals
    /// of the joints \[rad\]. A residual is the measured joint minus the joint that follows from the robot's pose, times the
    /// sine of the distance from singular poses.
    pub samples: Vec<(f64, [f64; BAR_JOINTS])>,
    /// How the alignment varies along the run. Times count from the first valid sample.
    pub local_shifts: Vec<LocalShift>,
    /// Converts times since the first valid sample to times since the first stamp of the robot's log.
    pub clock: ClockRelation,
}

impl Deviations {
    /// Makes times count from the first valid sample. The times of `errors` and `local_shifts` count from the reference
    /// time, which is `t_ref_s` after the first valid sample.
    pub(super) fn new(
        errors: &[AngleErrors],
        local_shifts: &[LocalShift],
        measured: [bool; BAR_JOINTS],
        t_ref_s: f64,
        clock: ClockRelation,
    ) -> Self {
        let later = |shift: &LocalShift| LocalShift { t_s: shift.t_s + t_ref_s, ..*shift };
        Self {
            measured,
            samples: errors.iter().map(|one| (one.t_s + t_ref_s, one.error_rad)).collect(),
            local_shifts: local_shifts.iter().map(later).collect(),
            clock,
        }
    }

    /// Computes the residuals of the samples of a solve at the geometry that the solve found.
    pub(crate) fn at(prepared: &Prepared, geometry: Geometry) -> Self {
        let (measured, first_s) = (prepared.measured, prepared.first_s);
        let since_reference = prepared.motion.solved(geometry.clock);
        let residuals = Residuals::new(&prepared.motion, geometry.clone(), measured);
        let offsets = |origin| geometry.offsets_of_origin(origin);
        let errors: Vec<AngleErrors> = (prepared.observations.iter().enumerate())
            .filter_map(|(sample, Observation { t_s, bar_rad, origin, .. })| {
                let offsets_rad = offsets(*origin);
                let bar_rad = std::array::from_fn(|joint| bar_rad[joint] + offsets_rad[joint]);
                residuals.of_sample(sample, *origin, *t_s, &bar_rad)
            })
            .collect();
        Self::new(&errors, &local_shifts(&errors), measured, -first_s, since_reference.counted_from(first_s))
    }
}

/// The angles do not fit, although all parameters of the geometry may change within their tolerances.
#[derive(Debug, Clone, PartialEq)]
pub struct PoorFit {
    /// Robust standard deviation of the residuals of each encoder, at the geometry that fits best \[rad\].
    pub spread_rad: [f64; BAR_JOINTS],
    /// Largest allowed standard deviation \[mrad\].
    pub limit_mrad: f64,
    /// Residuals from which the standard deviations were computed.
    pub deviations: Deviations,
}

impl PoorFit {
    /// The error for a run in which no change was found that explains the residuals.
    pub fn refusal(&self) -> PrepareError {
        let spreads = self.spread_rad.iter().enumerate().filter(|(_, spread_rad)| **spread_rad > 0.0);
        let spreads: Vec<String> = spreads
            .map(|(joint, spread_rad)| format!("{:.1} (joint {})", spread_rad * 1e3, joint + 1))
            .collect();
        let error = PrepareError::PoorFit { spreads: spreads.join(", "), limit_mrad: self.limit_mrad };
        error.resting_on(self.deviations.clone())
    }
}

impl PrepareError {
    /// Adds to this error the residuals that show it.
    pub(crate) fn resting_on(self, deviations: Deviations) -> Self {
        Self::WithDeviations { error: Box::new(self), deviations: Box::new(deviations) }
    }

    /// Joint and instant of the error in the run, as far as they are known.
    pub fn place(&self) -> Place {
        match self {
            Self::ClockJump { at_s, .. } | Self::JointStep { at_s, .. } | Self::BaseMoved { at_s, .. } => {
                Place { bar_s: Some(*at_s), ..Place::default() }
            }
            Self::EncoderSlip { joint, at_s, .. } | Self::EncoderFrozen { joint, from_s: at_s, .. } => {
                Place { joint: Some(*joint), bar_s: Some(*at_s), robot_s: None }
            }
            Self::LittleTravel { joint, .. } => Place { joint: Some(*joint), ..Place::default() },
            Self::WithDeviations { error, deviations } => {
                let place = error.place();
                Place { robot_s: place.bar_s.map(|bar_s| deviations.clock.robot_time_s(bar_s)), ..place }
            }
            _ => Place::default(),
        }
    }

    /// The instant at which clocks, base or offsets change, since the first valid sample \[s\]. The run can be cut there
    /// into two parts, each with its own clocks, base and offsets. `None` for other errors.
    pub fn parts_at_s(&self) -> Option<f64> {
        match self {
            Self::ClockJump { at_s, .. } | Self::EncoderSlip { at_s, .. } | Self::BaseMoved { at_s, .. } => {
                Some(*at_s)
            }
            Self::WithDeviations { error, .. } => error.parts_at_s(),
            _ => None,
        }
    }

    /// The residuals that show this error, if the error was found after the logs were aligned.
    pub fn deviations(&self) -> Option<&Deviations> {
        match self {
            Self::WithDeviations { deviations, .. } => Some(deviations),
            _ => None,
        }
    }

    /// Whether an option is invalid, independent of the data.
    pub fn is_mistyped(&self) -> bool {
        matches!(self, Self::StatedEncoderMap { .. })
    }
}
