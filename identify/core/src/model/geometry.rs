//! The closed chain that a set of parameter values describes.

use std::cell::OnceCell;

use nalgebra::{Rotation3, Translation3, Vector3};

use super::{
    BarForce, DriveState, DriveTrain, JointErrors, JointState, JointTerm, ParameterId, RobotMotion, SetUp,
    Tracker, Waves,
};
use crate::kinematics::{AXES_MAX, BAR_JOINTS, Chain, DhLink, LinkParameter, Pose, Trace, Turn, Twist};

/// Joints of the bar before its rod: those that give it its direction.
pub(super) const DIRECTION_JOINTS: usize = 2;

/// The joints of a robot that moves. Reused from sample to sample.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MovingJoints {
    /// As logged.
    pub reported: JointState,
    /// All of one instant.
    pub delayed: JointState,
    /// ...and without their other errors.
    pub corrected: JointState,
    /// Where the drives are, as logged, once something goes by it.
    drives: OnceCell<DriveState>,
}

impl MovingJoints {
    /// Where the drives are, as logged.
    pub fn drives(&self, drives: &DriveTrain) -> &DriveState {
        self.drives.get_or_init(|| drives.state(&self.reported))
    }
}

/// Where the ball-bar stands: `T(origin) Rx(rx) Ry(ry)`; the turn about z is the bar's `btheta1`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BasePlacement {
    /// Centre of the gimbal in the robot's base \[m\].
    pub origin_m: Vector3<f64>,
    /// About x \[rad\].
    pub rx_rad: f64,
    /// About the turned y \[rad\].
    pub ry_rad: f64,
}

impl BasePlacement {
    /// `root_from_base`.
    pub fn pose(&self) -> Pose {
        let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), self.rx_rad)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), self.ry_rad);
        Pose::from_parts(Translation3::from(self.origin_m), tilt)
    }
}

/// How the ball-bar's length follows the force along it (TFRT-6017 section 5.3).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BarElongation {
    /// Longer by this for each newton \[m/N\]; negative where the log counts compression as positive.
    pub compliance_m_per_n: f64,
    /// Longer by this on the positive side of its play, shorter on the other \[m\].
    pub play_m: f64,
}

impl BarElongation {
    /// How much longer the bar is under a force, `c F + h s` \[m\].
    #[inline]
    pub fn extension_m(&self, force: &BarForce) -> f64 {
        self.compliance_m_per_n * force.along_n + self.play_m * force.side
    }
}

/// From the bar's clock to the robot's.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Clock {
    /// Robot clock minus bar clock at the reference time \[s\].
    pub shift_s: f64,
    /// Relative rate of the robot's clock minus one.
    pub skew: f64,
}

impl Clock {
    /// Bar time since the reference to robot time since the reference: `t + shift + skew t` \[s\].
    pub fn robot_time_s(&self, t_s: f64) -> f64 {
        t_s + self.shift_s + self.skew * t_s
    }
}

/// A draw-wire or telescoping bar.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Wire {
    /// Where it is attached, in the flange frame \[m\].
    pub attachments_m: Vec<Vector3<f64>>,
    /// Where it is anchored, in the robot's base \[m\].
    pub anchors_m: Vec<Vector3<f64>>,
    /// Measured length minus distance \[m\].
    pub offset_m: f64,
}

impl Wire {
    /// Anchor and attachment of a set-up \[m\]; none of one that is not there.
    pub fn at(&self, set_up: SetUp) -> Option<(&Vector3<f64>, &Vector3<f64>)> {
        Some((self.anchors_m.get(set_up.station)?, self.attachments_m.get(set_up.target)?))
    }
}

/// A ball on the flange and the sockets that it is seated in.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Contact {
    /// Centre of the ball in the flange frame \[m\].
    pub ball_m: Vector3<f64>,
    /// Where that centre is in each socket, in the robot's base \[m\].
    pub sockets_m: Vec<Vector3<f64>>,
}

/// A flat face: the plane `normal . x = distance` in the robot's base. The length of the normal is a matter of choice.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Face {
    /// Away from the material.
    pub normal: Vector3<f64>,
    /// From the origin of the robot's base, times the length of the normal \[m\].
    pub distance_m: f64,
}

/// A tip on the flange and the faces that it touches.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Touch {
    /// Centre of the tip's ball in the flange frame \[m\].
    pub tip_m: Vector3<f64>,
    /// Where that centre is when it touches each face.
    pub faces: Vec<Face>,
}

/// All numbers that residuals are made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Geometry {
    /// The robot, on its own base.
    pub robot: Chain,
    /// Errors of its joint angles.
    pub joints: JointErrors,
    /// And those that come back many times per turn.
    pub axis_waves: [Waves; AXES_MAX],
    /// Links of the ball-bar; its base is `base`.
    pub bar_links: Vec<DhLink>,
    /// Where the bar stands.
    pub base: BasePlacement,
    /// What a force does to its length.
    pub elongation: BarElongation,
    /// And its direction.
    pub bar_waves: [Waves; DIRECTION_JOINTS],
    /// Errors of the bar's encoders.
    pub encoder_waves: [Waves; BAR_JOINTS],
    /// What is added to the encoders' angles in each origin of the counters but the first \[rad\].
    pub origin_offsets_rad: Vec<[f64; BAR_JOINTS]>,
    /// Clocks of the two logs.
    pub clock: Clock,
    /// For measured lengths.
    pub wire: Wire,
    /// For measured positions and poses.
    pub tracker: Tracker,
    /// For a ball in sockets.
    pub contact: Contact,
    /// For a tip on faces.
    pub touch: Touch,
}

