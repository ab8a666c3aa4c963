//! Compares the analytic Jacobians of the costs with automatic differentiation of an independent kinematics.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

mod closed_chain;

use crate::support::Cell;
use crate::support::independent::{Matrix, forward};
use closed_chain::{Numbers, Sines, coupled, coupled_drives, true_joints};
use identify::cost::{
    AngleNoise, Length, LoopProblem, MeasuredLength, Position, PositionAngles, Residual, Transform,
    WhitenedPose, fill_in,
};
use identify::kinematics::{Chain, ImpliedBar, Tracer};
use identify::logs::LengthRow;
use identify::model::{Axis, BarForce, Model, Observation, Owner, ParameterId, Role};
use identify::solver::stacked;
use nalgebra::DMatrix;
use num_dual::{Dual64, DualNum};

type Independent = fn(&Numbers<Dual64>, &Observation) -> Vec<Dual64>;

fn independent_length(n: &Numbers<Dual64>, o: &Observation) -> Vec<Dual64> {
    let r = n.robot_end(o.t_s);
    let square = |x: Dual64| x * x;
    let from_origin = (0..3).map(|i| square(r[i][3] - n.origin[i])).fold(Dual64::from(0.0), |a, b| a + b);
    vec![from_origin - square(n.bar[2][2])]
}

fn independent_transform(n: &Numbers<Dual64>, o: &Observation) -> Vec<Dual64> {
    let (r, b) = (n.robot_end(o.t_s), n.bar_end(&n.bar_joints(o)));
    (0..4).flat_map(|j| (0..3).map(move |i| r[i][j] - b[i][j])).collect()
}

fn independent_position(n: &Numbers<Dual64>, o: &Observation) -> Vec<Dual64> {
    independent_transform(n, o).split_off(9)
}

/// Five equations whose left sides are zero at the implied joints of the bar: three for the rotation, and
/// two for the position across the rod.
fn conditions(n: &Numbers<Dual64>, target: &Matrix<Dual64>, bar: &[Dual64; 5]) -> [Dual64; 5] {
    let end = n.bar_end(bar);
    let gimbal = forward(&n.bar_base(), &n.bar[..2], &bar[..2]);
    // Antisymmetric part of the remaining rotation.
    let turned = |i: usize, j: usize| (0..3).map(|k| target[i][k] * end[j][k]).sum::<Dual64>();
    let across = |axis: usize| (0..3).map(|i| gimbal[i][axis] * (target[i][3] - end[i][3])).sum::<Dual64>();
    [
        turned(2, 1) - turned(1, 2),
        turned(0, 2) - turned(2, 0),
        turned(1, 0) - turned(0, 1),
        across(0),
        across(1),
    ]
}

/// Solves the equations for the joints of the bar by Newton's method. Dual numbers also give the derivatives of the joints.
fn independent_implied(n: &Numbers<Dual64>, target: &Matrix<Dual64>, start: [f64; 5]) -> [Dual64; 5] {
    let mut bar = start.map(Dual64::from);
    for _ in 0..12 {
        let at = conditions(n, target, &bar);
        let by_joint = nalgebra::Matrix5::from_fn(|i, j| {
            let mut moved = bar.map(|b| Dual64::from(b.re));
            moved[j].eps = 1.0;
            let fixed = n.without_derivative();
            conditions(&fixed, &target.map(|row| row.map(|x| Dual64::from(x.re))), &moved)[i].eps
        });
        let inverse = by_joint.try_inverse().unwrap();
        let step = |part: fn(&Dual64) -> f64| inverse * nalgebra::Vector5::from_fn(|i, _| part(&at[i]));
        let (re, eps) = (step(|x| x.re), step(|x| x.eps));
        for (j, b) in bar.iter_mut().enumerate() {
            *b -= Dual64::new(re[j], eps[j]);
        }
    }
    bar
}

fn independent_position_angles(n: &Numbers<Dual64>, o: &Observation) -> Vec<Dual64> {
    // The library is used only to select one of several solutions.
    let (robot, bar) = n.chains();
    let tau = n.clock[0].re + (1.0 + n.clock[1].re) * o.t_s;
    let errors = n.joint_errors.map(|axis| axis.map(|x| x.re));
    let waves = n.joint_waves.map(|axis| axis.map(|order| order.map(|x| x.re)));
    let target = robot.forward(&true_joints(&n.arm, &errors, &waves, tau));
    let implied = ImpliedBar::new(&bar, &Tracer::new(&bar), &target, &o.bar_rad.map(Some)).unwrap();
    let near = implied.joints_rad.map(|b| b + 0.01);
    let implied = independent_implied(n, &n.robot_end(o.t_s), near);
    let mut residual = independent_position(n, o);
    residual.extend([3, 4].map(|joint: usize| (implied[joint] - n.bar_joints(o)[joint]).sin()));
    residual
}

