//! [`Geometry`] contains the values of all parameters, arranged by meaning: chains of robot and bar, joint errors, clock,
//! and the geometry of the other instruments. It converts reported joints and encoder readings to true joint
//! angles. Users are residuals ([`crate::cost`]), corrections of poses, and simulations. [`super::Model`]
//! creates a geometry from the columns of a solve.

use std::cell::OnceCell;

use nalgebra::{Rotation3, Translation3, Vector3};

use super::{
    BarForce, DriveState, DriveTrain, JointErrors, JointState, JointTerm, ParameterId, RobotMotion, SetUp,
    TrackerGeometry, Waves,
};
use crate::kinematics::{AXES_MAX, BAR_JOINTS, Chain, DhLink, LinkParameter, Pose, Trace, Turn, Twist};

/// Number of bar joints before the rod, which define the direction of the bar.
pub(super) const DIRECTION_JOINTS: usize = 2;

/// Joint states of a moving robot at one sample. The same value is reused for the following samples.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MovingJoints {
    /// Joint state as reported by the log.
    pub reported: JointState,
    /// Joint state after the correction of the delays of single axes, so that all joints belong to one instant.
    pub delayed: JointState,
    /// Delayed state with all other joint errors added. It is the estimate of the true joint state.
    pub corrected: JointState,
    /// Drive states that belong to `reported`, computed on first use.
    drives: OnceCell<DriveState>,
}

impl MovingJoints {
    /// Drive states that belong to `reported`, computed on first use. `drives` is the drive train of the robot.
    pub fn drives(&self, drives: &DriveTrain) -> &DriveState {
        self.drives.get_or_init(|| drives.state(&self.reported))
    }
}

/// Pose of the ball-bar's base: `T(origin) Rx(rx) Ry(ry)`. A rotation about z is not included, because the bar's `btheta1`
/// has the same effect.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BasePlacement {
    /// Centre of the gimbal in the robot's base \[m\].
    pub origin_m: Vector3<f64>,
    /// Rotation about x \[rad\].
    pub rx_rad: f64,
    /// Rotation about the rotated y axis \[rad\].
    pub ry_rad: f64,
}

impl BasePlacement {
    /// The transform `root_from_base`, without the rotation about z.
    pub fn pose(&self) -> Pose {
        let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), self.rx_rad)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), self.ry_rad);
        Pose::from_parts(Translation3::from(self.origin_m), tilt)
    }
}

/// Elongation of the ball-bar under an axial force (TFRT-6017 section 5.3).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BarElongation {
    /// Elongation per newton \[m/N\]; negative if the log counts compression as positive.
    pub compliance_m_per_n: f64,
    /// Half of the axial play \[m\]. The bar is longer by this value when the force is positive, and shorter
    /// when it is negative.
    pub play_m: f64,
}

impl BarElongation {
    /// Elongation of the bar under a force \[m\]: compliance times force, plus half of the play times the side of the force.
    #[inline]
    pub fn extension_m(&self, force: &BarForce) -> f64 {
        self.compliance_m_per_n * force.along_n + self.play_m * force.side
    }
}

/// Conversion from the bar's clock to the robot's clock.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ClockRelation {
    /// Robot clock minus bar clock at the reference time \[s\].
    pub shift_s: f64,
    /// Relative rate of the robot's clock minus one.
    pub skew: f64,
}

impl ClockRelation {
    /// Converts bar time to robot time, both since the reference time: `t + shift + skew t` \[s\].
    pub fn robot_time_s(&self, t_s: f64) -> f64 {
        t_s + self.shift_s + self.skew * t_s
    }
}

/// Geometry of a draw-wire sensor or a telescoping bar.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WireGeometry {
    /// Attachment points of the wire, in the flange frame \[m\].
    pub attachments_m: Vec<Vector3<f64>>,
    /// Anchor points of the wire, in the robot's base \[m\].
    pub anchors_m: Vec<Vector3<f64>>,
    /// Offset of the sensor: measured length minus distance \[m\].
    pub offset_m: f64,
}

impl WireGeometry {
    /// Anchor and attachment of a set-up \[m\]; `None` if the set-up does not exist.
    pub fn at(&self, set_up: SetUp) -> Option<(&Vector3<f64>, &Vector3<f64>)> {
        Some((self.anchors_m.get(set_up.station)?, self.attachments_m.get(set_up.target)?))
    }
}

/// Geometry of a ball on the flange, and of the sockets in which the ball is seated.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ContactGeometry {
    /// Centre of the ball in the flange frame \[m\].
    pub ball_m: Vector3<f64>,
    /// For each socket, the centre of the seated ball in the robot's base \[m\].
    pub sockets_m: Vec<Vector3<f64>>,
}

