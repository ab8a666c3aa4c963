//! A chain of Denavit-Hartenberg links on a base.

use nalgebra::{Rotation3, Translation3, Vector3};
use shared::config::JointKind;

use super::LinkParameter;

/// A rigid transform `a_from_b`: takes coordinates in frame b to frame a.
pub type Pose = nalgebra::IsometryMatrix3<f64>;

/// Longest link of a robot \[m\]: larger values are mostly millimetres.
pub const LENGTH_M_MAX: f64 = 4.0;

/// Roll, pitch and yaw \[rad\] of `R = Rz(yaw) Ry(pitch) Rx(roll)`, as in URDF. At a pitch of a quarter turn only the sum of roll
/// and yaw is determined: roll is computed last, from yaw and pitch, so that the sum is exact.
pub fn roll_pitch_yaw(rotation: &Rotation3<f64>) -> [f64; 3] {
    let r = rotation.matrix();
    let cos_pitch = r[(0, 0)].hypot(r[(1, 0)]);
    let yaw = if cos_pitch < 1e-12 { 0.0 } else { r[(1, 0)].atan2(r[(0, 0)]) };
    let pitch = (-r[(2, 0)]).atan2(cos_pitch);
    let about_x = Rotation3::from_euler_angles(0.0, pitch, yaw).inverse() * rotation;
    [about_x[(2, 1)].atan2(about_x[(1, 1)]), pitch, yaw]
}

/// One link, `Rz(theta + joint) Tz(d) Tx(a) Rx(alpha) Ry(beta)`, or with `d + joint` where its joint is prismatic.
///
/// With `beta` zero it is the standard Denavit-Hartenberg link; with `d` fixed and `beta` free it is Hayati's link
/// for an axis nearly parallel to the one before (Hayati and Mirmirani 1985).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct DhLink {
    /// Kind of its joint.
    pub joint: JointKind,
    /// Length along x \[m\].
    pub a_m: f64,
    /// Twist about x \[rad\].
    pub alpha_rad: f64,
    /// Offset along z \[m\].
    pub d_m: f64,
    /// Added to the joint variable, about z \[rad\].
    pub theta_rad: f64,
    /// Hayati's rotation about y \[rad\].
    pub beta_rad: f64,
}

impl DhLink {
    /// The value of one parameter.
    pub const fn number_mut(&mut self, parameter: LinkParameter) -> &mut f64 {
        match parameter {
            LinkParameter::A => &mut self.a_m,
            LinkParameter::D => &mut self.d_m,
            LinkParameter::Alpha => &mut self.alpha_rad,
            LinkParameter::Theta => &mut self.theta_rad,
            LinkParameter::Beta => &mut self.beta_rad,
        }
    }

    /// The link without its rotation about z: `Tz(d) Tx(a) Rx(alpha) Ry(beta)`.
    pub(crate) fn after_joint(&self) -> Pose {
        let twist = Rotation3::from_axis_angle(&Vector3::x_axis(), self.alpha_rad);
        let hayati = Rotation3::from_axis_angle(&Vector3::y_axis(), self.beta_rad);
        Pose::from_parts(Translation3::new(self.a_m, 0.0, self.d_m), twist * hayati)
    }

    /// The whole link at a joint variable \[rad, m\].
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
    /// Base of the chain: identity for the robot, the gimbal's position for the ball-bar.
    pub root_from_base: Pose,
    /// Links from base to end.
    pub links: Vec<DhLink>,
    /// Transform from the end of the last link to the end of the chain: identity if the last link can include it.
    pub last_from_end: Pose,
}

impl Chain {
    /// A chain of links on a base, which ends at the end of the last link.
    pub fn new(root_from_base: Pose, links: Vec<DhLink>) -> Self {
        Self { root_from_base, links, last_from_end: Pose::identity() }
    }

    /// Whether a parameter of a link (from 0) is a rotation after the last joint: positions of the end do not separate it from
    /// `a`, `d` and `theta` of this link.
    pub fn is_last_rotation(&self, link: usize, parameter: LinkParameter) -> bool {
        link + 1 == self.links.len() && matches!(parameter, LinkParameter::Alpha | LinkParameter::Beta)
    }

    /// Whether a parameter of a link (from 0) is the offset of its joint.
    pub fn is_offset(&self, link: usize, parameter: LinkParameter) -> bool {
        self.links.get(link).is_some_and(|link| parameter == LinkParameter::offset_of(link.joint))
    }

    /// Whether a parameter of a link (from 0) rotates the end about its own origin only: a last rotation, if the chain ends at its
    /// last link.
    pub fn only_turns_end(&self, link: usize, parameter: LinkParameter) -> bool {
        self.is_last_rotation(link, parameter) && self.last_from_end.translation.vector == Vector3::zeros()
    }

    /// How each axis moves.
    pub fn joint_kinds(&self) -> impl Iterator<Item = JointKind> + '_ {
        self.links.iter().map(|link| link.joint)
    }

    /// Upper bound of the reach: all links in a line \[m\].
    pub fn reach_m(&self) -> f64 {
        self.links.iter().map(|link| link.a_m.hypot(link.d_m)).sum()
    }

    /// `root_from_end` at joint variables \[rad, m\], one per link.
    ///
    /// Missing joint variables are zero; those beyond the last link are not used.
    pub fn forward(&self, joints: &[f64]) -> Pose {
        let start = self.root_from_base;
        self.joined(joints).fold(start, |pose, (link, joint)| pose * link.transform(joint))
            * self.last_from_end
    }

    /// Each link with its joint variable.
    pub(crate) fn joined<'a>(&'a self, joints: &'a [f64]) -> impl Iterator<Item = (&'a DhLink, f64)> {
        self.links.iter().zip(joints.iter().copied().chain(std::iter::repeat(0.0)))
    }
}
