//! A serial chain of Denavit-Hartenberg links on a base, and its forward kinematics.

use nalgebra::{Rotation3, Translation3, Vector3};
use shared::config::JointKind;

use super::LinkParameter;

/// A rigid transform `a_from_b`: converts coordinates in frame b to coordinates in frame a.
pub type Pose = nalgebra::IsometryMatrix3<f64>;

/// Longest plausible link of a robot \[m\]. A larger value is probably a length in millimetres.
pub const LENGTH_M_MAX: f64 = 4.0;

/// Roll, pitch and yaw \[rad\] of `R = Rz(yaw) Ry(pitch) Rx(roll)`, as in URDF.
///
/// At a pitch of +-90 degrees, only the sum or the difference of roll and yaw is determined, so yaw is set to zero. Roll is
/// always computed last, from the rotation that remains after yaw and pitch. The three angles therefore reproduce `R`.
pub fn roll_pitch_yaw(rotation: &Rotation3<f64>) -> [f64; 3] {
    let r = rotation.matrix();
    let cos_pitch = r[(0, 0)].hypot(r[(1, 0)]);
    let yaw = if cos_pitch < 1e-12 { 0.0 } else { r[(1, 0)].atan2(r[(0, 0)]) };
    let pitch = (-r[(2, 0)]).atan2(cos_pitch);
    let about_x = Rotation3::from_euler_angles(0.0, pitch, yaw).inverse() * rotation;
    [about_x[(2, 1)].atan2(about_x[(1, 1)]), pitch, yaw]
}

/// One link: `Rz(theta + joint) Tz(d) Tx(a) Rx(alpha) Ry(beta)`. If its joint is prismatic, the joint variable is added to
/// `d` instead of `theta`.
///
/// With `beta` zero this is the standard Denavit-Hartenberg link. With `d` fixed and `beta` free it is Hayati's link, which
/// is used if the next axis is nearly parallel to the previous axis (Hayati and Mirmirani 1985).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct DhLink {
    /// Whether the joint is revolute or prismatic.
    pub joint: JointKind,
    /// Length along x \[m\].
    pub a_m: f64,
    /// Twist about x \[rad\].
    pub alpha_rad: f64,
    /// Offset along z \[m\].
    pub d_m: f64,
    /// Rotation about z, added to the variable of a revolute joint \[rad\].
    pub theta_rad: f64,
    /// Hayati's rotation about y \[rad\].
    pub beta_rad: f64,
}

impl DhLink {
    /// Mutable access to one parameter.
    pub const fn number_mut(&mut self, parameter: LinkParameter) -> &mut f64 {
        match parameter {
            LinkParameter::A => &mut self.a_m,
            LinkParameter::D => &mut self.d_m,
            LinkParameter::Alpha => &mut self.alpha_rad,
            LinkParameter::Theta => &mut self.theta_rad,
            LinkParameter::Beta => &mut self.beta_rad,
        }
    }

    /// The transform of the link without its rotation or shift by the joint: `Tz(d) Tx(a) Rx(alpha) Ry(beta)`.
    pub(crate) fn after_joint(&self) -> Pose {
        let twist = Rotation3::from_axis_angle(&Vector3::x_axis(), self.alpha_rad);
        let hayati = Rotation3::from_axis_angle(&Vector3::y_axis(), self.beta_rad);
        Pose::from_parts(Translation3::new(self.a_m, 0.0, self.d_m), twist * hayati)
    }

    /// The transform of the whole link at a joint variable \[rad, m\].
    pub fn transform(&self, joint: f64) -> Pose {
        let (turn_rad, slide_m) = match self.joint {
            JointKind::Revolute => (joint, 0.0),
            JointKind::Prismatic => (0.0, joint),
        };
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), self.theta_rad + turn_rad);
        Pose::from_parts(Translation3::new(0.0, 0.0, slide_m), turn) * self.after_joint()
    }
}

/// A series of links on a base in the root frame (the robot's base).
#[derive(Debug, Clone, PartialEq)]
pub struct Chain {
    /// Base of the chain in the root frame. For the ball-bar it is the position of the gimbal; for the robot it
    /// is usually the identity.
    pub root_from_base: Pose,
    /// Links from base to end.
    pub links: Vec<DhLink>,
    /// Transform from the end of the last link to the end of the chain; identity if the last link already ends there.
    pub last_from_end: Pose,
}

impl Chain {
    /// A chain of links on a base. The chain ends at the end of its last link.
    pub fn new(root_from_base: Pose, links: Vec<DhLink>) -> Self {
        Self { root_from_base, links, last_from_end: Pose::identity() }
    }

    /// Whether a parameter of a link (from 0) is a rotation after the last joint. Positions of the end do not show the
    /// difference between such a parameter and `a`, `d` or `theta` of the last link.
    pub fn is_last_rotation(&self, link: usize, parameter: LinkParameter) -> bool {
        link + 1 == self.links.len() && matches!(parameter, LinkParameter::Alpha | LinkParameter::Beta)
    }

    /// Whether a parameter of a link (from 0) is added to its joint variable: `theta` of a revolute joint, `d`
    /// of a prismatic joint.
    pub fn is_offset(&self, link: usize, parameter: LinkParameter) -> bool {
        self.links.get(link).is_some_and(|link| parameter == LinkParameter::offset_of(link.joint))
    }

    /// Whether a parameter of a link (from 0) rotates the end about its own origin, without moving that origin. This is true
    /// for rotations after the last joint if no translation follows the last link.
    pub fn only_turns_end(&self, link: usize, parameter: LinkParameter) -> bool {
        self.is_last_rotation(link, parameter) && self.last_from_end.translation.vector == Vector3::zeros()
    }

    /// Type of each joint, base to end: revolute or prismatic.
    pub fn joint_kinds(&self) -> impl Iterator<Item = JointKind> + '_ {
        self.links.iter().map(|link| link.joint)
    }

    /// Upper bound of the reach \[m\]: the sum of the link lengths, as if all links were in one line.
    pub fn reach_m(&self) -> f64 {
        self.links.iter().map(|link| link.a_m.hypot(link.d_m)).sum()
    }

    /// `root_from_end` at joint variables \[rad, m\], one per link.
    ///
    /// Missing joint variables are zero; values beyond the last link are ignored.
    pub fn forward(&self, joints: &[f64]) -> Pose {
        let start = self.root_from_base;
        self.joined(joints).fold(start, |pose, (link, joint)| pose * link.transform(joint))
            * self.last_from_end
    }

    /// Each link, with its joint variable. Missing joint variables are zero.
    pub(crate) fn joined<'a>(&'a self, joints: &'a [f64]) -> impl Iterator<Item = (&'a DhLink, f64)> {
        self.links.iter().zip(joints.iter().copied().chain(std::iter::repeat(0.0)))
    }
}
