//! Compares forward kinematics, derivatives and inverses with an independent computation and with each other.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use crate::support::independent::{self, Link};
use identify::kinematics::{
    Chain, Configuration, InverseError, LinkParameter, Pose, Trace, Tracer, ball_bar_chain, ball_bar_inverse,
    ball_bar_inverse_refined, flange_chain, mirroring_joints, robot_chain, robot_inverse, robot_inverse_all,
    singularity_margin_rad,
};
use nalgebra::Translation3;
use num_dual::Dual64;
use proptest::prelude::*;

const PARAMETERS: [LinkParameter; 5] =
    [LinkParameter::A, LinkParameter::Alpha, LinkParameter::D, LinkParameter::Theta, LinkParameter::Beta];

fn numbers(chain: &Chain) -> Vec<Link<f64>> {
    chain.links.iter().map(|l| [l.a_m, l.alpha_rad, l.d_m, l.theta_rad, l.beta_rad]).collect()
}

fn disturb(chain: &mut Chain, errors: &[f64]) {
    for (link, e) in chain.links.iter_mut().zip(errors.chunks_exact(5)) {
        link.a_m += e[0];
        link.alpha_rad += e[1];
        link.d_m += e[2];
        link.theta_rad += e[3];
        link.beta_rad += e[4];
    }
}

fn nominal() -> [Chain; 3] {
    let bar = crate::support::bar();
    [
        robot_chain(&crate::support::irb2400(), &bar),
        robot_chain(&crate::support::nj220(), &bar),
        ball_bar_chain(&bar),
    ]
}

fn pose_distance(a: &Pose, b: &Pose) -> f64 {
    (a.to_homogeneous() - b.to_homogeneous()).amax()
}

#[test]
fn the_irb_2400_at_zero_has_its_flange_where_abb_draws_it() {
    let flange = flange_chain(&crate::support::irb2400()).forward(&[0.0; 6]);
    let expected = [0.940, 0.0, 1.455];
    for (found, expected) in flange.translation.vector.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-12, "{found} instead of {expected}");
    }
}

#[test]
fn plate_tool_and_rod_are_part_of_the_chains() {
    let bar = crate::support::bar();
    let robot = crate::support::irb2400();
    let (with, without) = (robot_chain(&robot, &bar), flange_chain(&robot));
    assert_eq!(with.links[5].a_m, without.links[5].a_m + bar.plate_m);
    assert_eq!(with.links[5].d_m, without.links[5].d_m + bar.tool_m);
    assert_eq!(ball_bar_chain(&bar).links[2].d_m, bar.length_m);
}

#[test]
fn plate_and_tool_follow_the_rotations_of_the_last_link() {
    let bar = crate::support::bar();
    let q = [0.3, -0.2, 0.4, 0.1, 0.7, -0.5];
    for (alpha_deg, beta_deg) in [(0.0, 0.0), (20.0, 0.0), (0.0, 20.0)] {
        let mut robot = crate::support::irb2400();
        (robot.links[5].alpha_deg, robot.links[5].beta_deg) = (alpha_deg, beta_deg);
        let expected = flange_chain(&robot).forward(&q) * Translation3::new(bar.plate_m, 0.0, bar.tool_m);
        assert!(
            pose_distance(&robot_chain(&robot, &bar).forward(&q), &expected) < 1e-12,
            "{alpha_deg} {beta_deg}"
        );
    }
}

#[test]
fn a_joint_that_is_not_given_stands_at_zero() {
    let chain = &nominal()[0];
    assert_eq!(chain.forward(&[0.3]), chain.forward(&[0.3, 0.0, 0.0, 0.0, 0.0, 0.0]));
}

#[test]
fn a_singular_bar_is_told_by_its_margin() {
    use std::f64::consts::PI;
    let [.., mut bar] = nominal();
    let margin_rad = |bar: &Chain, bar_rad| singularity_margin_rad(&bar.links, &bar_rad);
    assert!(margin_rad(&bar, [0.3, 0.0, 0.1, 1.0, 0.2]) < 1e-12);
    assert!(margin_rad(&bar, [0.3, 1.0, 0.1, PI, 0.2]) < 1e-12);
    assert!((margin_rad(&bar, [0.3, 1.2, 0.1, PI - 0.05, 0.2]) - 0.05).abs() < 1e-12);
    assert!((margin_rad(&bar, [0.3, -0.2, 0.1, -1.0, 0.2]) - 0.2).abs() < 1e-12);
    // The joints of this bar have other offsets. The margin must not depend on offsets, because
    // it is the angle between the links.
    bar.links[1].theta_rad = 0.5 * PI;
    bar.links[3].theta_rad = -0.5 * PI;
    assert!((margin_rad(&bar, [0.3, 0.0, 0.1, 0.2, 0.2]) - (0.5 * PI - 0.2)).abs() < 1e-12);
    assert!(margin_rad(&bar, [0.3, 0.5 * PI, 0.1, 0.2, 0.2]) < 1e-12);
}