/// A flat face: the plane `normal . x = distance` in the robot's base. The length of the normal is arbitrary.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Face {
    /// Normal that points away from the material; its length is arbitrary.
    pub normal: Vector3<f64>,
    /// Distance from the origin of the robot's base, times the length of the normal \[m\].
    pub distance_m: f64,
}

/// Geometry of a probe tip on the flange, and of the faces that the tip touches.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TouchGeometry {
    /// Centre of the tip's ball in the flange frame \[m\].
    pub tip_m: Vector3<f64>,
    /// For each face, the plane that contains the ball centre at contact.
    pub faces: Vec<Face>,
}

/// The values of all parameters, in the form that residuals use.
#[derive(Debug, Clone, PartialEq)]
pub struct Geometry {
    /// Kinematic chain of the robot, including the robot's base.
    pub robot: Chain,
    /// Errors of the robot's joint angles.
    pub joints: JointErrors,
    /// Line spectrum of each robot axis, which contains errors with three or more waves per turn.
    pub axis_waves: [Waves; AXES_MAX],
    /// DH links of the ball-bar. The pose of the bar's base is in `base`.
    pub bar_links: Vec<DhLink>,
    /// Pose of the ball-bar's base in the robot's base.
    pub base: BasePlacement,
    /// Elongation of the bar under an axial force.
    pub elongation: BarElongation,
    /// Elongation of the bar as a function of its direction.
    pub bar_waves: [Waves; DIRECTION_JOINTS],
    /// Periodic errors of the bar's encoders.
    pub encoder_waves: [Waves; BAR_JOINTS],
    /// Offsets added to the encoder angles for each counter origin except the first \[rad\].
    pub origin_offsets_rad: Vec<[f64; BAR_JOINTS]>,
    /// Relation between the clocks of bar and robot.
    pub clock: ClockRelation,
    /// Draw-wire or telescoping bar, for measured lengths.
    pub wire: WireGeometry,
    /// Tracker and its targets, for measured positions and poses.
    pub tracker: TrackerGeometry,
    /// Relative error of measured lengths and positions: `measured = (1 + scale) * true`.
    pub scale: f64,
    /// Ball and sockets, for ball-in-socket measurements.
    pub contact: ContactGeometry,
    /// Tip and faces, for touch measurements.
    pub touch: TouchGeometry,
}

impl Geometry {
    /// The robot with nominal links, and the ball-bar if there is one. All other parameters are zero.
    pub fn new(robot: Chain, bar: Option<&Chain>) -> Self {
        let (bar_links, base) = bar.map_or_else(Default::default, |bar| {
            let origin_m = bar.root_from_base.translation.vector;
            (bar.links.clone(), BasePlacement { origin_m, ..BasePlacement::default() })
        });
        Self {
            joints: JointErrors::none(DriveTrain::direct(&robot)),
            axis_waves: Default::default(),
            robot,
            bar_links,
            base,
            elongation: BarElongation::default(),
            bar_waves: Default::default(),
            encoder_waves: Default::default(),
            origin_offsets_rad: Vec::new(),
            clock: ClockRelation::default(),
            wire: WireGeometry::default(),
            tracker: TrackerGeometry::default(),
            scale: 0.0,
            contact: ContactGeometry::default(),
            touch: TouchGeometry::default(),
        }
    }

    /// Pose of the robot's end for reported joints.
    pub fn robot_end(&self, reported: &JointState) -> Pose {
        self.robot.forward(&self.corrected(reported).q)
    }

    /// Twist of the robot's end per unit rate of a robot parameter (link, joint error, wave). `None` for any other
    /// parameter. `end` is the trace of the robot at its corrected joints.
    #[inline]
    pub fn end_twist(&self, joints: &MovingJoints, end: &Trace, id: ParameterId) -> Option<Twist> {
        let drives = &self.joints.drives;
        match id {
            ParameterId::Robot { link, parameter } => end.twist(link, parameter),
            // The error of a drive moves every joint that is coupled to this drive.
            ParameterId::Joint { axis, term } => {
                let MovingJoints { reported, delayed, .. } = joints;
                let state = if term == JointTerm::Delay { delayed } else { reported };
                Some(end.moved_by(&self.joints.by_amplitude(axis, term, state, joints.drives(drives))))
            }
            ParameterId::JointWave { axis, order, phase } => {
                let wave =
                    joints.drives(drives).turn.get(axis).map_or(0.0, |angle| phase.wave(order, *angle));
                // Fast path for drives that turn a single joint. Most drives do, and hundreds of orders are tried.
                if let Some(joint) = drives.only_joint(axis) {
                    return Some(end.twist(joint, LinkParameter::Theta)?.scaled(wave));
                }
                Some(end.moved_by(&drives.joint_from_drive.get(axis)?.map(|part| part * wave)))
            }
            _ => None,
        }
    }

