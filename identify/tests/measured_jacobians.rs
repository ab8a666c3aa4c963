//! Compares the analytic Jacobians of the costs for a tracker, for a ball in sockets, and for a tip on faces with automatic
//! differentiation of an independent kinematics.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use crate::support::Cell;
use crate::support::independent::{Link, Matrix, forward, identity, product};
use identify::cost::{
    LoopProblem, MeasuredPose, MeasuredPosition, PoseNoise, Residual, SeatedBall, TouchedFace,
};
use identify::kinematics::{LinkParameter, Pose};
use identify::logs::{PoseRow, TipRow};
use identify::model::{
    Axis, Coordinate, FaceNumber, JointState, Model, Observation, Owner, ParameterId, Phase, Placement,
    RobotMotion, Role, SetUp,
};
use identify::solver::stacked;
use nalgebra::{Rotation3, Vector3};
use num_dual::{Dual64, DualNum};
use proptest::prelude::*;

/// Orders of the joint harmonics that are tested. Further orders use the same code.
const WAVES: [u8; 2] = [3, 7];

/// A smooth motion whose joints are analytic functions of time.
struct Sines;

fn sines(tau: Dual64) -> [Dual64; 6] {
    std::array::from_fn(|i| {
        let i = i as f64;
        (tau * (0.3 + 0.17 * i) + i).sin() * (0.9 - 0.05 * i) + 0.1 * i
    })
}

impl RobotMotion for Sines {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        let moved = sines(Dual64::new(tau_s, 1.0));
        Some(JointState {
            q: moved.map(|q| q.re).into(),
            qd: moved.map(|q| q.eps).into(),
            qdd: [0.0; 6].into(),
        })
    }
}

/// Rotation matrix as the exponential series of `[w]`. It uses no trigonometric functions.
fn exponential(w: [Dual64; 3]) -> Matrix<Dual64> {
    let zero = Dual64::from(0.0);
    let cross = [[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]];
    let mut generator = [[zero; 4]; 4];
    for i in 0..3 {
        generator[i][..3].copy_from_slice(&cross[i]);
    }
    let mut term = identity();
    let mut sum: Matrix<Dual64> = identity();
    for n in 1..60 {
        term = product(&term, &generator).map(|row| row.map(|x| x / f64::from(n)));
        for i in 0..4 {
            for j in 0..4 {
                sum[i][j] += term[i][j];
            }
        }
    }
    sum
}

/// Pose from three coordinates of the position, followed by three of the rotation vector.
fn placed(six: &[Dual64]) -> Matrix<Dual64> {
    let mut m = exponential([six[3], six[4], six[5]]);
    (0..3).for_each(|i| m[i][3] = six[i]);
    m
}

/// The value of parameter `id` as a dual number that is differentiated with respect to parameter `by`.
fn dual(model: &Model, by: ParameterId, id: ParameterId) -> Dual64 {
    let value = model.parameter(id).map_or(0.0, |p| p.value);
    Dual64::new(value, if id == by { 1.0 } else { 0.0 })
}

/// Pose of the robot's flange from its links and clocks, in dual numbers.
fn flange(model: &Model, by: ParameterId, t_s: f64) -> Matrix<Dual64> {
    let number = |id: ParameterId| dual(model, by, id);
    use LinkParameter::{A, Alpha, Beta, D, Theta};
    let links: Vec<Link<Dual64>> = (0..6)
        .map(|link| {
            [A, Alpha, D, Theta, Beta].map(|parameter| number(ParameterId::Robot { link, parameter }))
        })
        .collect();
    let tau = number(ParameterId::ClockShift) + (number(ParameterId::ClockSkew) + 1.0) * t_s;
    let mut joints = sines(tau);
    for (joint, q) in joints.iter_mut().enumerate() {
        let reported = *q;
        for order in WAVES {
            let amplitude = |phase| number(ParameterId::JointWave { axis: joint, order, phase });
            let angle = reported * f64::from(order);
            *q += amplitude(Phase::Sine) * angle.sin() + amplitude(Phase::Cosine) * angle.cos();
        }
    }
    forward(&identity(), &links, &joints)
}