impl Geometry {
    /// A robot alone, everything else at zero.
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
            clock: Clock::default(),
            wire: Wire::default(),
            tracker: Tracker::default(),
            contact: Contact::default(),
            touch: Touch::default(),
        }
    }

    /// Where the robot's end is when it reports these joints.
    pub fn robot_end(&self, reported: &JointState) -> Pose {
        self.robot.forward(&self.corrected(reported).q)
    }

    /// How the robot's end moves when a number of its links or an error of its joints changes at unit speed; none for parameters of
    /// anything else. `end` is the robot with its joints corrected.
    #[inline]
    pub fn end_twist(&self, joints: &MovingJoints, end: &Trace, id: ParameterId) -> Option<Twist> {
        let drives = &self.joints.drives;
        match id {
            ParameterId::Robot { link, parameter } => end.twist(link, parameter),
            // An error of a drive turns each joint that the drive turns.
            ParameterId::Joint { axis, term } => {
                let MovingJoints { reported, delayed, .. } = joints;
                let of = if term == JointTerm::Delay { delayed } else { reported };
                Some(end.moved_by(&self.joints.by_amplitude(axis, term, of, joints.drives(drives))))
            }
            ParameterId::JointWave { axis, order, phase } => {
                let wave =
                    joints.drives(drives).turn.get(axis).map_or(0.0, |angle| phase.wave(order, *angle));
                // Hundreds of waves are tried: most drives turn one joint.
                if let Some(joint) = drives.only_joint(axis) {
                    return Some(end.twist(joint, LinkParameter::Theta)?.scaled(wave));
                }
                Some(end.moved_by(&drives.joint_from_drive.get(axis)?.map(|part| part * wave)))
            }
            _ => None,
        }
    }

    /// The robot at rest.
    pub fn at_rest(&self, reported: JointState) -> MovingJoints {
        let corrected = self.corrected(&reported);
        MovingJoints { reported, delayed: reported, corrected, drives: OnceCell::new() }
    }

    /// The robot's joints without their errors, where it stands still or all joints were logged at one instant.
    pub fn corrected(&self, reported: &JointState) -> JointState {
        let mut corrected = *reported;
        self.take_errors(&mut corrected, reported, &OnceCell::new());
        corrected
    }

    /// The robot's joints at a time of the bar's clock, into joints that are overwritten; false where the robot's log does not
    /// cover it.
    #[must_use]
    pub fn joints_at(&self, motion: &impl RobotMotion, t_s: f64, joints: &mut MovingJoints) -> bool {
        let tau_s = self.clock.robot_time_s(t_s);
        let Some(reported) = motion.at(tau_s) else { return false };
        joints.reported = reported;
        joints.delayed = self.joints.delayed(&reported, motion, tau_s);
        joints.corrected = joints.delayed;
        joints.drives = OnceCell::new();
        self.take_errors(&mut joints.corrected, &joints.reported, &joints.drives);
        true
    }

    /// Takes errors out of joints, all of one instant.
    fn take_errors(&self, corrected: &mut JointState, reported: &JointState, drives: &OnceCell<DriveState>) {
        // Sines and cosines of all drives take longer than to look.
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

    /// What the bar's encoders show too much at these readings \[rad\].
    #[inline]
    pub fn encoder_errors_rad(&self, readings: &[Turn; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        std::array::from_fn(|joint| self.encoder_waves[joint].at(readings[joint]).0)
    }

    /// What is added to the encoders' angles in one of the origins of the counters \[rad\].
    pub fn offsets_of_origin(&self, origin: usize) -> [f64; BAR_JOINTS] {
        origin
            .checked_sub(1)
            .and_then(|index| self.origin_offsets_rad.get(index))
            .copied()
            .unwrap_or_default()
    }

    /// The same of one encoder, in an origin from 1 on.
    pub(super) fn offset_of_origin_mut(&mut self, origin: usize, joint: usize) -> Option<&mut f64> {
        let index = origin.checked_sub(1)?;
        if self.origin_offsets_rad.len() <= index {
            self.origin_offsets_rad.resize(index + 1, [0.0; BAR_JOINTS]);
        }
        self.origin_offsets_rad.get_mut(index)?.get_mut(joint)
    }

    /// How much longer the ball-bar is under a force and in the direction of these readings \[m\].
    #[inline]
    pub fn extension_m(&self, force: &BarForce, readings: &[Turn; BAR_JOINTS]) -> f64 {
        let by_direction: f64 =
            self.bar_waves.iter().zip(readings).map(|(waves, reading)| waves.at(*reading).0).sum();
        self.elongation.extension_m(force) + by_direction
    }

    /// The ball-bar on its base, without any force on it.
    pub fn bar_chain(&self) -> Chain {
        Chain::new(self.base.pose(), self.bar_links.clone())
    }
}
