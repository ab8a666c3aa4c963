//! Compares the identified with the true parameters of a simulated experiment, for tests and studies. It computes errors of
//! single parameters, and position errors over the workspace.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector3};
use shared::config::RobotConfig;

use crate::calibrate::Calibration;
use crate::calibrate::selection::links::inseparable_offsets;
use crate::instrument::standing;
use crate::kinematics::{Joints, LinkParameter, nearest_turn};
use crate::model::{JointState, Model, Owner, ParameterId, Unit};
use crate::simulate::Truth;
use crate::statistics::{largest_size, quantile};

/// An identified parameter with its true value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ComparedParameter {
    /// Identifier of the compared parameter.
    pub id: ParameterId,
    /// True value, SI. To an angle, whole turns are added until it is within half a turn of the identified value.
    pub truth: f64,
    /// Identified value, SI.
    pub identified: f64,
}

impl ComparedParameter {
    /// Identified minus true value in the unit of reports (mm, mrad).
    pub fn error_displayed(&self) -> f64 {
        (self.identified - self.truth) * self.id.unit().display_factor()
    }
}

/// Identified and true parameters of an experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Identified parameters of robot, bar and base.
    pub parameters: Vec<ComparedParameter>,
    /// Error of the identified clock difference (robot clock minus bar clock) \[s\].
    pub clock_shift_error_s: f64,
    /// Error of the identified rate of the robot's clock.
    pub clock_skew_error: f64,
}

impl Comparison {
    /// Compares a calibration with the truth of its experiment.
    pub fn new(calibration: &Calibration, truth: &Truth) -> Self {
        let parameters = calibration
            .model()
            .columns()
            .filter(|parameter| {
                use ParameterId::{Bar, Base, BaseRotation, Robot};
                matches!(parameter.id, Robot { .. } | Bar { .. } | Base { .. } | BaseRotation { .. })
            })
            .map(|parameter| ComparedParameter {
                id: parameter.id,
                truth: true_value(truth, parameter.id, parameter.value)
                    + carried_offset_m(calibration.model(), truth, parameter.id),
                identified: parameter.value,
            })
            .collect();
        let value = |id| calibration.model().parameter(id).map_or(0.0, |parameter| parameter.value);
        let shift_error_ns = calibration.prepared().map(|prepared| {
            let identified_ns = prepared.alignment.solved_difference_ns(value(ParameterId::ClockShift));
            let robot_ns = prepared.t_ref.0.saturating_add(identified_ns);
            robot_ns.saturating_sub(truth.clock.robot_ns(prepared.t_ref)) as f64
        });
        Self {
            parameters,
            clock_shift_error_s: shift_error_ns.unwrap_or(0.0) * 1e-9,
            clock_skew_error: value(ParameterId::ClockSkew) - truth.clock.skew,
        }
    }

    /// Euclidean norm of the errors. Millimetres and milliradians have equal weight, as in the thesis.
    pub fn euclidean_mm_mrad(&self) -> f64 {
        self.parameters.iter().map(|one| one.error_displayed().powi(2)).sum::<f64>().sqrt()
    }

    /// Largest error. Millimetres and milliradians have equal weight.
    pub fn max_mm_mrad(&self) -> f64 {
        largest_size(self.parameters.iter().map(ComparedParameter::error_displayed))
    }

    /// The comparison restricted to the parameters for which `wanted` returns true.
    pub fn only(&self, wanted: impl Fn(ParameterId) -> bool) -> Self {
        let parameters = self.parameters.iter().filter(|one| wanted(one.id)).copied().collect();
        Self { parameters, ..self.clone() }
    }
}

/// The model `found`, with the robot's links and joint errors set to their true values. `truth` contains the true values by
/// name \[m|rad\]; parameters that are missing in it are nominal.
pub fn true_model(found: &Model, truth: &BTreeMap<String, f64>) -> Model {
    let mut model = found.clone().with(truth.keys().filter_map(|name| name.parse().ok()));
    for id in model.ids().into_iter().filter(|id| id.owner() == Owner::Robot) {
        let nominal = model.parameter(id).map_or(0.0, |parameter| parameter.nominal);
        // This cannot fail, because the parameters are those of the model.
        let _ = model.set_value(id, truth.get(&id.to_string()).copied().unwrap_or(nominal));
    }
    model
}