#[test]
fn a_pose_out_of_reach_and_a_chain_of_another_kind_are_errors() {
    let [robot, _, bar] = nominal();
    let far = Pose::translation(9.0, 0.0, 1.0);
    assert!(matches!(robot_inverse(&robot, &far, &[0.0; 6]), Err(InverseError::Unreachable { .. })));
    assert!(matches!(robot_inverse(&bar, &far, &[0.0; 6]), Err(InverseError::Links { .. })));
    assert!(matches!(ball_bar_inverse(&robot, &far), Err(InverseError::Links { .. })));
    let mut skewed = robot;
    skewed.links[2].alpha_rad = 1.0;
    assert!(matches!(robot_inverse_all(&skewed, &far), Err(InverseError::Structure { link: 3, .. })));
}

/// With all joints at zero the arm is stretched and singular, so not even the first step exists.
#[test]
fn joints_that_do_not_converge_state_the_iterations_that_were_made() {
    let arm = flange_chain(&crate::support::ur10());
    let target = arm.forward(&[0.3, -0.4, 0.5, 0.2, 0.6, 0.1]);
    let error = robot_inverse(&arm, &target, &[0.0; 6]).unwrap_err();
    assert!(matches!(error, InverseError::NotConverged { iterations: 0, .. }), "{error:?}");
}

fn angles<const N: usize>(limit: f64) -> impl Strategy<Value = [f64; N]> {
    prop::array::uniform(-limit..limit)
}

fn errors(size: f64) -> impl Strategy<Value = Vec<f64>> {
    prop::collection::vec(-size..size, 30)
}

/// Joint angles that avoid singular poses, at which the inverse is not unique: wrist on axis 1,
/// stretched elbow, and singular wrist.
fn regular_robot() -> impl Strategy<Value = [f64; 6]> {
    let ranges = [-3.0..3.0, -0.2..1.4, -0.9..1.0, -3.0..3.0, -1.4..1.4, -3.0..3.0];
    ranges.prop_map(|mut q: [f64; 6]| {
        q[4] = q[4].signum() * (0.15 + q[4].abs());
        q
    })
}

fn regular_bar() -> impl Strategy<Value = [f64; 5]> {
    angles::<5>(3.1).prop_map(|mut b| {
        for i in [1, 3] {
            b[i] = b[i].signum() * (0.1 + 0.9 * b[i].abs());
        }
        b
    })
}