/// Pose of the probe as predicted by the robot, and as measured by the tracker.
fn probes(model: &Model, by: ParameterId, t_s: f64, measured: &PoseRow) -> [Matrix<Dual64>; 2] {
    let SetUp { station, target } = measured.set_up;
    let place = Coordinate::ALL.map(|coordinate| ParameterId::Tracker { station, coordinate });
    let probe = Coordinate::ALL.map(|coordinate| ParameterId::Probe { target, coordinate });
    let six: Vec<Dual64> = place.into_iter().chain(probe).map(|id| dual(model, by, id)).collect();
    let m = Pose::from_parts(measured.position_m.into(), measured.rotation.unwrap()).to_homogeneous();
    let mut measured: Matrix<Dual64> =
        std::array::from_fn(|i| std::array::from_fn(|j| Dual64::from(m[(i, j)])));
    let scale = dual(model, by, ParameterId::Scale);
    measured[..3].iter_mut().for_each(|row| row[3] /= scale + 1.0);
    let held = product(&flange(model, by, t_s), &placed(&six[6..]));
    [held, product(&placed(&six[..6]), &measured)]
}

/// Predicted minus measured position of the probe.
fn position([held, seen]: &[Matrix<Dual64>; 2]) -> Vec<Dual64> {
    (0..3).map(|i| held[i][3] - seen[i][3]).collect()
}

/// Rotation vector of `S^T H`, with the predicted rotation `H` and the measured rotation `S`. It is computed
/// from angle and axis.
fn turn([held, seen]: &[Matrix<Dual64>; 2]) -> Vec<Dual64> {
    let q = |i: usize, j: usize| (0..3).map(|k| seen[k][i] * held[k][j]).sum::<Dual64>();
    let twice_sine_axis = [q(2, 1) - q(1, 2), q(0, 2) - q(2, 0), q(1, 0) - q(0, 1)];
    let twice_sine = twice_sine_axis.iter().map(|x| *x * *x).sum::<Dual64>().sqrt();
    let angle = twice_sine.atan2(q(0, 0) + q(1, 1) + q(2, 2) - 1.0);
    twice_sine_axis.iter().map(|x| *x * angle / twice_sine).collect()
}

fn times() -> impl Iterator<Item = f64> {
    (0..20).map(|k| 0.4 * f64::from(k) - 3.0)
}

/// Varied poses as measurements of the tracker, all with one set-up.
fn measured() -> Vec<PoseRow> {
    let row = |t: f64| {
        let turn = Rotation3::new(Vector3::new(0.4 * t.sin(), 0.3, 0.2 * t.cos()));
        let position_m = Vector3::new(1.0 + 0.1 * t, t.sin(), 0.5);
        PoseRow { position_m, rotation: Some(turn), ..PoseRow::default() }
    };
    times().map(row).collect()
}

/// Compares residual and Jacobian of a cost with `independent`. `independent` returns the residual of a sample as dual
/// numbers. Its arguments are the parameter of the derivative, the index of the sample, and the time of the sample. Also
/// checks that the derivative by a parameter is zero if and only if the residual does not depend on the parameter.
fn agrees<R: Residual>(
    model: &Model,
    residual: R,
    independent: impl Fn(ParameterId, usize, f64) -> Vec<Dual64>,
) {
    let observations: Vec<Observation> = times().map(|t| Observation::bar(t, [0.0; 5])).collect();
    let problem = LoopProblem::new(model, &Sines, &observations, residual, 1.0).unwrap();
    let (r, jacobian) = stacked(&problem, &model.start()).unwrap();
    assert_eq!(r.len(), R::ROWS * observations.len());
    for (column, parameter) in model.columns().enumerate() {
        let scale = jacobian.column(column).amax().max(1e-3);
        let mut largest = 0.0_f64;
        for (k, t_s) in times().enumerate() {
            let expected = independent(parameter.id, k, t_s);
            for (i, expected) in expected.into_iter().enumerate() {
                let row = k * R::ROWS + i;
                assert!((r[row] - expected.re).abs() < 1e-9, "{} row {row}", R::NAME);
                let error = (jacobian[(row, column)] - expected.eps).abs() / scale;
                assert!(error < 1e-9, "{} by {}: off by {error:e}", R::NAME, parameter.id);
                largest = largest.max(expected.eps.abs());
            }
        }
        assert_eq!(
            largest > 1e-12,
            R::depends_on(parameter.id, model.robot()),
            "{} sees {}",
            R::NAME,
            parameter.id
        );
    }
}

