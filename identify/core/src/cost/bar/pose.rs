//! The default cost. It compares the pose `B^-1 R` of the robot's end relative to the bar's end, whitened by the covariance
//! of this pose. It needs all five encoders, or all except that of joint 3.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use super::angle_noise::NoisySample;
use crate::cost::problem::{LoopPoint, readings};
use crate::cost::residual::{ALL_BUT_ROD_JOINT, ALL_ENCODERS, ROD_JOINT, encoders_suffice};
use crate::cost::{AngleNoise, FoundNoise, Movement, Residual, Scene};
use crate::kinematics::{Chain, LinkParameter, ROD_LINK, Trace, rotation_vector};
use crate::model::{Geometry, Observation, ParameterId, RobotMotion};

/// Standard deviation that is added in each direction \[m, rad\]. Near a singular pose, the noise of both chains vanishes in
/// some directions. The added value limits the weights of these directions.
const FLOOR: f64 = 1e-7;
/// Standard deviation that is assumed for the angle of a joint without encoder \[rad\]. It is large compared
/// with the microradians of an encoder, so the angle has practically no weight. Because it is finite, the
/// covariance can be factorised.
const UNKNOWN_RAD: f64 = 0.1;

/// Cost `pose`. The residual is the position \[m\] and the rotation vector \[rad\] of `B^-1 R`, multiplied by the inverse
/// Cholesky factor of their covariance. The six resulting numbers have unit standard deviation (they are whitened).
///
/// The covariance of a sample is propagated from the noise of its eleven angles. It is computed once, on the geometry that
/// [`WhitenedPose::new`] receives, and stays constant in a solve. Residual and derivative are therefore consistent. Geometry
/// errors of millimetres change the covariance by thousandths. If this matters, compute the covariance again at the solution
/// and solve once more.
///
/// The weights of positions are not constant: during the solve they are inversely proportional to the length of the rod.
/// With constant weights the estimated scale would be too small, because all position errors shrink with the scale. If only
/// a prior determines the scale, this error would be several standard deviations.
///
/// Without encoder 3 the rotation about the rod is unknown. The residual then has no weight in the directions in which this
/// rotation moves the end.
#[derive(Debug, Clone)]
pub struct PoseByNoise<const ENCODER_3: bool> {
    /// Inverse Cholesky factor of each sample's covariance. `None` if the sample has no value.
    whitening: Vec<Option<Matrix6<f64>>>,
    /// Length of the rod for which `whitening` was computed \[m\].
    rod_m: f64,
}

/// The cost for all five encoders.
pub type WhitenedPose = PoseByNoise<true>;
/// The cost for encoders 1, 2, 4 and 5.
pub type WhitenedPoseOfFour = PoseByNoise<false>;

impl<const ENCODER_3: bool> PoseByNoise<ENCODER_3> {
    /// Computes the whitening of each observation on this geometry.
    pub fn new(
        geometry: &Geometry,
        motion: &impl RobotMotion,
        observations: &[Observation],
        noise: AngleNoise,
    ) -> Self {
        let whitening = Self::noisy_samples(geometry, motion, observations).map(|sample| {
            let lower = sample?.covariance(noise).cholesky()?.l();
            lower.solve_lower_triangular(&Matrix6::identity())
        });
        Self { whitening: whitening.collect(), rod_m: rod_length_m(geometry) }
    }

    /// Estimates the noise from the observations, on a geometry for which `columns` parameters were fitted. The iteration
    /// begins at `start`. `None` if there are too few observations.
    pub fn noise(
        geometry: &Geometry,
        motion: &impl RobotMotion,
        observations: &[Observation],
        columns: usize,
        start: AngleNoise,
    ) -> Option<FoundNoise> {
        let samples: Vec<_> = Self::noisy_samples(geometry, motion, observations).collect();
        FoundNoise::estimate(&samples, columns, start)
    }

    /// The residual of each observation, with its covariances. `None` if the robot's log does not cover the observation.
    fn noisy_samples(
        geometry: &Geometry,
        motion: &impl RobotMotion,
        observations: &[Observation],
    ) -> impl Iterator<Item = Option<NoisySample>> {
        let mut point = LoopPoint::new(geometry.clone());
        observations.iter().enumerate().map(move |(sample, observation)| {
            let readings = readings(observation);
            Some(noisy_sample::<ENCODER_3>(&point.scene(motion, sample, observation, &readings)?))
        })
    }
}

/// Length of the rod \[m\]. The weights of positions are relative to this length.
fn rod_length_m(geometry: &Geometry) -> f64 {
    geometry.bar_links.get(ROD_LINK).map_or(1.0, |rod| rod.d_m)
}

/// Position and rotation vector of `B^-1 R`, with their derivatives with respect to the twists of both ends. A twist has
/// the order linear, angular.
struct RelativePose {
    value: Vector6<f64>,
    by_robot: Matrix6<f64>,
    by_bar: Matrix6<f64>,
}

