//! Errors of a calibration whose true parameters are known.

use std::collections::BTreeMap;

use identify::calibrate::Calibration;
use identify::evaluate::workspace_error;
use identify::instrument::standing;
use identify::kinematics::{Chain, DhLink, Joints, LinkParameter, Pose};
use identify::logs::TipRow;
use identify::model::{JointState, Model, Parameter, ParameterId, TermGroup};
use identify::simulate::{Simulated, position_errors_m, true_model};
use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use shared::config::RobotConfig;

use super::campaign::is_full;

/// Mean distance between the ends of the true and of the identified robot \[m\], over postures within the limits. Only links
/// are compared. Errors of joints are not included.
pub fn position_error_m(run: &Simulated, found: &Calibration, robot: &RobotConfig) -> f64 {
    let (mut links, mut truth) = (found.model().clone(), run.truth.clone());
    truth.parameters.retain(|name, _| name.parse().is_ok_and(|id: ParameterId| id.term().is_none()));
    for id in links.ids().into_iter().filter(|id| id.term().is_some()) {
        links.set_value(id, 0.0).unwrap();
    }
    position_errors_m(&links, &truth, robot, [Vector3::zeros(); 2]).0
}

/// Position of the start of the last link at these joints \[m\].
pub fn wrist_m(chain: &Chain, q: &Joints) -> Vector3<f64> {
    let mut chain = chain.clone();
    *chain.links.last_mut().unwrap() = DhLink::default();
    chain.forward(q).translation.vector
}

/// [`wrists_apart_m`] of two robots that have no errors of joints.
pub fn apart_m(robot: &RobotConfig, one: &Chain, other: &Chain) -> f64 {
    wrists_apart_m(robot, |q| wrist_m(one, q), |q| wrist_m(other, q))
}

/// Mean distance between the wrists of two robots over postures within the limits \[m\]. Base and flange belong to the
/// instrument. Therefore the rigid motion that fits best is first applied to one robot.
pub fn wrists_apart_m(
    robot: &RobotConfig,
    one: impl Fn(&Joints) -> Vector3<f64>,
    other: impl Fn(&Joints) -> Vector3<f64>,
) -> f64 {
    const POSTURES: usize = 400;
    let mut random = StdRng::seed_from_u64(7);
    let limits = robot.joint_limits();
    let pairs: Vec<[Vector3<f64>; 2]> = (0..POSTURES)
        .map(|_| {
            let q: Joints = limits.iter().map(|&[low, high]| random.random_range(low..high)).collect();
            [one(&q), other(&q)]
        })
        .collect();
    let motion = rigid_motion(&pairs);
    pairs.iter().map(|[p, q]| (p - motion.transform_point(&(*q).into()).coords).norm()).sum::<f64>()
        / POSTURES as f64
}

/// The rigid motion that moves the second points of all pairs as near as possible to the first ones (Kabsch 1976).
pub fn rigid_motion(pairs: &[[Vector3<f64>; 2]]) -> Pose {
    let centre =
        |which: usize| pairs.iter().map(|pair| pair[which]).sum::<Vector3<f64>>() / pairs.len() as f64;
    let (a, b) = (centre(0), centre(1));
    let sum: Matrix3<f64> = pairs.iter().map(|[p, q]| (p - a) * (q - b).transpose()).sum();
    let svd = sum.svd(true, true);
    let turn = Rotation3::from_matrix_unchecked(svd.u.unwrap() * svd.v_t.unwrap());
    Pose::from_parts((a - turn * b).into(), turn)
}

/// Normalised errors of link parameters: estimate minus truth, divided by half the width of the 95 % interval. If two axes
/// are nearly parallel, only the sum of the two lengths `d` along them is identified. The second `d` is estimated, so its
/// correction is compared with the sum of both errors.
pub fn pulls(
    robot: &RobotConfig,
    found: &Calibration,
    truth: &BTreeMap<String, f64>,
) -> Vec<(ParameterId, f64)> {
    let (model, covariance) = (&found.runs[0].model, &found.solved.solution.covariance);
    let sigmas = covariance.sigmas_from.sigmas_of_95();
    let value = |id: ParameterId| truth[&id.to_string()];
    let pull = |(column, parameter): (usize, &Parameter)| {
        let ParameterId::Robot { link, parameter: kind } = parameter.id else { return None };
        let mut truth = value(parameter.id);
        let before =
            ParameterId::Robot { link: link.checked_sub(1).unwrap_or(link), parameter: LinkParameter::D };
        let parallel = link > 1 && robot.links[link - 1].alpha_deg.to_radians().sin().abs() < 0.1;
        if kind == LinkParameter::D && parallel {
            truth += value(before) - model.parameter(before)?.nominal;
        }
        Some((parameter.id, (parameter.value - truth) / (sigmas * covariance.sigma(column)?)))
    };
    model.columns().enumerate().filter_map(pull).collect()
}