/// Frees all parameters. Their values avoid points at which derivatives vanish by symmetry.
fn all_free(model: Model, rotation_rad: [f64; 3]) -> Model {
    let mut model = model.with(ParameterId::joint_waves(7));
    // The derivatives by the errors of the robot's axes do not depend on the cost. They are tested in `jacobians`.
    let ids = model.ids().into_iter().filter(|id| match id {
        ParameterId::Joint { .. } => false,
        ParameterId::JointWave { order, .. } => WAVES.contains(order),
        _ => true,
    });
    let ids: Vec<ParameterId> = ids.collect();
    for (i, id) in ids.into_iter().enumerate() {
        let rotation = match id {
            ParameterId::Tracker { coordinate: Coordinate::Rotation(axis), .. } => rotation_rad[axis.index()],
            ParameterId::Probe { coordinate: Coordinate::Rotation(axis), .. } => {
                -0.5 * rotation_rad[2 - axis.index()]
            }
            _ => 0.0,
        };
        let value = model.parameter(id).unwrap().value + 0.02 * (1.7 * i as f64).sin() + rotation;
        model.set_value(id, value).unwrap();
        model.set_role(id, Role::Free).unwrap();
    }
    model
}

#[test]
fn measured_position_and_pose_have_the_derivatives_of_tracker_and_robot() {
    let mut rows = measured();
    for (number, row) in rows.iter_mut().enumerate() {
        row.set_up = SetUp { station: number % 2, target: number * 2 % 3 };
    }
    // Each row has a different uncertainty.
    let noise =
        |row| PoseNoise { position_m: 0.2 + 0.01 * row as f64, rotation_rad: 0.5 - 0.02 * row as f64 };
    let noises: Vec<PoseNoise> = (0..rows.len()).map(noise).collect();
    let (rows, noise) = (&rows[..], &noises[..]);
    for Cell { robot, .. } in [Cell::irb2400(), Cell::nj220()] {
        for rotation_rad in [[0.0; 3], [0.3, -1.9, 1.2]] {
            let model = all_free(Model::alone(&robot).with_set_ups(Owner::Tracker, [2, 3]), rotation_rad);
            let probes = |by, row: usize, t_s| probes(&model, by, t_s, &rows[row]);
            agrees(&model, MeasuredPosition { rows, noise }, |by, row, t_s| {
                let sigma_m = noises[row].position_m;
                position(&probes(by, row, t_s)).into_iter().map(|x| x / sigma_m).collect()
            });
            agrees(&model, MeasuredPose { rows, noise }, |by, row, t_s| {
                let noise = noises[row];
                let probes = probes(by, row, t_s);
                let [linear, angular] = [position(&probes), turn(&probes)];
                let linear = linear.into_iter().map(|x| x / noise.position_m);
                linear.chain(angular.into_iter().map(|x| x / noise.rotation_rad)).collect()
            });
        }
    }
}

#[test]
fn a_ball_in_sockets_has_the_derivatives_of_ball_sockets_and_robot() {
    const SOCKETS: usize = 3;
    let row = |row: usize| TipRow { part: row * 2 % SOCKETS, ..TipRow::default() };
    let rows: Vec<TipRow> = (0..times().count()).map(row).collect();
    for Cell { robot, .. } in [Cell::irb2400(), Cell::nj220()] {
        let model = all_free(
            Model::alone(&robot).with_set_ups(Owner::Contact, [SOCKETS, 1]).without_clocks(),
            [0.0; 3],
        );
        agrees(&model, SeatedBall { rows: &rows }, |by, row, t_s| {
            let number = |id| dual(&model, by, id);
            let flange = flange(&model, by, t_s);
            let ball = Axis::ALL.map(|axis| number(ParameterId::Ball { axis }));
            let at = |i: usize| (0..3).map(|k| flange[i][k] * ball[k]).sum::<Dual64>() + flange[i][3];
            let socket = |axis| number(ParameterId::Socket { socket: rows[row].part, axis });
            Axis::ALL.map(|axis| at(axis.index()) - socket(axis)).to_vec()
        });
    }
}

