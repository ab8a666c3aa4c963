//! Limitations of a calibration, as sentences that suggest an action. They result from tests of the solution, of its
//! covariance and of its residuals. Report and verdict use them.

use serde::{Deserialize, Serialize};
use shared::config::JointKind;
use shared::output::named;

use super::{Elongation, PositiveForce, WorkspaceError};
use crate::calibrate::Calibration;
use crate::calibrate::change::Changed;
use crate::calibrate::contradicted::{ContradictedPrior, LENGTH_SIGMA_M, LengthEstimate, lengths};
use crate::calibrate::validation::agreement::{Disagreement, disagreeing};
use crate::cost::Closure;
use crate::instrument::{Run, ScaleFrom};
use crate::kinematics::{DhLink, Joints, LinkParameter};
use crate::model::{JointTerm, Model, ParameterId, Role};
use crate::solver::{Loss, LossName, Solution};
use crate::statistics::{Sizes, extremes, median};

/// If a joint moved by less than this, the parameters of its link are poorly determined \[deg\].
const TRAVEL_MIN_DEG: f64 = 20.0;
/// If the autocorrelation of the residuals is above this, the result is limited by model errors rather than by noise.
const AUTOCORRELATION_MAX: f64 = 0.5;
/// Significance limit, in standard deviations. White noise exceeds it once in a thousand runs.
const BY_CHANCE: f64 = 3.09;
/// Samples with a weight below this in the robust loss are outliers.
const WEIGHT_MIN: f64 = 0.5;

/// Length errors above this limit have another cause than manufacturing or measurement \[m\].
const LENGTH_OFF_M: f64 = 5e-3;
/// Error of the bar's configured length up to which it is not reported, if no other length is wrong and the bar's file states no
/// uncertainty of this length \[m\]. The length is then entered roughly, and the calibration estimates it.
const ROD_OFF_M: f64 = 50e-3;

/// A rotation of the plate by more than this is reported \[rad\]. It is more than the usual error of a joint
/// offset; the mounting of a plate may be further off.
const TURNED_RAD: f64 = 17e-3;

/// Relative errors of a gear ratio above this limit show a wrong configuration, because gear ratios are ratios of tooth
/// numbers. The elasticity of a drive contributes less than a tenth of this limit.
const RATIO_OFF: f64 = 500e-6;
/// Smaller delays of a joint are not reported \[s\]. At 1 rad/s, this delay is an error of half a milliradian.
const DELAY_S: f64 = 5e-4;

/// Contributions below this fraction of an uncertainty are negligible, because they increase it by less than 6 %.
const NEGLIGIBLE: f64 = 1.0 / 3.0;

/// Maximum number of names in one sentence. If there are more, the sentence ends with the number of the remaining names.
const NAMED: usize = 3;

/// One limitation of a calibration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Limit {
    /// The limitation as text for the report.
    pub sentence: String,
    /// Whether the limitation invalidates the reported accuracy, or shows that a given input is wrong.
    pub serious: bool,
}

/// Limitations of a calibration with any instruments, the most important first.
pub fn limits(calibration: &Calibration, workspace: &WorkspaceError) -> Vec<Limit> {
    let (model, solution) = (calibration.model(), calibration.solution());
    let reach_m = model.geometry(&[]).robot.reach_m();
    let scales = calibration.runs.iter().map(|run| run.instrument.scale());
    let mut limits: Vec<Limit> = of_doubts(calibration).collect();
    limits.extend(of_changes(&calibration.changed, reach_m, workspace.budget.expanded_m));
    limits.extend(wrong_ratios(model, solution));
    limits.extend(late_joints(model, solution));
    // With other instruments, the rotation of the last link belongs to the mounting of the target.
    if scales.clone().any(|scale| scale == ScaleFrom::Plate) {
        limits.extend(turned_plate(model, solution));
    }
    limits.extend(of_disagreement(&calibration.runs, &calibration.solved.sigmas, solution.loss));
    // A wrong scale would contradict the priors of all lengths as well, so lengths come first.
    limits.extend(of_lengths(calibration, scales));
    limits.extend(strained_priors(&calibration.contradicted.priors));
    limits.extend(correlated_residuals(calibration));
    limits.extend(little_travel(calibration));
    limits.extend(outliers(solution));
    limits.extend(weakest(workspace));
    limits.extend(forces_without_sign(calibration));
    limits
}

/// Reasons, reported by the instruments, why the result may be wrong.
fn of_doubts(calibration: &Calibration) -> impl Iterator<Item = Limit> {
    calibration.runs.iter().enumerate().flat_map(move |(number, Run { instrument, model })| {
        let doubts = instrument.doubts(&model.geometry(&[])).into_iter();
        doubts.map(move |doubt| Limit { sentence: place(calibration, number) + &doubt, serious: true })
    })
}

