//! Costs for a pose or a position that a tracker measures at each pose of the robot.

use nalgebra::{Matrix3, Vector3};

use super::bar::pose::inverse_left_jacobian;
use super::{Movement, Residual, Scene};
use crate::kinematics::{Chain, Pose, Twist, rotation_vector};
use crate::logs::PoseRow;
use crate::model::{Coordinate, Owner, ParameterId, SetUp};

/// Noise of a measured pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseNoise {
    /// Standard deviation of each position coordinate \[m\].
    pub position_m: f64,
    /// Standard deviation of each component of the rotation vector \[rad\].
    pub rotation_rad: f64,
}

/// The residual compares two poses of the probe. `H = R probe` is predicted by the robot (`held`). `S = T measured` is
/// observed by the tracker (`seen`), where `T` is the tracker's pose and the measured position is divided by `1 + scale`.
/// The first three entries are the position of `H` minus the position of `S`, in the robot's base. If `WITH_ROTATION` is set,
/// the other three are the rotation vector of `S^-1 H`. Each entry is divided by its standard deviation.
///
/// Samples without a row are ignored, and also those without a rotation that is needed.
#[derive(Debug, Clone, Copy)]
pub struct TrackedPose<'a, const WITH_ROTATION: bool> {
    /// Each sample with its pose and set-up.
    pub rows: &'a [PoseRow],
    /// Noise of each measurement.
    pub noise: &'a [PoseNoise],
}

/// The cost for a probe with six degrees of freedom.
pub type MeasuredPose<'a> = TrackedPose<'a, true>;
/// The cost for a reflector, which has a position but no orientation.
pub type MeasuredPosition<'a> = TrackedPose<'a, false>;

/// Pose of the probe as predicted by the robot, and as observed by the tracker.
#[derive(Debug, Clone, Copy)]
pub struct Sighting {
    /// `root_from_probe` predicted by the robot.
    held: Pose,
    /// `root_from_probe` observed by the tracker, corrected for the error of the tracker's scale. Without a rotation, only
    /// its position is meaningful.
    seen: Pose,
    /// Noise of the observed pose.
    noise: PoseNoise,
    set_up: SetUp,
    /// Rotation from the observed to the predicted pose. `None` for a reflector.
    turn: Option<ProbeTurn>,
}

/// Rotation between two poses of a probe.
#[derive(Debug, Clone, Copy)]
struct ProbeTurn {
    /// Rotation vector of `S^-1 H`.
    rad: Vector3<f64>,
    /// Derivative of `rad` with respect to the angular velocity of `H` relative to `S`, in the robot's base.
    by_angular: Matrix3<f64>,
}

impl Sighting {
    /// Predicted minus observed position, in the robot's base \[m\].
    fn position_error_m(&self) -> Vector3<f64> {
        self.held.translation.vector - self.seen.translation.vector
    }

    /// Twist of the predicted probe relative to the observed one, per unit rate of a parameter. `None` if
    /// the parameter changes neither.
    fn parting(&self, scene: &Scene<'_>, id: ParameterId) -> Option<Twist> {
        use Coordinate::{Position, Rotation};
        let (tracker, probe) = scene.geometry.tracker.at(self.set_up)?;
        let robot = scene.robot;
        Some(match id {
            ParameterId::Tracker { station, .. } if station != self.set_up.station => return None,
            ParameterId::Probe { target, .. } if target != self.set_up.target => return None,
            ParameterId::Tracker { coordinate: Position(axis), .. } => Twist::translation(-axis.unit()),
            ParameterId::Tracker { coordinate: Rotation(axis), .. } => {
                let seen_m = self.seen.translation.vector;
                Twist::rotation(tracker.turning(axis), tracker.position_m, seen_m).scaled(-1.0)
            }
            ParameterId::Scale => {
                let tracker_to_seen_m = self.seen.translation.vector - tracker.position_m;
                Twist::translation(tracker_to_seen_m / (1.0 + scene.geometry.scale))
            }
            ParameterId::Probe { coordinate: Position(axis), .. } => {
                Twist::translation(robot.rotation() * axis.unit())
            }
            ParameterId::Probe { coordinate: Rotation(axis), .. } => {
                Twist { angular: robot.rotation() * probe.turning(axis), linear: Vector3::zeros() }
            }
            id => match scene.movement(id) {
                Movement::Robot(twist) => {
                    let flange_to_probe_m = self.held.translation.vector - robot.position_m();
                    twist.carried(&flange_to_probe_m)
                }
                Movement::Bar(_) | Movement::None => return None,
            },
        })
    }
}

impl<const WITH_ROTATION: bool> Residual for TrackedPose<'_, WITH_ROTATION> {
    type Local = Sighting;

    const NAME: &'static str = if WITH_ROTATION { "measured_pose" } else { "measured_position" };
    const ROWS: usize = if WITH_ROTATION { 6 } else { 3 };
    const OWNER: Owner = Owner::Tracker;

    fn depends_on(id: ParameterId, _: &Chain) -> bool {
        let turns_probe = matches!(id, ParameterId::Probe { coordinate: Coordinate::Rotation(_), .. });
        id.affects(Self::OWNER) && (WITH_ROTATION || !turns_probe)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Sighting> {
        let row = self.rows.get(scene.sample).filter(|row| !WITH_ROTATION || row.rotation.is_some())?;
        let noise = *self.noise.get(scene.sample)?;
        let (tracker, probe) = scene.geometry.tracker.at(row.set_up)?;
        let held = scene.robot.end() * probe.pose();
        let measured_m = row.position_m / (1.0 + scene.geometry.scale);
        let seen = tracker.pose() * Pose::from_parts(measured_m.into(), row.rotation.unwrap_or_default());
        let turn = WITH_ROTATION.then(|| {
            let seen_from_root = seen.rotation.matrix().transpose();
            let rad = rotation_vector(&(seen_from_root * held.rotation.matrix()));
            ProbeTurn { rad, by_angular: inverse_left_jacobian(&rad) * seen_from_root }
        });
        Some(Sighting { held, seen, noise, set_up: row.set_up, turn })
    }

    fn residual(&self, _: &Scene<'_>, sighting: &Sighting, out: &mut [f64]) {
        out[..3].copy_from_slice((sighting.position_error_m() / sighting.noise.position_m).as_slice());
        if let Some(ProbeTurn { rad, .. }) = sighting.turn {
            out[3..].copy_from_slice((rad / sighting.noise.rotation_rad).as_slice());
        }
    }

    fn derivative(&self, scene: &Scene<'_>, sighting: &Sighting, id: ParameterId, out: &mut [f64]) {
        let Some(twist) = sighting.parting(scene, id) else { return };
        out[..3].copy_from_slice((twist.linear / sighting.noise.position_m).as_slice());
        if let Some(ProbeTurn { by_angular, .. }) = sighting.turn {
            out[3..].copy_from_slice((by_angular * twist.angular / sighting.noise.rotation_rad).as_slice());
        }
    }
}