/// Noise of each length, divided by the noise of the median length.
const LENGTH_NOISE: f64 = 0.4;

/// Length that a wire measures at the time of an observation.
fn length_m(o: &Observation) -> f64 {
    1.0 + 0.01 * o.t_s
}

fn independent_measured_length(n: &Numbers<Dual64>, o: &Observation) -> Vec<Dual64> {
    let r = n.robot_end(o.t_s);
    let squares = (0..3).map(|i| {
        let [x, y, z] = n.attachment;
        let along = r[i][0] * x + r[i][1] * y + r[i][2] * z + r[i][3] - n.anchor[i];
        along * along
    });
    let distance = squares.fold(Dual64::from(0.0), |a, b| a + b).sqrt();
    vec![((n.scale + 1.0) * distance + n.offset - length_m(o)) / LENGTH_NOISE]
}

/// Frees all parameters of the model. Their values avoid points at which derivatives vanish by symmetry.
fn all_free(model: Model) -> Model {
    all_free_but(model, |_| false)
}

/// Frees all parameters of the model. Those whose name satisfies `nominal` keep their nominal values.
fn all_free_but(mut model: Model, nominal: impl Fn(&str) -> bool) -> Model {
    let ids = model.ids();
    for (i, id) in ids.into_iter().enumerate() {
        let value = model.parameter(id).unwrap().value;
        let by = if nominal(&id.to_string()) { 0.0 } else { 0.02 * (1.7 * i as f64).sin() };
        model.set_value(id, value + by).unwrap();
        model.set_role(id, Role::Free).unwrap();
    }
    model
}

const OBSERVATIONS: usize = 20;

fn observations() -> Vec<Observation> {
    (0..OBSERVATIONS)
        .map(|k| {
            let k = k as u32;
            let t = 0.4 * f64::from(k) - 3.0;
            let mut o =
                Observation::bar(t, [0, 1, 2, 3, 4].map(|j| 2.0 * (t * (0.5 + 0.1 * f64::from(j))).sin()));
            o.origin = (k % 2) as usize;
            o.force = BarForce { along_n: (1.3 * t).sin(), side: (0.9 * t + 1.0).cos() };
            o
        })
        .collect()
}

/// Checks that every column of the Jacobian agrees to 1e-9 of the largest entry of its kind. Columns of parameters
/// without effect on the cost must be zero.
fn agrees<R: Residual>(arm: &Chain, model: &Model, residual: R, independent: Independent) {
    let observations = observations();
    let problem = LoopProblem::new(model, &Sines, &observations, residual, 1.0).unwrap();
    let (r, jacobian) = stacked(&problem, &model.start()).unwrap();
    let geometry = model.geometry(&model.start());
    for (column, parameter) in model.columns().enumerate() {
        let mut numbers = Numbers::<Dual64>::new(arm, &geometry);
        let number = numbers.number(parameter.id);
        *number = number.derivative();
        let mut largest = 0.0f64;
        for (k, observation) in observations.iter().enumerate() {
            for (i, expected) in
                independent(&numbers.with_length_at(observation), observation).into_iter().enumerate()
            {
                let row = k * R::ROWS + i;
                assert!((r[row] - expected.re).abs() < 1e-12, "{} row {row}", R::NAME);
                let scale = jacobian.column(column).amax().max(expected.eps.abs()).max(1e-3);
                let error = (jacobian[(row, column)] - expected.eps).abs() / scale;
                assert!(error < 1e-9, "{} by {}: off by {error:e}", R::NAME, parameter.id);
                largest = largest.max(expected.eps.abs());
            }
        }
        assert_eq!(largest > 1e-12, R::depends_on(parameter.id, arm), "{} sees {}", R::NAME, parameter.id);
    }
}