/// Joints with too little motion.
fn little_travel(calibration: &Calibration) -> Vec<Limit> {
    let little = |(joint, travel_deg): (usize, f64)| Limit {
        sentence: format!(
            "Joint {} turned by {travel_deg:.0} degrees only; a path that turns it further determines its link better.",
            joint + 1
        ),
        serious: true,
    };
    let travel = travel_deg(calibration).into_iter();
    travel.filter(|(_, travel_deg)| *travel_deg < TRAVEL_MIN_DEG).map(little).collect()
}

/// Outliers (samples with a low weight in the robust loss), if they are more than one in twenty samples.
fn outliers(solution: &Solution) -> Option<Limit> {
    let weights = &solution.sample_weights;
    // At its scale, a loss has the weight one half. The weight of Geman-McClure is the square of this.
    let weight_min = match solution.loss.name {
        LossName::GemanMcclure => WEIGHT_MIN.powi(2),
        _ => WEIGHT_MIN,
    };
    let outliers = weights.iter().filter(|weight| **weight < weight_min).count();
    (outliers * 20 > weights.len()).then(|| Limit {
        sentence: format!(
            "{outliers} of {} samples fit badly and count less: look for a loose joint, slip or collisions in the log.",
            weights.len()
        ),
        serious: true,
    })
}

/// The combination of parameters that limits the accuracy most.
fn weakest(workspace: &WorkspaceError) -> Option<Limit> {
    let names: Vec<&str> = workspace.weakest.iter().map(|(name, _)| name.as_str()).take(NAMED).collect();
    (!names.is_empty()).then(|| Limit {
        sentence: format!(
            "The weakest combination of parameters is {}: poses that separate these improve the result most.",
            names.join(", ")
        ),
        serious: false,
    })
}

const fn describe_scale(scale: ScaleFrom) -> &'static str {
    match scale {
        ScaleFrom::Plate => "plate_m fixes the scale: measure the plate, or increase plate_u_um",
        ScaleFrom::Tracker => {
            "The tracker fixes the scale: check its unit, its target's constant and its correction for air, or increase scale_u_ppm"
        }
        ScaleFrom::Wire => {
            "The wire fixes the scale: check its unit, and its readings against a known length, or increase scale_u_ppm"
        }
        ScaleFrom::Sockets => {
            "The table of sockets fixes the scale: check its unit, and measure the sockets again"
        }
        ScaleFrom::Faces => {
            "The distances between faces fix the scale: check their unit, and measure them again"
        }
        ScaleFrom::Robot => "No measured length fixes the scale: state a distance between two faces",
    }
}

/// Data sets that contradict each other about the robot.
fn of_disagreement(runs: &[Run], sigmas: &[f64], loss: Loss) -> Option<Limit> {
    let describe = |Disagreement { data_set, times }: &Disagreement| {
        let name = runs.get(*data_set).map_or("", |run| run.instrument.name());
        format!("{name} (data set {}): its residuals are {times:.2} times as large as alone", data_set + 1)
    };
    let disagreements: Vec<String> = disagreeing(runs, sigmas, loss).iter().map(describe).collect();
    (!disagreements.is_empty()).then(|| Limit {
        sentence: format!(
            "The data sets contradict each other: {}. They are of different robots, the robot was changed in between, or one of \
             them has another scale: calibrate each alone and `identify compare` them.",
            named(&disagreements, NAMED)
        ),
        serious: true,
    })
}

/// Lengths that differ from the configured ones, for any instruments. Either the robot or the bar is not the
/// configured one, or the scale of all lengths is wrong.
fn of_lengths(calibration: &Calibration, scales: impl Iterator<Item = ScaleFrom>) -> Vec<Limit> {
    let mut sources: Vec<&str> = Vec::new();
    for source in scales.map(describe_scale) {
        if !sources.contains(&source) {
            sources.push(source);
        }
    }
    let scale = sources.join(". ");
    let lengths = far_lengths(calibration.model(), calibration.solution(), &scale).into_iter();
    let other = calibration.contradicted.scale.as_ref().map(|other| {
        format!(
            "The robot's estimated lengths have a common scale error of {:+.1} per mille, {:.1} standard deviations for links of {:.0} mm \
             tolerance; positions may be wrong by the same ratio, which the stated uncertainty includes. {scale}.",
            1e3 * other.relative,
            other.sigmas,
            1e3 * LENGTH_SIGMA_M
        )
    });
    let sentences = lengths.chain(other);
    sentences.map(|sentence| Limit { sentence, serious: true }).collect()
}