    /// Joint states of a robot at rest.
    pub fn at_rest(&self, reported: JointState) -> MovingJoints {
        let corrected = self.corrected(&reported);
        MovingJoints { reported, delayed: reported, corrected, drives: OnceCell::new() }
    }

    /// Joints with their errors added, without delays. Use this for a robot at rest, or for a log that samples all
    /// joints at one instant.
    pub fn corrected(&self, reported: &JointState) -> JointState {
        let mut corrected = *reported;
        self.add_joint_errors(&mut corrected, reported, &OnceCell::new());
        corrected
    }

    /// Writes the robot's joint states at bar time `t_s` into `joints`, whose previous contents are overwritten. Returns
    /// false if the robot's log does not cover this time.
    #[must_use]
    pub fn joints_at(&self, motion: &impl RobotMotion, t_s: f64, joints: &mut MovingJoints) -> bool {
        let tau_s = self.clock.robot_time_s(t_s);
        let Some(reported) = motion.at(tau_s) else { return false };
        joints.reported = reported;
        joints.delayed = self.joints.delayed(&reported, motion, tau_s);
        joints.corrected = joints.delayed;
        joints.drives = OnceCell::new();
        self.add_joint_errors(&mut joints.corrected, &joints.reported, &joints.drives);
        true
    }

    /// Adds joint errors and line spectrum to `corrected`. All states belong to one instant.
    fn add_joint_errors(
        &self,
        corrected: &mut JointState,
        reported: &JointState,
        drives: &OnceCell<DriveState>,
    ) {
        // Without errors, return early, because the sines and cosines of all drives take more time than this test.
        if !self.joints.any() && self.axis_waves.iter().all(Waves::is_none) {
            return;
        }
        let state = drives.get_or_init(|| self.joints.drives.state(reported));
        self.joints.add_to(corrected, reported, state);
        let waves = self.axis_waves.iter().zip(&self.joints.drives.joint_from_drive).enumerate();
        for (axis, (waves, joint_from_drive)) in waves {
            let (error, slope) = waves.at(state.turn[axis]);
            let error_rate = slope * state.rate[axis];
            for (joint, part) in joint_from_drive.iter().enumerate() {
                corrected.q[joint] += part * error;
                corrected.qd[joint] += part * error_rate;
            }
        }
    }

    /// Errors of the bar's encoders at these readings \[rad\]. Corrected angles are the readings minus these errors.
    #[inline]
    pub fn encoder_errors_rad(&self, readings: &[Turn; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        std::array::from_fn(|joint| self.encoder_waves[joint].at(readings[joint]).0)
    }

    /// Offsets that are added to the encoder angles for a counter origin \[rad\]. They are zero for origin 0.
    pub fn offsets_of_origin(&self, origin: usize) -> [f64; BAR_JOINTS] {
        origin
            .checked_sub(1)
            .and_then(|index| self.origin_offsets_rad.get(index))
            .copied()
            .unwrap_or_default()
    }

    /// The offset of one encoder for an origin (from 1), for changes. The table of offsets is extended if necessary.
    pub(super) fn offset_of_origin_mut(&mut self, origin: usize, joint: usize) -> Option<&mut f64> {
        let index = origin.checked_sub(1)?;
        if self.origin_offsets_rad.len() <= index {
            self.origin_offsets_rad.resize(index + 1, [0.0; BAR_JOINTS]);
        }
        self.origin_offsets_rad.get_mut(index)?.get_mut(joint)
    }

    /// Elongation of the ball-bar \[m\], due to an axial force and as a function of the bar's direction. The
    /// readings determine the direction.
    #[inline]
    pub fn extension_m(&self, force: &BarForce, readings: &[Turn; BAR_JOINTS]) -> f64 {
        let by_direction: f64 =
            self.bar_waves.iter().zip(readings).map(|(waves, reading)| waves.at(*reading).0).sum();
        self.elongation.extension_m(force) + by_direction
    }

    /// Kinematic chain of the ball-bar on its base, without axial force.
    pub fn bar_chain(&self) -> Chain {
        Chain::new(self.base.pose(), self.bar_links.clone())
    }
}