#[test]
fn length_and_transform_have_the_derivatives_of_the_closed_chain_for_both_robots() {
    for cell in [Cell::irb2400(), Cell::nj220()] {
        let model = all_free(coupled(&cell));
        agrees(&cell.robot, &model, Length, independent_length);
        agrees(&cell.robot, &model, Transform, independent_transform);
    }
}

/// If these parameters are zero, the position of the bar's end does not depend on joints 3 to 5.
const LEVER_ARMS: [&str; 5] = ["ba3", "ba4", "ba5", "bd4", "bd5"];

/// `B^-1 R` as position and rotation vector, from matrices of dual numbers. The result is not whitened.
fn independent_pose(n: &Numbers<Dual64>, o: &Observation) -> Vec<Dual64> {
    let (r, b) = (n.robot_end(o.t_s), n.bar_end(&n.bar_joints(o)));
    let sum = |terms: [Dual64; 3]| terms[0] + terms[1] + terms[2];
    let q = |i: usize, j: usize| sum([0, 1, 2].map(|k| b[k][i] * r[k][j]));
    let mut pose: Vec<Dual64> =
        (0..3).map(|i| sum([0, 1, 2].map(|k| b[k][i] * (r[k][3] - b[k][3])))).collect();
    let axis = [q(2, 1) - q(1, 2), q(0, 2) - q(2, 0), q(1, 0) - q(0, 1)];
    let sine = sum(axis.map(|x| x * x)).sqrt() * 0.5;
    let angle = sine.atan2((q(0, 0) + q(1, 1) + q(2, 2) - 1.0) * 0.5);
    pose.extend(axis.map(|x| x * angle / (sine * 2.0)));
    pose
}

/// The whitening is constant except for the scale. For each sample, one matrix therefore maps all derivatives of the plain
/// pose to the derivatives of the cost. The position of the plain pose is in units of the rod's length.
#[test]
fn pose_has_the_derivatives_of_the_plain_pose_times_one_matrix_for_each_sample() {
    for cell in [Cell::irb2400(), Cell::nj220()] {
        let model = all_free(coupled(&cell));
        let observations = observations();
        let geometry = model.geometry(&model.start());
        let noise = AngleNoise { encoder_rad: 5e-6, robot_rad: 15e-6 };
        let residual = WhitenedPose::new(&geometry, &Sines, &observations, noise);
        let problem = LoopProblem::new(&model, &Sines, &observations, residual, 1.0).unwrap();
        let (r, jacobian) = stacked(&problem, &model.start()).unwrap();
        for (k, observation) in observations.iter().enumerate() {
            let mut plain = DMatrix::zeros(6, model.columns().len() + 1);
            for (column, parameter) in model.columns().enumerate() {
                let mut numbers = Numbers::<Dual64>::new(&cell.robot, &geometry);
                let number = numbers.number(parameter.id);
                *number = number.derivative();
                let rod = *numbers.number(ParameterId::ROD);
                let scale = [Dual64::from(rod.re) / rod, Dual64::from(1.0)];
                let numbers = numbers.with_length_at(observation);
                for (i, value) in independent_pose(&numbers, observation).into_iter().enumerate() {
                    let value = value * scale[i / 3];
                    plain[(i, column)] = value.eps;
                    plain[(i, model.columns().len())] = value.re;
                }
            }
            // Compute the covariance by propagation of uncertainty. The columns are the
            // derivatives by `theta` of each joint.
            let angle =
                |name: String| plain.column(model.column_of(name.parse().unwrap()).unwrap()).into_owned();
            let mut covariance = DMatrix::identity(6, 6) * 1e-14;
            let chains = [("r", 6, noise.robot_rad), ("b", 5, noise.encoder_rad)];
            for (chain, joints, sigma_rad) in chains {
                for joint in 1..=joints {
                    let moved = angle(format!("{chain}theta{joint}")) * sigma_rad;
                    covariance += &moved * moved.transpose();
                }
            }
            let lower = covariance.cholesky().unwrap().l();
            let expected = lower.solve_lower_triangular(&plain).unwrap();
            for column in 0..=model.columns().len() {
                for i in 0..6 {
                    let found =
                        if column < jacobian.ncols() { jacobian[(6 * k + i, column)] } else { r[6 * k + i] };
                    let scale = expected.column(column).amax().max(1.0);
                    let error = (found - expected[(i, column)]).abs() / scale;
                    assert!(error < 1e-9, "sample {k}, column {column}: off by {error:e}");
                }
            }
        }
    }
}