/// Changes during the measurement. `reach_m` is the reach of the arm. Changes are serious if they move the arm's end by more
/// than a negligible fraction of the expanded uncertainty. The fraction is small because a change also increases the
/// expanded uncertainty: the samples before and after the change contradict each other.
fn of_changes(changed: &[Changed], reach_m: f64, expanded_m: f64) -> Option<Limit> {
    (!changed.is_empty()).then(|| Limit {
        sentence: format!(
            "Something changed during the measurement: {}. The result is a mean of the states before and after: let the robot warm up, \
             check the named parts, or calibrate from the data on one side of the change.",
            named(changed, NAMED)
        ),
        serious: changed.iter().any(|change| change.displacement_m(reach_m) > NEGLIGIBLE * expanded_m),
    })
}

/// Prefix that names the run, if there is more than one.
fn place(calibration: &Calibration, run: usize) -> String {
    if calibration.runs.len() == 1 { String::new() } else { format!("Data set {}: ", run + 1) }
}

/// Runs whose residuals have an autocorrelation significantly above [`AUTOCORRELATION_MAX`].
fn correlated_residuals(calibration: &Calibration) -> impl Iterator<Item = Limit> {
    let of_runs = calibration.runs.iter().map(|run| run.instrument.autocorrelation()).enumerate();
    let correlated = of_runs.filter_map(|(run, estimate)| {
        let [autocorrelation, sigma] = estimate?;
        (autocorrelation - BY_CHANCE * sigma > AUTOCORRELATION_MAX).then_some((run, autocorrelation))
    });
    correlated.map(|(run, autocorrelation)| Limit {
        sentence: format!(
            "{}{:.0} % of the variance of the residuals is correlated from sample to sample, so it is not noise: errors that the model \
             does not contain (gears, bar, deflection) limit the result. The figures by joint show where.",
            place(calibration, run),
            100.0 * autocorrelation
        ),
        serious: false,
    })
}

/// Force measurements that do not explain changes of the bar's length.
fn forces_without_sign(calibration: &Calibration) -> impl Iterator<Item = Limit> {
    let undetermined = Elongation::all(calibration)
        .into_iter()
        .filter(|elongation| elongation.positive == PositiveForce::NotDetermined);
    undetermined.map(|elongation| Limit {
        sentence: format!(
            "{}The {} does not determine how far the bar deflects ({}); check its clock, column and place, or calibrate without it.",
            place(calibration, elongation.run),
            elongation.measured.kind.describe(),
            elongation.sentence()
        ),
        serious: true,
    })
}

/// Parameters whose estimates contradict their priors.
fn strained_priors(strained: &[ContradictedPrior]) -> Option<Limit> {
    (!strained.is_empty()).then(|| Limit {
        sentence: format!(
            "The data contradict the prior of {}. Look for the cause (the ratio in the controller, a worn gear or grating, a plate or \
             rod of another length), or widen the prior under [priors] or [joint_terms] of the configuration: with this width the \
             result is biased, or wrong where the robot was not measured. The stated uncertainty includes the change of the result without it.",
            named(strained, NAMED)
        ),
        serious: strained.iter().any(ContradictedPrior::is_serious),
    })
}

/// Estimates of one error term, for all joints. Each entry consists of the joint (from 1), the value, and the standard
/// deviation of the value.
fn estimates(model: &Model, solution: &Solution, wanted: JointTerm) -> Vec<(usize, f64, f64)> {
    let columns = model.columns().enumerate();
    let of_term = columns.filter_map(|(column, parameter)| match parameter.id {
        ParameterId::Joint { axis, term } if term == wanted => {
            Some((axis + 1, *solution.x.get(column)?, solution.covariance.sigma(column)?))
        }
        _ => None,
    });
    of_term.collect()
}

/// Whether the estimate `off`, with the standard deviation `sigma`, is significantly larger than the limit `off_min`.
fn is_certain(off: f64, off_min: f64, sigma: f64) -> bool {
    off.abs() > off_min + BY_CHANCE * sigma
}

/// Errors of gear ratios beyond manufacturing tolerances.
fn wrong_ratios(model: &Model, solution: &Solution) -> impl Iterator<Item = Limit> {
    let ratios = estimates(model, solution, JointTerm::Ratio).into_iter();
    let wrong = ratios.filter(|(_, off, sigma)| is_certain(*off, RATIO_OFF, *sigma));
    wrong.map(|(joint, off, _)| Limit {
        sentence: format!(
            "Joint {joint} turns by {:.2} % {} than its log says, more than gear manufacturing explains: correct its ratio \
             in the controller, or log.raw_to_joint in the robot's file.",
            1e2 * off.abs(),
            if off > 0.0 { "more" } else { "less" }
        ),
        serious: true,
    })
}