/// Position errors of the identified robot: mean and 95 % quantile \[m\]. The postures are distributed over the joint
/// limits. At each posture, identified robot and true robot have the same reported joints, and each robot corrects them by
/// its own joint errors. The error is the distance between the positions of the same point on both robots.
///
/// `points_m` is the position of this point in the last frame, first of the identified robot, then of the true robot.
pub fn position_errors_m(
    found: &Model,
    truth: &Truth,
    robot: &RobotConfig,
    points_m: [Vector3<f64>; 2],
) -> (f64, f64) {
    /// Number of steps of each joint. The numbers are coprime, so combinations of joint values do not repeat.
    const STEPS: [usize; 8] = [7, 11, 13, 17, 19, 23, 29, 31];
    const POSTURES: usize = 2000;
    let [identified, truth] =
        [found, &true_model(found, &truth.parameters)].map(|model| model.geometry(&model.start()));
    let limits = robot.joint_limits();
    let posture = |posture: usize| {
        Joints::from_fn(identified.robot.links.len(), |joint| {
            let [low, high] = limits.get(joint).copied().unwrap_or_default();
            let steps = STEPS[joint % STEPS.len()];
            let part = (posture % steps) as f64 / (steps - 1) as f64;
            low + (high - low) * part
        })
    };
    let distance_m = |reported: &JointState| {
        let [found_m, true_m] = points_m.map(Point3::from);
        (identified.robot_end(reported) * found_m - truth.robot_end(reported) * true_m).norm()
    };
    let mut distances_m: Vec<f64> = standing((0..POSTURES).map(posture)).iter().map(distance_m).collect();
    (distances_m.iter().sum::<f64>() / POSTURES as f64, quantile(&mut distances_m, 0.95))
}

/// Correction of the true value of an offset along parallel axes \[m\]; zero for other parameters. Data determine only the
/// sum of the offsets along parallel axes. If the calibration fixed some of these offsets, the last offset absorbs their
/// errors (true minus fixed value). This function returns the sum of these errors, in the direction of the last axis.
fn carried_offset_m(found: &Model, truth: &Truth, id: ParameterId) -> f64 {
    let robot = found.geometry(&[]).robot;
    let Some(group) = inseparable_offsets(&robot).into_iter().find(|group| group.last() == Some(&id)) else {
        return 0.0;
    };
    let is_fixed = |id: &ParameterId| found.column_of(*id).is_none();
    let mut sum_m = 0.0;
    for offset in group {
        let ParameterId::Robot { link, .. } = offset else { continue };
        if offset == id {
            break;
        }
        let value = found.parameter(offset).map_or(0.0, |parameter| parameter.value);
        if is_fixed(&offset) {
            sum_m += truth.parameters.get(&offset.to_string()).map_or(0.0, |truth| truth - value);
        }
        // The next axis may be antiparallel, so that its offset has the opposite sign.
        sum_m *= robot.links.get(link).map_or(1.0, |at| at.alpha_rad.cos().signum());
    }
    sum_m
}

/// The true value of a parameter, comparable with the identified value. For `btheta` it includes the encoder's unknown
/// offset, as the identified value does. To an angle, whole turns are added until it is near the identified value.
fn true_value(truth: &Truth, id: ParameterId, identified: f64) -> f64 {
    let named = truth.parameters.get(&id.to_string()).copied().unwrap_or(0.0);
    let offset = match id {
        ParameterId::Bar { link, parameter: LinkParameter::Theta } => truth
            .encoders
            .iter()
            .find(|encoder| usize::from(encoder.joint) == link + 1)
            .map_or(0.0, |encoder| encoder.offset_rad),
        _ => 0.0,
    };
    let value = named + offset;
    if id.unit() == Unit::Radian { nearest_turn(value, identified) } else { value }
}