proptest! {
    #[test]
    fn forward_kinematics_is_the_product_of_the_link_matrices(
        which in 0..3usize, q in angles::<6>(3.0), e in errors(0.3)
    ) {
        let mut chain = nominal()[which].clone();
        disturb(&mut chain, &e);
        let independent = independent::forward(&independent::identity(), &numbers(&chain), &q);
        let pose = chain.forward(&q).to_homogeneous();
        let mut trace = Trace::default();
        Tracer::new(&chain).trace(&q, &mut trace);
        let traced = trace.end().to_homogeneous();
        for i in 0..4 {
            for j in 0..4 {
                prop_assert!((pose[(i, j)] - independent[i][j]).abs() < 1e-12);
                prop_assert!((traced[(i, j)] - independent[i][j]).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn twists_are_the_derivatives_of_the_link_matrices(
        which in 0..3usize, q in angles::<6>(3.0), e in errors(0.3)
    ) {
        let mut chain = nominal()[which].clone();
        disturb(&mut chain, &e);
        let mut trace = Trace::default();
        Tracer::new(&chain).trace(&q, &mut trace);
        let joints: Vec<Dual64> = q.iter().map(|&q| q.into()).collect();
        for link in 0..chain.links.len() {
            for (k, parameter) in PARAMETERS.into_iter().enumerate() {
                let mut links: Vec<Link<Dual64>> =
                    numbers(&chain).iter().map(|l| l.map(Dual64::from)).collect();
                links[link][k] = links[link][k].derivative();
                let dual = independent::forward(&independent::identity(), &links, &joints);
                let twist = trace.twist(link, parameter).unwrap();
                let rotation = twist.angular.cross_matrix() * trace.rotation();
                for i in 0..3 {
                    for j in 0..3 {
                        prop_assert!((rotation[(i, j)] - dual[i][j].eps).abs() < 1e-12);
                    }
                    prop_assert!((twist.linear[i] - dual[i][3].eps).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn the_robot_finds_back_the_joints_of_a_chain_with_errors(
        which in 0..2usize, q in regular_robot(), e in errors(3e-3), shifted in angles::<6>(0.05)
    ) {
        let mut chain = nominal()[which].clone();
        disturb(&mut chain, &e);
        let target = chain.forward(&q);
        let near: [f64; 6] = std::array::from_fn(|i| q[i] + shifted[i]);
        let found = robot_inverse(&chain, &target, &near).unwrap();
        for (found, q) in found.iter().zip(q) {
            prop_assert!((found - q).abs() < 1e-9, "{found} instead of {q}");
        }
    }

    #[test]
    fn every_solution_of_the_robot_reaches_the_pose_and_they_differ(which in 0..2usize, q in regular_robot()) {
        let chain = &nominal()[which];
        let target = chain.forward(&q);
        let solutions = robot_inverse_all(chain, &target).unwrap();
        prop_assert!(solutions.len() >= 2 && solutions.len() <= 8);
        for (i, solution) in solutions.iter().enumerate() {
            prop_assert!(pose_distance(&chain.forward(solution), &target) < 1e-10);
            for other in &solutions[..i] {
                let apart = solution.iter().zip(other).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                prop_assert!(apart > 1e-6);
            }
        }
    }

    #[test]
    fn a_robot_turned_by_a_whole_turn_stays_on_its_turn(q in regular_robot()) {
        let chain = &nominal()[0];
        let mut turned = q;
        turned[5] += std::f64::consts::TAU;
        let found = robot_inverse(chain, &chain.forward(&q), &turned).unwrap();
        prop_assert!((found[5] - turned[5]).abs() < 1e-9);
    }

    #[test]
    fn the_bar_takes_its_pose_in_four_configurations_that_convert_into_each_other(b in regular_bar()) {
        let [.., mut chain] = nominal();
        chain.root_from_base = Pose::translation(1.0, 0.05, 0.35)
            * Pose::rotation(nalgebra::Vector3::new(0.3, -0.2, 0.0));
        let mut b = b;
        for ((link, joint), theta_rad) in chain.links.iter_mut().zip(&mut b).zip([0.2, 0.3, -0.4, -0.7, 0.1]) {
            link.theta_rad = theta_rad;
            *joint -= theta_rad;
        }
        let target = chain.forward(&b);
        let own = Configuration::from_joints(&chain.links, &b);
        for (configuration, joints) in ball_bar_inverse(&chain, &target).unwrap() {
            prop_assert_eq!(Configuration::from_joints(&chain.links, &joints), configuration);
            prop_assert!(pose_distance(&chain.forward(&joints), &target) < 1e-12);
            let carried = configuration.carry(&chain.links, &b);
            for (joint, carried) in joints.iter().zip(carried) {
                prop_assert!((joint - carried).sin().abs() < 1e-9 && (joint - carried).cos() > 0.0);
            }
            if configuration == own {
                for (joint, b) in joints.iter().zip(b) {
                    prop_assert!((joint - b).sin().abs() < 1e-9);
                }
            }
        }
    }

    #[test]
    fn the_bar_finds_back_the_joints_of_a_chain_with_errors(
        b in regular_bar(), e in errors(3e-3), shifted in angles::<5>(0.05)
    ) {
        let [.., mut chain] = nominal();
        disturb(&mut chain, &e);
        let near = std::array::from_fn(|i| b[i] + shifted[i]);
        let found = ball_bar_inverse_refined(&chain, &chain.forward(&b), &near).unwrap();
        for (found, b) in found.iter().zip(b) {
            prop_assert!((found - b).abs() < 1e-9, "{found} instead of {b}");
        }
    }
}

#[test]
fn signs_that_mirror_an_arm_are_found_where_there_are_any() {
    for robot in [crate::support::irb2400(), crate::support::nj220()] {
        assert_eq!(mirroring_joints(&flange_chain(&robot)), Some(vec![0, 3, 5]), "{}", robot.name);
    }
    // The wrist of this arm is outside the plane of the arm.
    let [mut beside, ..] = nominal();
    beside.links[1].d_m = 0.16;
    assert_eq!(mirroring_joints(&beside), None);
}
