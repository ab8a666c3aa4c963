//! Identified against true parameters, for experiments that were simulated.

use std::f64::consts::TAU;

use super::ball_bar::BallBarCalibration;
use crate::kinematics::LinkParameter;
use crate::model::{ParameterId, Unit};
use crate::simulate::Truth;

/// One identified parameter beside its true value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Compared {
    /// Which.
    pub id: ParameterId,
    /// True value, SI; angles are taken within half a turn of the identified one.
    pub truth: f64,
    /// Identified value, SI.
    pub identified: f64,
}

impl Compared {
    /// Identified minus true in the unit that people read (mm, mrad).
    pub fn error_displayed(&self) -> f64 {
        (self.identified - self.truth) * self.id.unit().display_factor()
    }
}

/// Identified against true parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Identified geometry: robot, bar and base.
    pub parameters: Vec<Compared>,
    /// Robot clock minus bar clock, identified minus true \[s\].
    pub clock_shift_error_s: f64,
    /// Rate of the robot's clock, identified minus true.
    pub clock_skew_error: f64,
}

impl Comparison {
    /// Sets a calibration beside the truth of its experiment.
    pub fn new(calibration: &BallBarCalibration, truth: &Truth) -> Self {
        let parameters = calibration
            .model
            .columns()
            .filter(|parameter| {
                use ParameterId::{Bar, Base, BaseRotation, Robot};
                matches!(parameter.id, Robot { .. } | Bar { .. } | Base(_) | BaseRotation(_))
            })
            .map(|parameter| Compared {
                id: parameter.id,
                truth: true_value(truth, parameter.id, parameter.value),
                identified: parameter.value,
            })
            .collect();
        let value = |id| calibration.model.parameter(id).map_or(0.0, |parameter| parameter.value);
        let shift_error_ns = calibration.prepared().map(|prepared| {
            let identified_ns = prepared.clock_difference_ns(value(ParameterId::ClockShift));
            // Both are differences of large numbers: subtract the integers first.
            let robot_ns = prepared.t_ref.0.saturating_add(identified_ns);
            robot_ns as f64 - truth.clock.robot_ns(prepared.t_ref)
        });
        Self {
            parameters,
            clock_shift_error_s: shift_error_ns.unwrap_or(0.0) * 1e-9,
            clock_skew_error: value(ParameterId::ClockSkew) - truth.clock.skew,
        }
    }

    /// Euclidean norm of the errors, mm and mrad as equals: the thesis' measure.
    pub fn euclidean_mm_mrad(&self) -> f64 {
        self.parameters.iter().map(|one| one.error_displayed().powi(2)).sum::<f64>().sqrt()
    }

    /// Largest error, mm and mrad as equals.
    pub fn max_mm_mrad(&self) -> f64 {
        self.parameters.iter().map(|one| one.error_displayed().abs()).fold(0.0, f64::max)
    }

    /// The same comparison for some of the parameters.
    pub fn only(&self, wanted: impl Fn(ParameterId) -> bool) -> Self {
        let parameters = self.parameters.iter().filter(|one| wanted(one.id)).copied().collect();
        Self { parameters, ..self.clone() }
    }
}

/// The identified `btheta` holds the encoder's unknown zero too; whole turns of an angle mean nothing.
fn true_value(truth: &Truth, id: ParameterId, identified: f64) -> f64 {
    let named = truth.parameters.get(&id.to_string()).copied().unwrap_or(0.0);
    let zero = match id {
        ParameterId::Bar { link, parameter: LinkParameter::Theta } => truth
            .encoders
            .iter()
            .find(|encoder| usize::from(encoder.joint) == link + 1)
            .map_or(0.0, |encoder| encoder.offset_rad),
        _ => 0.0,
    };
    let value = named + zero;
    if id.unit() == Unit::Radian { value + ((identified - value) / TAU).round() * TAU } else { value }
}
