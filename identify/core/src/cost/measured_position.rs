//! Cost for a position that is measured at each pose, by a tracker that follows a reflector on the flange.

use nalgebra::Vector3;

use super::{Movement, PoseNoise, Residual, Scene};
use crate::kinematics::{Chain, Pose, Twist};
use crate::logs::PoseRow;
use crate::model::{Coordinate, Owner, ParameterId, SetUp};

/// The residual is `R probe - T measured / (1 + scale)`, with entries in the robot's base, divided by the standard deviation
/// of a coordinate. `R` is the robot's pose and `T` the tracker's pose.
///
/// Samples without a row are ignored.
#[derive(Debug, Clone, Copy)]
pub struct MeasuredPosition<'a> {
    /// Each sample with its position and set-up.
    pub rows: &'a [PoseRow],
    /// Noise of each measurement.
    pub noise: &'a [PoseNoise],
}

/// Pose of the probe as predicted by the robot, and as observed by the tracker.
#[derive(Debug, Clone, Copy)]
pub struct Sighting {
    /// `root_from_probe` predicted by the robot.
    pub(super) held: Pose,
    /// `root_from_probe` observed by the tracker, corrected for the error of the tracker's scale.
    pub(super) seen: Pose,
    /// Noise of the observed pose.
    pub(super) noise: PoseNoise,
    set_up: SetUp,
}

impl Sighting {
    /// Computes both poses at one sample. If no rotation was measured, only the positions are meaningful.
    /// `None` if the sample's set-up does not exist.
    pub(super) fn new(scene: &Scene<'_>, row: &PoseRow, noise: PoseNoise) -> Option<Self> {
        let (tracker, probe) = scene.geometry.tracker.at(row.set_up)?;
        let held = scene.robot.end() * probe.pose();
        let measured_m = row.position_m / (1.0 + scene.geometry.scale);
        let seen = tracker.pose() * Pose::from_parts(measured_m.into(), row.rotation.unwrap_or_default());
        Some(Self { held, seen, noise, set_up: row.set_up })
    }

    /// Predicted minus observed position, in the robot's base \[m\].
    pub(super) fn position_error_m(&self) -> Vector3<f64> {
        self.held.translation.vector - self.seen.translation.vector
    }

    /// Twist of the predicted probe relative to the observed one, per unit rate of a parameter. `None` if
    /// the parameter changes neither.
    pub(super) fn parting(&self, scene: &Scene<'_>, id: ParameterId) -> Option<Twist> {
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

impl Residual for MeasuredPosition<'_> {
    type Local = Sighting;

    const NAME: &'static str = "measured_position";
    const ROWS: usize = 3;
    const OWNER: Owner = Owner::Tracker;

    fn depends_on(id: ParameterId, _: &Chain) -> bool {
        let turns_probe = matches!(id, ParameterId::Probe { coordinate: Coordinate::Rotation(_), .. });
        id.affects(Self::OWNER) && !turns_probe
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Sighting> {
        Sighting::new(scene, self.rows.get(scene.sample)?, *self.noise.get(scene.sample)?)
    }

    fn residual(&self, _: &Scene<'_>, sighting: &Sighting, out: &mut [f64]) {
        out.copy_from_slice((sighting.position_error_m() / sighting.noise.position_m).as_slice());
    }

    fn derivative(&self, scene: &Scene<'_>, sighting: &Sighting, id: ParameterId, out: &mut [f64]) {
        if let Some(twist) = sighting.parting(scene, id) {
            out.copy_from_slice((twist.linear / sighting.noise.position_m).as_slice());
        }
    }
}
