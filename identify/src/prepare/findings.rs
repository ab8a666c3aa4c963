//! What a refusal knows beyond its sentence, for people who look for the cause.

use super::judge::{Judged, LocalShift};
use super::{ClockFit, PrepareError};
use crate::kinematics::BAR_JOINTS;

/// Where in a run something is wrong, as far as that is known.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Place {
    /// Bar joint, 1 to 5.
    pub joint: Option<u8>,
    /// Bar time since the first valid sample \[s\].
    pub bar_s: Option<f64>,
    /// The same instant after the first stamp of the robot's log \[s\], once the clocks are known.
    pub robot_s: Option<f64>,
}

/// What the geometry that fits best leaves of each encoder: errors of the model are waves, what goes wrong in a run is a step.
#[derive(Debug, Clone, PartialEq)]
pub struct Deviations {
    /// Joints with an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// In the order of time: bar time since the first valid sample \[s\], and measured less implied joints, each times the
    /// sine of the distance from singular poses \[rad\].
    pub samples: Vec<(f64, [f64; BAR_JOINTS])>,
    /// How the alignment varies along the run; times since the first valid sample.
    pub local_shifts: Vec<LocalShift>,
    /// Those times to times after the first stamp of the robot's log.
    pub clock: ClockFit,
}

impl Deviations {
    /// `t_ref_s` is the reference time of `judged` and `local_shifts` after the first sample.
    pub(super) fn new(
        judged: &[Judged],
        local_shifts: &[LocalShift],
        measured: [bool; BAR_JOINTS],
        t_ref_s: f64,
        clock: ClockFit,
    ) -> Self {
        let later = |shift: &LocalShift| LocalShift { t_s: shift.t_s + t_ref_s, ..*shift };
        Self {
            measured,
            samples: judged.iter().map(|one| (one.t_s + t_ref_s, one.error_rad)).collect(),
            local_shifts: local_shifts.iter().map(later).collect(),
            clock,
        }
    }
}

impl PrepareError {
    /// The same with what it rests on.
    pub(super) fn resting_on(self, deviations: Deviations) -> Self {
        Self::Judged { error: Box::new(self), deviations: Box::new(deviations) }
    }

    /// Where it is.
    pub fn place(&self) -> Place {
        match self {
            Self::ClockJump { at_s, .. } => Place { bar_s: Some(*at_s), ..Place::default() },
            Self::EncoderSlip { joint, at_s, .. } => {
                Place { joint: Some(*joint), bar_s: Some(*at_s), robot_s: None }
            }
            Self::LittleTravel { joint, .. } => Place { joint: Some(*joint), ..Place::default() },
            Self::Judged { error, deviations } => {
                let place = error.place();
                Place { robot_s: place.bar_s.map(|bar_s| deviations.clock.tau_s(bar_s)), ..place }
            }
            _ => Place::default(),
        }
    }

    /// What it rests on, where the logs were brought together before it.
    pub fn deviations(&self) -> Option<&Deviations> {
        match self {
            Self::Judged { deviations, .. } => Some(deviations),
            _ => None,
        }
    }

    /// What was typed is wrong, whatever the data.
    pub fn is_mistyped(&self) -> bool {
        matches!(self, Self::StatedEncoderMap { .. })
    }
}
