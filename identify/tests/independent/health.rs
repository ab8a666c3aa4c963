//! Tests whether a motion determines the parameters of the robot. If it does not, a refusal is correct.

use nalgebra::{DMatrix, DVector, Matrix6, SMatrix, Vector6};

use super::kinematics::{Arm, Bar, difference};
use super::robots::Robot;

/// Assumed error of each angle, caused by gears, resolvers and encoders \[rad\].
const ANGLE_RAD: f64 = 30e-6;

/// Number of poses that count as independent. Gear errors are correlated over seconds, so more poses add little information.
const POSES: usize = 150;

/// One parameter that a calibration must identify.
#[derive(Clone, Copy)]
enum Number {
    /// Parameter of a robot link: a, alpha, d or theta.
    Link(usize, usize),
    /// Offset of an encoder.
    Offset(usize),
    /// Position of the bar's base along this axis.
    Place(usize),
    /// Tilt of the bar's base about x or y.
    Lean(usize),
    Length,
}

impl Number {
    fn all(robot: &Robot) -> Vec<Self> {
        let kinds = ["ra", "ralpha", "rd", "rtheta"];
        let mut all: Vec<Self> = (0..24)
            .map(|index| (index / 4, index % 4))
            .filter(|(link, kind)| {
                let name = format!("{}{}", kinds[*kind], link + 1);
                name != "ra6" && !robot.undetermined.contains(&name.as_str())
            })
            .map(|(link, kind)| Self::Link(link, kind))
            .collect();
        all.extend((0..5).map(Self::Offset));
        all.extend((0..3).map(Self::Place));
        all.extend((0..2).map(Self::Lean));
        all.push(Self::Length);
        all
    }

    /// Difference between the ends of the two chains if this parameter is wrong by `by` \[m, rad\].
    fn apart(self, by: f64, arm: &Arm, bar: &Bar, bar_rad: &[f64; 5], robot_rad: &[f64; 6]) -> Vector6<f64> {
        let (mut arm, mut bar) = (arm.clone(), bar.clone());
        match self {
            Self::Link(link, 0) => arm.links[link].a_m += by,
            Self::Link(link, 1) => arm.links[link].alpha_rad += by,
            Self::Link(link, 2) => arm.links[link].d_m += by,
            Self::Link(link, _) => arm.links[link].theta_rad += by,
            Self::Offset(joint) => bar.links[joint].theta_rad += by,
            Self::Place(axis) => bar.world_from_base[(axis, 3)] += by,
            Self::Lean(axis) => {
                let lean = if axis == 0 { nalgebra::Vector3::x() } else { nalgebra::Vector3::y() };
                bar.world_from_base *= nalgebra::Rotation3::new(lean * by).to_homogeneous();
            }
            Self::Length => bar.links[2].d_m += by,
        }
        difference(&arm.pose(robot_rad), &bar.pose(bar_rad, 0.0))
    }
}

/// Lower bound of the error of the robot's parameters \[mm|mrad\]. It is the Euclidean norm of their standard deviations
/// (Cramer-Rao bound), if each angle has an error of [`ANGLE_RAD`].
pub fn bound_mm_mrad(robot: &Robot, arm: &Arm, bar: &Bar, poses: &[([f64; 5], [f64; 6])]) -> f64 {
    const STEP: f64 = 1e-6;
    let numbers = Number::all(robot);
    let mut normal = DMatrix::zeros(numbers.len(), numbers.len());
    let every = (poses.len() / POSES).max(1);
    for (bar_rad, robot_rad) in poses.iter().step_by(every) {
        let slope = |number: &Number| {
            let of = |by| number.apart(by, arm, bar, bar_rad, robot_rad);
            (of(STEP) - of(-STEP)) / (2.0 * STEP)
        };
        let joints: Vec<Vector6<f64>> = (0..6)
            .map(|joint| slope(&Number::Link(joint, 3)))
            .chain((0..5).map(|joint| slope(&Number::Offset(joint))))
            .collect();
        let by_joints = SMatrix::<f64, 6, 11>::from_columns(&joints);
        let covariance: Matrix6<f64> = by_joints * by_joints.transpose() * ANGLE_RAD.powi(2);
        let Some(weight) = covariance.try_inverse() else { return f64::INFINITY };
        let columns: Vec<Vector6<f64>> = numbers.iter().map(slope).collect();
        let jacobian = DMatrix::from_fn(6, columns.len(), |row, column| columns[column][row]);
        normal += jacobian.transpose() * DMatrix::from_column_slice(6, 6, weight.as_slice()) * &jacobian;
    }
    // Millimetres and milliradians have equal weight, so no scaling is needed.
    let Some(covariance) = normal.cholesky().map(|factor| factor.inverse()) else { return f64::INFINITY };
    let variances: DVector<f64> = covariance.diagonal();
    let of_robot =
        numbers.iter().zip(variances.iter()).filter(|(number, _)| matches!(number, Number::Link(..)));
    of_robot.map(|(_, variance)| variance).sum::<f64>().sqrt() * 1e3
}