#[test]
fn a_tip_on_faces_has_the_derivatives_of_tip_faces_and_robot() {
    const FACES: usize = 2;
    let row = |row: usize| TipRow { part: row % FACES, reading_m: 1e-3 * row as f64, ..TipRow::default() };
    let rows: Vec<TipRow> = (0..times().count()).map(row).collect();
    for Cell { robot, .. } in [Cell::irb2400(), Cell::nj220()] {
        let mut model =
            all_free(Model::alone(&robot).with_set_ups(Owner::Touch, [FACES, 1]).without_clocks(), [0.0; 3]);
        for (face, normal) in [[1.0, 0.2, -0.1], [0.3, -1.0, 0.4]].into_iter().enumerate() {
            for (axis, value) in Axis::ALL.into_iter().zip(normal) {
                model.set_value(ParameterId::Face { face, number: FaceNumber::Normal(axis) }, value).unwrap();
            }
        }
        agrees(&model, TouchedFace { rows: &rows }, |by, row, t_s| {
            let number = |id| dual(&model, by, id);
            let flange = flange(&model, by, t_s);
            let tip = Axis::ALL.map(|axis| number(ParameterId::Tip { axis }));
            let TipRow { part: face, reading_m, .. } = rows[row];
            let normal =
                Axis::ALL.map(|axis| number(ParameterId::Face { face, number: FaceNumber::Normal(axis) }));
            let at = |i: usize| (0..3).map(|k| flange[i][k] * tip[k]).sum::<Dual64>() + flange[i][3];
            let height = (0..3).map(|i| normal[i] * at(i)).sum::<Dual64>()
                - number(ParameterId::Face { face, number: FaceNumber::Distance });
            let length = normal.iter().map(|n| *n * *n).sum::<Dual64>().sqrt();
            vec![height / length + reading_m]
        });
    }
}

#[test]
fn samples_that_were_not_measured_take_no_part() {
    let Cell { robot, .. } = Cell::irb2400();
    let model = all_free(Model::alone(&robot).with_set_ups(Owner::Tracker, [1, 1]), [0.0; 3]);
    let observations: Vec<Observation> = times().map(|t| Observation::bar(t, [0.0; 5])).collect();
    let noise = &[PoseNoise { position_m: 1e-4, rotation_rad: 1e-4 }; 12];
    let residual = MeasuredPose { rows: &measured()[..12], noise };
    let problem = LoopProblem::new(&model, &Sines, &observations, residual, 1.0).unwrap();
    assert_eq!(stacked(&problem, &model.start()).unwrap().0.len(), 6 * 12);
}

proptest! {
    /// The derivative of a placement's rotation is an angular velocity, which is compared with
    /// finite differences of the rotation.
    #[test]
    fn a_placement_turns_as_its_rotation_vector_says(w in prop::array::uniform3(-1.8_f64..1.8), small in any::<bool>()) {
        let scale = if small { 1e-3 } else { 1.0 };
        let at = |w: [f64; 3]| Placement { position_m: Vector3::zeros(), rotation_rad: w.map(|x| x * scale).into() };
        let here = at(w);
        for axis in Axis::ALL {
            let step = 1e-6;
            let (mut up, mut down) = (here, here);
            up.rotation_rad[axis.index()] += step;
            down.rotation_rad[axis.index()] -= step;
            let rate = (up.pose().rotation.matrix() - down.pose().rotation.matrix()) / (2.0 * step);
            let turning = rate * here.pose().rotation.matrix().transpose();
            let expected = here.turning(axis).cross_matrix();
            prop_assert!((turning - expected).amax() < 1e-8);
        }
        let back = Placement::from_pose(&here.pose());
        prop_assert!((back.pose().rotation.matrix() - here.pose().rotation.matrix()).amax() < 1e-14);
    }
}
