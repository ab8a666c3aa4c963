//! By default every link parameter is free and has a prior, with its nominal value as expected value and its tolerance as
//! standard deviation. This is true for any instrument, even if the data do not separate the parameters.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::collections::BTreeSet;

use crate::support::rows::Alone;
use crate::support::truth::position_error_m;
use crate::support::{bar, irb2400, ur10};
use identify::calibrate::{Calibration, IdentifyConfig, JointTermsConfig, calibrate_run};
use identify::evaluate::{limits, not_separated, workspace_error};
use identify::kinematics::{LinkParameter, Pose, flange_chain};
use identify::logs::PoseRow;
use identify::model::{Model, ParameterId, Role};
use identify::simulate::{self, Design, Effects, Experiment, Simulated, StaticErrors};
use nalgebra::Vector3;
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use shared::config::RobotConfig;

/// A configuration without joint terms, to save time.
fn quick() -> IdentifyConfig {
    IdentifyConfig {
        bar_length_um: 0.0,
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        ..IdentifyConfig::default()
    }
}

/// A run of a minute with the bar. The robot has errors of a millimetre or milliradian in every parameter.
fn run(robot: &RobotConfig) -> Simulated {
    let (errors, effects) = (StaticErrors::Drawn { seed: 3 }, Effects::LABORATORY);
    let design = Design { duration_s: 60.0, ..Design::for_robot(robot) };
    simulate::run(&Experiment { seed: 3, errors, effects, design, ..Experiment::new(robot, &bar()) }).unwrap()
}

fn calibrated(run: &Simulated, robot: &RobotConfig, config: &IdentifyConfig) -> Calibration {
    calibrate_run(&run.cycles, &run.encoders, &run.robot_log, robot, &bar(), config).unwrap()
}

fn names(ids: &[ParameterId]) -> String {
    ids.iter().map(ToString::to_string).collect::<Vec<_>>().join("|")
}

/// Link parameters that have a tolerance. The last link is left out, because instruments are mounted on it.
fn with_tolerance(model: &Model) -> BTreeSet<ParameterId> {
    let is_one = |id: ParameterId| matches!(id, ParameterId::Robot { link, .. } if link < 5);
    let of_links = model.columns().filter(|one| is_one(one.id));
    of_links.filter(|one| matches!(one.role, Role::Prior { .. })).map(|one| one.id).collect()
}

/// Rows of a tracker for a robot with known link errors. Each joint angle is within `reach_rad` of zero.
fn tracked(robot: &RobotConfig, reach_rad: [f64; 6]) -> Vec<PoseRow> {
    let mut random = StdRng::seed_from_u64(5);
    let mut truth = flange_chain(robot);
    for link in truth.links.iter_mut().take(5) {
        link.alpha_rad += 1e-3 * random.sample::<f64, _>(StandardNormal);
        link.a_m += 1e-3 * random.sample::<f64, _>(StandardNormal);
    }
    let place = Pose::translation(-3.0, 0.5, 1.3);
    let row = |_| {
        let joints_rad: [f64; 6] =
            reach_rad.map(|reach| if reach > 0.0 { random.random_range(-reach..reach) } else { 0.4 });
        let mut seen = place.inverse() * truth.forward(&joints_rad);
        seen.translation.vector += Vector3::from_fn(|_, _| 2e-5 * random.sample::<f64, _>(StandardNormal));
        let (position_m, rotation) = (seen.translation.vector, Some(seen.rotation));
        PoseRow { joints_rad: joints_rad.into(), position_m, rotation, ..PoseRow::default() }
    };
    (0..200).map(row).collect()
}

/// Three axes are parallel, so `rd2`, `rd3` and `rd4` have the same effect on the pose.
#[test]
fn a_ur10_is_calibrated_with_the_ball_bar_and_what_its_parallel_axes_do_not_separate_is_named() {
    let robot = ur10();
    let run = run(&robot);
    let found = calibrated(&run, &robot, &quick());
    let groups: Vec<String> =
        not_separated(found.model(), found.solution()).iter().map(|group| names(group)).collect();
    assert_eq!(groups, ["rd2|rd3|rd4"]);
    let claimed = workspace_error(&found, &robot.joint_limits()).after;
    let error_m = position_error_m(&run, &found, &robot);
    println!("{:.3} mm, claimed up to {:.3} mm", error_m * 1e3, claimed.interval_m[1] * 1e3);
    assert!(error_m < 0.2e-3 && error_m < claimed.interval_m[1], "{error_m} {claimed:?}");
}

