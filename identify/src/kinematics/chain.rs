//! A chain of Denavit-Hartenberg links on a base.

use nalgebra::{Rotation3, Translation3, Vector3};

/// A rigid transform `a_from_b`: takes coordinates in frame b to frame a.
pub type Pose = nalgebra::IsometryMatrix3<f64>;

/// One link, `Rz(theta + joint) Tz(d) Tx(a) Rx(alpha) Ry(beta)`.
///
/// With `beta` zero it is the standard Denavit-Hartenberg link; with `d` fixed and `beta` free it is Hayati's link
/// for an axis nearly parallel to the one before (Hayati and Mirmirani 1985).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct DhLink {
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
    /// Everything of the link after its turn about z: `Tz(d) Tx(a) Rx(alpha) Ry(beta)`.
    pub(crate) fn after_joint(&self) -> Pose {
        let twist = Rotation3::from_axis_angle(&Vector3::x_axis(), self.alpha_rad);
        let hayati = Rotation3::from_axis_angle(&Vector3::y_axis(), self.beta_rad);
        Pose::from_parts(Translation3::new(self.a_m, 0.0, self.d_m), twist * hayati)
    }

    /// The whole link at a joint angle \[rad\].
    pub fn transform(&self, joint_rad: f64) -> Pose {
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), self.theta_rad + joint_rad);
        Pose::from_parts(Translation3::identity(), turn) * self.after_joint()
    }
}

/// Links in a row on a base that stands in the root frame (the robot's base).
#[derive(Debug, Clone, PartialEq)]
pub struct Chain {
    /// Where the chain stands: identity for the robot, the gimbal's place for the ball-bar.
    pub root_from_base: Pose,
    /// Base to end.
    pub links: Vec<DhLink>,
}

impl Chain {
    /// `root_from_end` at joint angles \[rad\], one per link.
    ///
    /// A link beyond the last angle given stands at joint angle zero; angles beyond the last link are not used.
    pub fn forward(&self, joints_rad: &[f64]) -> Pose {
        self.joined(joints_rad).fold(self.root_from_base, |pose, (link, joint)| pose * link.transform(joint))
    }

    /// Each link with its joint angle.
    pub(crate) fn joined<'a>(&'a self, joints_rad: &'a [f64]) -> impl Iterator<Item = (&'a DhLink, f64)> {
        self.links.iter().zip(joints_rad.iter().copied().chain(std::iter::repeat(0.0)))
    }
}