impl RelativePose {
    fn new(scene: &Scene<'_>) -> Self {
        let bar_from_root = scene.bar.rotation().transpose();
        let difference_m = scene.robot.position_m() - scene.bar.position_m();
        let turn_rad = rotation_vector(&(bar_from_root * scene.robot.rotation()));
        let turn_by_angular = inverse_left_jacobian(&turn_rad) * bar_from_root;
        let mut value = Vector6::zeros();
        value.fixed_rows_mut::<3>(0).copy_from(&(bar_from_root * difference_m));
        value.fixed_rows_mut::<3>(3).copy_from(&turn_rad);
        let mut by_robot = Matrix6::zeros();
        by_robot.fixed_view_mut::<3, 3>(0, 0).copy_from(&bar_from_root);
        by_robot.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn_by_angular);
        // A rotation of the bar's end also rotates the frame in which the position is expressed.
        let mut by_bar = -by_robot;
        by_bar.fixed_view_mut::<3, 3>(0, 3).copy_from(&(bar_from_root * difference_m.cross_matrix()));
        Self { value, by_robot, by_bar }
    }
}

/// Derivative of the rotation vector `w` of a rotation `Q` with respect to an angular velocity `v`, where `dQ = [v] Q`. It
/// is the matrix `1 - [w]/2 + c [w]^2` with `c = 1/t^2 - cot(t/2)/(2t)` and `t = |w|`.
pub(in crate::cost) fn inverse_left_jacobian(w: &Vector3<f64>) -> Matrix3<f64> {
    let squared = w.norm_squared();
    // For small angles the formula of `c` suffers from cancellation, so a series is used.
    let c = if squared < 1e-2 {
        1.0 / 12.0 + squared * (1.0 / 720.0 + squared * (1.0 / 30240.0 + squared / 1_209_600.0))
    } else {
        let angle = squared.sqrt();
        (1.0 - 0.5 * angle / (0.5 * angle).tan()) / squared
    };
    let cross = w.cross_matrix();
    Matrix3::identity() - cross * 0.5 + cross * cross * c
}

/// Computes the residual of a sample, and the covariances that angles of unit variance cause.
fn noisy_sample<const ENCODER_3: bool>(scene: &Scene<'_>) -> NoisySample {
    let pose = RelativePose::new(scene);
    let covariance = |chain: &Trace, by_twist: &Matrix6<f64>, is_included: fn(usize) -> bool| {
        let twists = chain.joint_twists().enumerate().filter(|(joint, _)| is_included(*joint));
        twists.fold(Matrix6::zeros(), |sum, (_, twist)| {
            let by_joint = by_twist * twist.column();
            sum + by_joint * by_joint.transpose()
        })
    };
    let mut known = Matrix6::identity() * (FLOOR * FLOOR);
    let mut is_measured: fn(usize) -> bool = |_| true;
    if !ENCODER_3 {
        is_measured = |joint| joint != ROD_JOINT;
        known +=
            covariance(scene.bar, &pose.by_bar, |joint| joint == ROD_JOINT) * (UNKNOWN_RAD * UNKNOWN_RAD);
    }
    let by_encoders = covariance(scene.bar, &pose.by_bar, is_measured);
    let by_robot_joints = covariance(scene.robot, &pose.by_robot, |_| true);
    NoisySample { residual: pose.value, by_angles: [by_encoders, by_robot_joints], known }
}

/// The whitened residual, and its derivatives with respect to the twists of both ends (linear, then angular).
#[derive(Debug, Clone)]
pub struct Whitened {
    residual: Vector6<f64>,
    by_robot: Matrix6<f64>,
    by_bar: Matrix6<f64>,
    /// Derivative of the whitened residual with respect to the length of the rod. It contains only the effect of the
    /// length on the weights.
    by_scale: Vector6<f64>,
}

impl<const ENCODER_3: bool> Residual for PoseByNoise<ENCODER_3> {
    type Local = Whitened;

    const NAME: &'static str = "pose";
    const ROWS: usize = 6;
    const ENCODERS: &'static [usize] = if ENCODER_3 { ALL_ENCODERS } else { ALL_BUT_ROD_JOINT };

    fn depends_on(id: ParameterId, _: &Chain) -> bool {
        let is_rod_rotation = id == ParameterId::Bar { link: ROD_JOINT, parameter: LinkParameter::Theta };
        id.affects(Self::OWNER) && encoders_suffice(id, Self::ENCODERS) && (ENCODER_3 || !is_rod_rotation)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Whitened> {
        let mut whitening = self.whitening.get(scene.sample).copied()??;
        let rod_m = rod_length_m(scene.geometry);
        let mut weights_of_positions = whitening.fixed_columns_mut::<3>(0);
        weights_of_positions *= self.rod_m / rod_m;
        let pose = RelativePose::new(scene);
        Some(Whitened {
            residual: whitening * pose.value,
            by_robot: whitening * pose.by_robot,
            by_bar: whitening * pose.by_bar,
            by_scale: whitening.fixed_columns::<3>(0) * pose.value.fixed_rows::<3>(0) / -rod_m,
        })
    }

    fn residual(&self, _: &Scene<'_>, whitened: &Whitened, out: &mut [f64]) {
        out.copy_from_slice(whitened.residual.as_slice());
    }

    fn derivative(&self, scene: &Scene<'_>, whitened: &Whitened, id: ParameterId, out: &mut [f64]) {
        let (by_twist, twist) = match scene.movement(id) {
            Movement::Robot(twist) => (&whitened.by_robot, twist),
            Movement::Bar(twist) => (&whitened.by_bar, twist),
            Movement::None => return,
        };
        let mut derivative = by_twist.fixed_columns::<3>(0) * twist.linear;
        if twist.angular != Vector3::zeros() {
            derivative += by_twist.fixed_columns::<3>(3) * twist.angular;
        }
        if id == ParameterId::ROD {
            derivative += whitened.by_scale;
        }
        out.copy_from_slice(derivative.as_slice());
    }
}