#[test]
fn the_same_numbers_are_free_whichever_instrument_measures_the_robot() {
    let robot = irb2400();
    let by_bar = with_tolerance(calibrated(&run(&robot), &robot, &quick()).model());
    let found = Alone::quick().without_joint_errors().poses(&tracked(&robot, [1.0; 6]), &robot).unwrap();
    assert_eq!(by_bar, with_tolerance(found.model()));
    let named = |parameter| by_bar.contains(&ParameterId::Robot { link: 1, parameter });
    assert!(named(LinkParameter::Beta) && !named(LinkParameter::D), "{by_bar:?}");
}

/// A parameter that is fixed by name keeps its value. If it only defines a frame, it is exact. Otherwise
/// its tolerance is its uncertainty.
#[test]
fn only_what_is_fixed_by_name_is_fixed() {
    let robot = ur10();
    let fix = ["rd2", "ra3", "balpha2"].map(|name| name.parse().unwrap()).to_vec();
    let found = calibrated(&run(&robot), &robot, &IdentifyConfig { fix, ..quick() });
    let role = |name: &str| found.model().parameter(name.parse().unwrap()).unwrap().role;
    assert_eq!(role("rd2"), Role::Fixed);
    assert_eq!([role("ra3"), role("balpha2")], [Role::Considered { sigma: 1e-3 }; 2]);
    let fixed = found.model().parameters().iter().filter(|one| {
        let of_chains = matches!(one.id, ParameterId::Robot { .. } | ParameterId::Bar { .. });
        let beta = matches!(one.id, ParameterId::Robot { parameter: LinkParameter::Beta, .. });
        of_chains && !beta && !one.role.is_estimated()
    });
    let fixed: Vec<String> = fixed.map(|one| one.id.to_string()).collect();
    let of_frames = ["rd1", "rtheta1", "rd2", "rd3", "bd1", "ba5", "bd5", "balpha5"].map(str::to_owned);
    let expected: BTreeSet<String> = of_frames.into_iter().chain(["ra3".into(), "balpha2".into()]).collect();
    assert_eq!(fixed.into_iter().collect::<BTreeSet<_>>(), expected);
}

/// Joint 3 does not move. Parameters that only its motion would separate are named and remain near nominal.
/// The other parameters are estimated.
#[test]
fn what_the_data_do_not_determine_is_named_and_stays_near_nominal() {
    let robot = irb2400();
    let rows = tracked(&robot, [1.0, 1.0, 0.0, 1.0, 1.0, 1.0]);
    let found = Alone::quick().without_joint_errors().poses(&rows, &robot).unwrap();
    let groups = not_separated(found.model(), &found.0.solved.solution);
    println!("{:?}", groups.iter().map(|group| names(group)).collect::<Vec<_>>());
    let of_joint_3: Vec<ParameterId> = groups.iter().skip(1).flatten().copied().collect();
    for name in ["rtheta3", "ra2"] {
        assert!(of_joint_3.contains(&name.parse().unwrap()), "{groups:?}");
    }
    let scale = found.0.solved.prior_scale;
    for id in of_joint_3 {
        let one = found.model().parameter(id).unwrap();
        assert!((one.value - one.nominal).abs() < 3e-3 * scale, "{id}: {one:?}");
    }
    let of_wrist: ParameterId = "ralpha4".parse().unwrap();
    assert!(found.sigma(of_wrist).unwrap() < 1e-4);
}

#[test]
fn a_parameter_that_has_a_role_by_name_has_to_be_one_of_the_model() {
    let robot = irb2400();
    let id: ParameterId = "probe_x".parse().unwrap();
    for config in [
        IdentifyConfig { fix: vec![id], ..quick() },
        IdentifyConfig { free: vec![id], ..quick() },
        IdentifyConfig { priors: [(id, 1.0)].into(), ..quick() },
    ] {
        let run = run(&robot);
        let error =
            calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar(), &config).unwrap_err();
        assert!(error.to_string().contains("no parameter `probe_x`"), "{error}");
    }
}

/// Joint offsets of half a degree are usual for cobots. The nominal robot is that of the file. The
/// true robot also has these offsets.
#[test]
fn zeros_of_joints_half_a_degree_off_contradict_no_expectation() {
    let robot = ur10();
    let run = run(&robot);
    let mut file = robot.clone();
    for (link, sign) in file.links.iter_mut().take(5).zip([0.0, 1.0, -1.0, 1.0, -1.0]) {
        link.theta_deg += 0.5 * sign;
    }
    let found = calibrated(&run, &file, &quick());
    let workspace = workspace_error(&found, &robot.joint_limits());
    let limits: Vec<String> = limits(&found, &workspace).into_iter().map(|one| one.sentence).collect();
    assert!(!limits.iter().any(|limit| limit.contains("contradict the prior of")), "{limits:#?}");
    let error_m = position_error_m(&run, &found, &robot);
    assert!(error_m < 0.2e-3 && error_m < workspace.after.interval_m[1], "{error_m} {:?}", workspace.after);
}
