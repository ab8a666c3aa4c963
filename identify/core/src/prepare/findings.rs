//! Places and deviations behind a refusal, for reports.

use super::align::refine::Residuals;
use super::samples::angle_errors::{AngleErrors, LocalShift, local_shifts};
use super::{PrepareError, Prepared};
use crate::kinematics::BAR_JOINTS;
use crate::model::{Clock, Geometry, Observation};

/// Where in a run something is wrong, if that is known.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Place {
    /// Bar joint, 1 to 5.
    pub joint: Option<u8>,
    /// Bar time since the first valid sample \[s\].
    pub bar_s: Option<f64>,
    /// The same instant after the first stamp of the robot's log \[s\], once the clocks are known.
    pub robot_s: Option<f64>,
}

/// Residuals of each encoder from the geometry that fits best: errors of the model are waves, faults of a run are steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Deviations {
    /// Joints with an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// In the order of time: bar time since the first valid sample \[s\], and measured less implied joints, each times the
    /// sine of the distance from singular poses \[rad\].
    pub samples: Vec<(f64, [f64; BAR_JOINTS])>,
    /// How the alignment varies along the run; times since the first valid sample.
    pub local_shifts: Vec<LocalShift>,
    /// Clock from those times to times after the first stamp of the robot's log.
    pub clock: Clock,
}

impl Deviations {
    /// `t_ref_s` is the reference time of `errors` and `local_shifts` after the first sample.
    pub(super) fn new(
        errors: &[AngleErrors],
        local_shifts: &[LocalShift],
        measured: [bool; BAR_JOINTS],
        t_ref_s: f64,
        clock: Clock,
    ) -> Self {
        let later = |shift: &LocalShift| LocalShift { t_s: shift.t_s + t_ref_s, ..*shift };
        Self {
            measured,
            samples: errors.iter().map(|one| (one.t_s + t_ref_s, one.error_rad)).collect(),
            local_shifts: local_shifts.iter().map(later).collect(),
            clock,
        }
    }

    /// Residuals of the samples of a solve, at its geometry.
    pub(crate) fn at(prepared: &Prepared, geometry: Geometry) -> Self {
        let (measured, first_s) = (prepared.measured, prepared.first_s());
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

/// Even with all numbers of the geometry moved within their tolerances the angles do not fit.
#[derive(Debug, Clone, PartialEq)]
pub struct PoorFit {
    /// Scatter of each encoder about the geometry that fits best \[rad\].
    pub spread_rad: [f64; BAR_JOINTS],
    /// Largest allowed scatter \[mrad\].
    pub limit_mrad: f64,
    /// The residuals behind it.
    pub deviations: Deviations,
}

impl PoorFit {
    /// The refusal of a run in which nothing has changed that explains it.
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
    /// The same error with the residuals behind it.
    pub(crate) fn resting_on(self, deviations: Deviations) -> Self {
        Self::WithDeviations { error: Box::new(self), deviations: Box::new(deviations) }
    }

    /// Joint and instant of the fault, if they are known.
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

    /// If clocks, base or offsets change: the instant, since the first valid sample \[s\], at which the run can be cut into two
    /// parts, each with its own.
    pub fn parts_at_s(&self) -> Option<f64> {
        match self {
            Self::ClockJump { at_s, .. } | Self::EncoderSlip { at_s, .. } | Self::BaseMoved { at_s, .. } => {
                Some(*at_s)
            }
            Self::WithDeviations { error, .. } => error.parts_at_s(),
            _ => None,
        }
    }

    /// The residuals behind it, if the logs were aligned before it.
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