/// Gives the robot of these rows joint errors, drawn from the priors that a calibration of rows assumes for errors that
/// the rows neither show nor exclude (`selection/candidates.rs`). Adds them to `truth`. `model` is the model of a
/// calibration of the same arm, which contains the parameters of these errors.
pub fn draw_joint_errors(model: &Model, rows: &mut [TipRow], truth: &mut BTreeMap<String, f64>, seed: u64) {
    use TermGroup::{Backlash, Compliance, GearOnce, GearTwice, Joint, Ratio};
    /// Each step multiplies the remaining error by the slope of a joint error, which is below 0.001.
    const STEPS: usize = 4;
    let mut random = StdRng::seed_from_u64(seed);
    for id in model.ids() {
        let sigma = match id.term() {
            Some(GearOnce | GearTwice | Joint | Backlash | Ratio) => 20e-6,
            Some(Compliance) => 100e-6,
            _ => continue,
        };
        truth.insert(id.to_string(), sigma * random.sample::<f64, _>(StandardNormal));
    }
    let model = true_model(model, truth);
    let geometry = model.geometry(&model.start());
    // The joints of the rows are those of a controller without joint errors. Find the joints that the controller with
    // these errors reports in the same posture.
    let states = standing(rows.iter().map(|row| row.joints_rad));
    for (row, state) in rows.iter_mut().zip(states) {
        let mut reported = state;
        for _ in 0..STEPS {
            let corrected = geometry.corrected(&reported).q;
            reported.q =
                Joints::from_fn(state.q.len(), |joint| reported.q[joint] + state.q[joint] - corrected[joint]);
        }
        row.joints_rad = reported.q;
    }
}

/// Compares calibrations with the true parameters. All robots have the same nominal links but different errors. Checks the
/// 95 % intervals of link parameters, and the ratio of the stated to the true mean position error.
///
/// The intervals include errors of joints that the samples neither show nor exclude. So they contain more than 95 % of
/// the true values if the robots do not have these errors.
pub fn assert_claims_hold(
    robot: &RobotConfig,
    calibrations: impl Iterator<Item = (Calibration, BTreeMap<String, f64>)>,
) {
    let mut all: Vec<(ParameterId, f64)> = Vec::new();
    let mut ratios = Vec::new();
    for (found, truth) in calibrations {
        all.extend(pulls(robot, &found, &truth));
        let claimed_m = workspace_error(&found, &robot.joint_limits()).after.mean_m;
        ratios.push(claimed_m / mean_error_m(robot, &found, &truth));
    }
    for (id, pull) in all.iter().filter(|(_, pull)| pull.abs() > 1.5) {
        println!("{id}: {pull:.2}");
    }
    let within = all.iter().filter(|(_, pull)| pull.abs() <= 1.0).count() as f64 / all.len() as f64;
    ratios.sort_by(f64::total_cmp);
    let ratio = ratios[ratios.len() / 2];
    println!(
        "{}: {within:.3} of {} within their 95 % intervals, claimed over true error {ratio:.2} (median)",
        robot.name,
        all.len()
    );
    // Errors of the links of one robot are correlated, so coverage and median vary more if there are few robots.
    let (within_min, allowed) = if is_full() { (0.92, 0.95..=2.5) } else { (0.86, 0.7..=3.0) };
    assert!(within >= within_min, "{}: {within}", robot.name);
    assert!(allowed.contains(&ratio), "{}: {ratio}", robot.name);
}

/// [`wrists_apart_m`] of the calibrated and the true robot. Both include their errors of joints, as the stated
/// error of a calibration does.
fn mean_error_m(robot: &RobotConfig, found: &Calibration, truth: &BTreeMap<String, f64>) -> f64 {
    let [found, truth] = [found.model(), &true_model(found.model(), truth)].map(|model| {
        let geometry = model.geometry(&model.start());
        move |q: &Joints| wrist_m(&geometry.robot, &geometry.corrected(&JointState::at_rest(*q)).q)
    });
    wrists_apart_m(robot, found, truth)
}