#[test]
fn position_has_the_derivatives_of_the_closed_chain_for_both_robots() {
    for cell in [Cell::irb2400(), Cell::nj220()] {
        let model = all_free_but(coupled(&cell), |name| LEVER_ARMS.contains(&name));
        agrees(&cell.robot, &model, Position, independent_position);
    }
}

#[test]
#[ignore = "takes more than four seconds"]
fn position_angles_have_the_derivatives_of_the_implied_joints_for_both_robots() {
    for cell in [Cell::irb2400(), Cell::nj220()] {
        let model = all_free_but(coupled(&cell), |name| LEVER_ARMS.contains(&name));
        agrees(&cell.robot, &model, PositionAngles, independent_position_angles);
    }
}

#[test]
fn joints_without_encoder_get_the_angles_that_the_robot_implies() {
    let cell = Cell::irb2400();
    let (observations, joints) = crate::support::spread_poses(&cell.robot, &cell.bar, 50, 4);
    let geometry = coupled(&cell).geometry(&[]);
    let mut four = observations.clone();
    for observation in &mut four {
        observation.measured[2] = false;
        observation.bar_rad[2] = 0.0;
    }
    fill_in(&geometry, &joints, &mut four);
    for (filled, known) in four.iter().zip(&observations) {
        let apart = filled.bar_rad[2] - known.bar_rad[2];
        assert!(apart.sin().abs() < 1e-9 && apart.cos() > 0.0, "{apart}");
    }
}

#[test]
fn measured_length_has_the_derivatives_of_the_wire_for_both_robots() {
    for Cell { robot, .. } in [Cell::irb2400(), Cell::nj220()] {
        let mut model =
            Model::alone(&robot).with_set_ups(Owner::Wire, [1, 1]).with_drives(coupled_drives(&robot));
        for axis in Axis::ALL {
            model.set_value(ParameterId::Attachment { target: 0, axis }, 0.1).unwrap();
            model.set_value(ParameterId::Anchor { station: 0, axis }, -0.7).unwrap();
        }
        let row = |o: &Observation| LengthRow { length_m: length_m(o), ..LengthRow::default() };
        let rows: Vec<LengthRow> = observations().iter().map(row).collect();
        let cost = MeasuredLength { rows: &rows, relative_noise: vec![LENGTH_NOISE; OBSERVATIONS] };
        agrees(&robot, &all_free(model), cost, independent_measured_length);
    }
}

#[test]
fn a_cost_refuses_observations_without_its_encoders() {
    let cell = Cell::irb2400();
    let model = all_free(coupled(&cell));
    let mut four = Observation::bar(0.0, [0.1; 5]);
    four.measured[2] = false;
    let without = [four];
    let error = LoopProblem::new(&model, &Sines, &without, Transform, 1.0).unwrap_err().to_string();
    assert!(error.contains("bar joint 3") && error.contains("transform"), "{error}");
    assert!(LoopProblem::new(&model, &Sines, &without, Length, 1.0).is_ok());
    let nan = [Observation::bar(0.0, [f64::NAN; 5])];
    assert!(LoopProblem::new(&model, &Sines, &nan, Transform, 1.0).is_err());
    let mut pulled = Observation::bar(0.0, [0.1; 5]);
    pulled.force.along_n = f64::NAN;
    assert!(LoopProblem::new(&model, &Sines, &[pulled], Transform, 1.0).is_err());
    assert!(LoopProblem::new(&model, &Sines, &without, Length, 0.0).is_err());
}

#[test]
fn names_and_parameters_are_one_to_one() {
    let names: Vec<String> = ParameterId::all().map(|id| id.to_string()).collect();
    for (id, name) in ParameterId::all().zip(&names) {
        assert_eq!(name.parse::<ParameterId>().unwrap(), id);
        assert_eq!(names.iter().filter(|other| *other == name).count(), 1);
    }
    assert!("ra9".parse::<ParameterId>().is_err());
    let chain: &Chain = &Cell::irb2400().robot;
    assert!(
        Model::alone(chain)
            .with_set_ups(Owner::Wire, [1, 1])
            .set_role("ra7".parse().unwrap(), Role::Free)
            .is_err()
    );
    assert!(
        Model::alone(chain)
            .with_set_ups(Owner::Wire, [1, 1])
            .set_role("ba1".parse().unwrap(), Role::Free)
            .is_err()
    );
}