/// Significant delays of single joints in the log.
fn late_joints(model: &Model, solution: &Solution) -> Option<Limit> {
    let late = later_than_others(&estimates(model, solution, JointTerm::Delay), model.axes());
    (!late.is_empty()).then(|| Limit {
        sentence: format!(
            "The log has joints later than the others: {}. Causes are servo lag of commanded values, or a filter. The delay is corrected \
             as far as it is the same at all speeds; if the controller can, log measured values, all of one instant.",
            late.join(", ")
        ),
        serious: false,
    })
}

/// Joints whose delay differs significantly from the median delay. A delay that all joints have is an error of the clocks,
/// which the median represents. Joints without an estimate count as joints with zero delay.
fn later_than_others(delays: &[(usize, f64, f64)], axes: usize) -> Vec<String> {
    let mut all_s: Vec<f64> = delays.iter().map(|(_, delay_s, _)| *delay_s).collect();
    all_s.resize(axes, 0.0);
    let common_s = median(&mut all_s).unwrap_or_default();
    let late = delays.iter().map(|&(joint, delay_s, sigma)| (joint, delay_s - common_s, sigma));
    let late = late.filter(|(_, delay_s, sigma)| is_certain(*delay_s, DELAY_S, *sigma));
    late.map(|(joint, delay_s, _)| format!("joint {joint} by {:+.1} ms", 1e3 * delay_s)).collect()
}

/// Rotation of the flange plate about the flange's axis, relative to the configuration. An offset of the last joint
/// has the same effect and cannot be distinguished.
fn turned_plate(model: &Model, solution: &Solution) -> Option<Limit> {
    let last = model.axes().checked_sub(1)?;
    let theta = ParameterId::Robot { link: last, parameter: LinkParameter::Theta };
    let by_rad = solution.x.get(model.column_of(theta)?)? - model.parameter(theta)?.nominal;
    (by_rad.abs() > TURNED_RAD).then(|| Limit {
        sentence: format!(
            "The offset plate is rotated by about {:+.1} degrees on the flange relative to the robot's file, or the zero of joint {} \
             is wrong by this angle: the bar cannot distinguish them. If it is the plate, add the angle to theta_deg of the last link. \
             Errors before the calibration include this angle.",
            by_rad.to_degrees(),
            last + 1
        ),
        serious: true,
    })
}

/// Lengths that differ by more than [`LENGTH_OFF_M`] from the configured ones. The length of the bar alone may differ by
/// [`ROD_OFF_M`].
fn far_lengths(model: &Model, solution: &Solution, scale: &str) -> Option<String> {
    let mut off: Vec<LengthEstimate> =
        lengths(model, solution).filter(|length| length.off_m.abs() > LENGTH_OFF_M).collect();
    off.sort_by(|a, b| b.off_m.abs().total_cmp(&a.off_m.abs()));
    let is_rough = |length: &LengthEstimate| {
        length.id == ParameterId::ROD
            && model.role(length.id) == Some(Role::Free)
            && length.off_m.abs() <= ROD_OFF_M
    };
    (!off.iter().all(is_rough)).then(|| {
        format!(
            "Estimated lengths are far from the configured ones: {}. If it is one or two, the robot's or the bar's file is not that \
             of the cell; if it is all of them by the same ratio, the scale is wrong, and all lengths with it. {scale}.",
            named(&off, NAMED)
        )
    })
}

/// Range of motion of each revolute joint over all samples \[deg\].
fn travel_deg(calibration: &Calibration) -> Vec<(usize, f64)> {
    let poses: Vec<Joints> = calibration.poses().collect();
    let robot = calibration.model().geometry(&[]).robot;
    let travel = |(joint, link): (usize, &DhLink)| {
        let [low, high] = extremes(poses.iter().map(|q| q[joint]));
        (link.joint == JointKind::Revolute).then(|| (joint, (high - low).max(0.0).to_degrees()))
    };
    robot.links.iter().enumerate().filter_map(travel).collect()
}

/// Statistics of the distances between robot and bar \[m\].
pub(super) fn gap_m<'a>(closures: impl Iterator<Item = &'a Closure>, by_encoders: bool) -> Sizes {
    Sizes::from_values(closures.map(|closure| closure.gap_m(by_encoders)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_estimated_delay_is_late_and_one_of_all_joints_is_not() {
        assert_eq!(later_than_others(&[(5, 8e-3, 1e-4)], 6), ["joint 5 by +8.0 ms"]);
        let all: Vec<(usize, f64, f64)> = (1..=6).map(|joint| (joint, 8e-3, 1e-4)).collect();
        assert!(later_than_others(&all, 6).is_empty());
        assert!(later_than_others(&[(2, 6e-4, 1e-4)], 6).is_empty());
    }
}
