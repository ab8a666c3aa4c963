//! A forward pass along a [`Chain`] computes the end pose. The result is a [`Trace`], which also contains the axes of all
//! links. From these axes, the derivative of the end pose with respect to any parameter of any link is computed as a
//! [`Twist`]. All residuals and the inverse kinematics use this module.
//!
//! A parameter of link i moves everything after link i as one rigid body. The motion is a rotation about an axis or a
//! shift along an axis:
//! - `theta` about and `d` along z of frame i-1,
//! - `alpha` about and `a` along x of link i,
//! - `beta` about y of frame i.
//!
//! The forward pass computes these axes, so neither finite differences nor symbolic expressions are needed.

use nalgebra::{Matrix3, Vector3, Vector6};
use shared::config::JointKind;

use super::{Chain, Pose};

/// Velocity of the end frame when one parameter moves at unit speed, in root coordinates.
///
/// With `R` and `p` the rotation and position of the end, and `[w]` the matrix of the cross product with `w`:
/// `dR = [angular] R`, `dp = linear`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Twist {
    /// Angular velocity of the frame.
    pub angular: Vector3<f64>,
    /// Velocity of the end frame's origin.
    pub linear: Vector3<f64>,
}

impl Twist {
    /// Twist of a frame whose origin is `end`, for a rotation about `axis` through `point`.
    #[inline]
    pub fn rotation(axis: Vector3<f64>, point: Vector3<f64>, end: Vector3<f64>) -> Self {
        Self { angular: axis, linear: axis.cross(&(end - point)) }
    }

    /// The same motion, `speed` times as fast.
    #[inline]
    pub fn scaled(&self, speed: f64) -> Self {
        Self { angular: self.angular * speed, linear: self.linear * speed }
    }

    /// Linear velocity, then angular velocity: one column of a Jacobian.
    #[inline]
    pub fn column(&self) -> Vector6<f64> {
        let Self { angular, linear } = self;
        Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    }

    /// Twist of a point that moves with the frame. `to_point` is the vector from the frame's origin to this point.
    #[inline]
    pub fn carried(&self, to_point: &Vector3<f64>) -> Self {
        Self { linear: self.linear + self.angular.cross(to_point), ..*self }
    }

    /// A shift along `axis`.
    #[inline]
    pub fn translation(axis: Vector3<f64>) -> Self {
        Self { angular: Vector3::zeros(), linear: axis }
    }
}

/// A rotation angle, represented by its sine and cosine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// Sine of the angle.
    pub sin: f64,
    /// Cosine of the angle.
    pub cos: f64,
}

impl Turn {
    /// Sine and cosine of an angle \[rad\].
    #[inline]
    pub fn from_angle(angle_rad: f64) -> Self {
        /// Below this angle the truncated series are exact up to rounding errors.
        const SMALL_RAD: f64 = 1e-3;
        if angle_rad.abs() > SMALL_RAD {
            let (sin, cos) = angle_rad.sin_cos();
            return Self { sin, cos };
        }
        let squared = angle_rad * angle_rad;
        Self {
            sin: angle_rad * (1.0 - squared / 6.0 * (1.0 - squared / 20.0)),
            cos: 1.0 - 0.5 * squared * (1.0 - squared / 12.0),
        }
    }

    /// Sine and cosine of the sum of both angles.
    #[inline]
    pub fn and(self, other: Self) -> Self {
        Self {
            sin: self.sin * other.cos + self.cos * other.sin,
            cos: self.cos * other.cos - self.sin * other.sin,
        }
    }

    /// Sine and cosine of `count` times the angle, computed by a few products. This takes a tenth of the time of `sin` and
    /// `cos` of the multiple.
    #[inline]
    pub fn times(self, mut count: u8) -> Self {
        let (mut product, mut doubled) = (Self { sin: 0.0, cos: 1.0 }, self);
        while count > 0 {
            if count % 2 == 1 {
                product = product.and(doubled);
            }
            doubled = doubled.and(doubled);
            count /= 2;
        }
        product
    }
}

/// The five parameters of a link. The joint variable has the same effect as `theta` if the joint is revolute, and as `d`
/// if it is prismatic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LinkParameter {
    /// `a`: length along x.
    A,
    /// `d`: offset along z.
    D,
    /// `alpha`: twist about x.
    Alpha,
    /// `theta`: rotation about z.
    Theta,
    /// Hayati's rotation about y.
    Beta,
}

impl LinkParameter {
    /// All five parameters; the four of the standard convention are first.
    pub const ALL: [Self; 5] = [Self::A, Self::D, Self::Alpha, Self::Theta, Self::Beta];
    /// The four parameters of the standard convention, in the order of the thesis' tables.
    pub const STANDARD: [Self; 4] = [Self::A, Self::D, Self::Alpha, Self::Theta];

    /// The parameter that is the offset of a joint: the joint's variable is added to it.
    pub const fn offset_of(joint: JointKind) -> Self {
        match joint {
            JointKind::Revolute => Self::Theta,
            JointKind::Prismatic => Self::D,
        }
    }

    /// `a`, `d`, `alpha`, `theta` or `beta`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::A => "a",
            Self::D => "d",
            Self::Alpha => "alpha",
            Self::Theta => "theta",
            Self::Beta => "beta",
        }
    }
}

/// Intermediate results of a forward pass at one link, in root coordinates.
#[derive(Debug, Clone, Copy)]
struct LinkAxes {
    joint: JointKind,
    /// Axis of the joint: z of frame i-1.
    z_before: Vector3<f64>,
    origin_before: Vector3<f64>,
    /// x of link i: the x axis of frame i before the rotation `Ry(beta)`.
    x: Vector3<f64>,
    y_after: Vector3<f64>,
    origin_after: Vector3<f64>,
}

impl LinkAxes {
    /// Twist of a point beyond the joint when the joint moves.
    #[inline]
    fn twist(&self, point: Vector3<f64>) -> Twist {
        match self.joint {
            JointKind::Revolute => Twist::rotation(self.z_before, self.origin_before, point),
            JointKind::Prismatic => Twist::translation(self.z_before),
        }
    }
}

/// Result of a forward pass: the end pose, and the axes from which derivatives are computed. Reused from sample to
/// sample to avoid allocations.
#[derive(Debug, Clone)]
pub struct Trace {
    axes: Vec<LinkAxes>,
    end: Pose,
}

impl Default for Trace {
    fn default() -> Self {
        Self { axes: Vec::new(), end: Pose::identity() }
    }
}

impl Trace {
    /// The end pose `root_from_end`.
    pub fn end(&self) -> &Pose {
        &self.end
    }

    /// Origin of the end frame in the root frame \[m\].
    #[inline]
    pub fn position_m(&self) -> Vector3<f64> {
        self.end.translation.vector
    }

    /// Rotation of the end frame in the root frame.
    #[inline]
    pub fn rotation(&self) -> &Matrix3<f64> {
        self.end.rotation.matrix()
    }

    /// Derivative of the end pose with respect to a parameter of link `link` (from 0); `None` if the chain does
    /// not have this link.
    #[inline]
    pub fn twist(&self, link: usize, parameter: LinkParameter) -> Option<Twist> {
        let axes = self.axes.get(link)?;
        let end = self.position_m();
        Some(match parameter {
            LinkParameter::A => Twist::translation(axes.x),
            LinkParameter::D => Twist::translation(axes.z_before),
            LinkParameter::Alpha => Twist::rotation(axes.x, axes.origin_after, end),
            LinkParameter::Theta => Twist::rotation(axes.z_before, axes.origin_before, end),
            LinkParameter::Beta => Twist::rotation(axes.y_after, axes.origin_after, end),
        })
    }

    /// A point on the axis of each joint \[m\] and the direction of the axis, base to end.
    pub fn joint_axes(&self) -> impl Iterator<Item = (Vector3<f64>, Vector3<f64>)> {
        self.axes.iter().map(|axes| (axes.origin_before, axes.z_before))
    }

    /// Twists of a point, one for each of the first `joints` joints at unit rate. Only these joints move the point.
    pub fn point_twists(&self, point: Vector3<f64>, joints: usize) -> impl Iterator<Item = Twist> {
        self.axes.iter().take(joints).map(move |axes| axes.twist(point))
    }

    /// Velocity of the end frame if the joints move at these rates, base to end.
    pub fn moved_by(&self, rates: &[f64]) -> Twist {
        let at_rest = Twist { angular: Vector3::zeros(), linear: Vector3::zeros() };
        let moving = self.joint_twists().zip(rates).filter(|(_, rate)| **rate != 0.0);
        moving.fold(at_rest, |sum, (twist, &rate)| Twist {
            angular: sum.angular + twist.angular * rate,
            linear: sum.linear + twist.linear * rate,
        })
    }

    /// Twist of the end frame for each joint at unit rate, base to end.
    pub fn joint_twists(&self) -> impl Iterator<Item = Twist> {
        self.point_twists(self.position_m(), self.axes.len())
    }
}

/// A chain prepared for many forward passes. Quantities that do not depend on the joint variables are computed once.
#[derive(Debug, Clone, PartialEq)]
pub struct Tracer {
    root_from_base: Pose,
    links: Vec<PreparedLink>,
    /// Transform from the last link to the end; `None` if it is the identity.
    last_from_end: Option<Pose>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct PreparedLink {
    joint: JointKind,
    theta: Turn,
    alpha: Turn,
    /// Hayati's rotation; `None` for a standard link.
    beta: Option<Turn>,
    a_m: f64,
    d_m: f64,
}

impl PreparedLink {
    /// The axes `x`, `y` and `z` after the rotation `Rx(alpha) Ry(beta)`. Each of the two rotations combines
    /// two of the axes.
    #[inline]
    fn after_turn(&self, x: Vector3<f64>, y: Vector3<f64>, z: Vector3<f64>) -> Matrix3<f64> {
        let (y, z) = (y * self.alpha.cos + z * self.alpha.sin, z * self.alpha.cos - y * self.alpha.sin);
        let Some(beta) = self.beta else { return Matrix3::from_columns(&[x, y, z]) };
        Matrix3::from_columns(&[x * beta.cos - z * beta.sin, y, z * beta.cos + x * beta.sin])
    }
}

impl Tracer {
    /// Prepares a chain for forward passes.
    pub fn new(chain: &Chain) -> Self {
        let links = chain.links.iter().map(|link| PreparedLink {
            joint: link.joint,
            theta: Turn::from_angle(link.theta_rad),
            alpha: Turn::from_angle(link.alpha_rad),
            beta: (link.beta_rad != 0.0).then(|| Turn::from_angle(link.beta_rad)),
            a_m: link.a_m,
            d_m: link.d_m,
        });
        let last_from_end = (chain.last_from_end != Pose::identity()).then_some(chain.last_from_end);
        Self { root_from_base: chain.root_from_base, links: links.collect(), last_from_end }
    }

    /// Sets `d` of one link (from 0) \[m\]. Does nothing if the link does not exist.
    #[inline]
    pub fn set_d(&mut self, link: usize, d_m: f64) {
        if let Some(link) = self.links.get_mut(link) {
            link.d_m = d_m;
        }
    }

    /// Forward pass at joint variables \[rad, m\]. Missing joint variables are zero. Overwrites `trace`.
    pub fn trace(&self, joints: &[f64], trace: &mut Trace) {
        let joints = joints.iter().copied().chain(std::iter::repeat(0.0));
        self.pass(trace, joints, |link, joint| match link.joint {
            JointKind::Revolute => (link.theta.and(Turn::from_angle(joint)), link.d_m),
            JointKind::Prismatic => (link.theta, link.d_m + joint),
        });
    }

    /// As [`Self::trace`], for a chain of revolute joints. `joints` are the sines and cosines of the joint angles,
    /// one for each link.
    pub fn trace_turns(&self, joints: impl IntoIterator<Item = Turn>, trace: &mut Trace) {
        self.pass(trace, joints, |link, joint| (link.theta.and(joint), link.d_m));
    }

    /// Forward pass along all links. `about_z` computes a link's rotation about z and its offset along z \[m\]
    /// from its joint variable.
    #[inline]
    fn pass<J>(
        &self,
        trace: &mut Trace,
        joints: impl IntoIterator<Item = J>,
        about_z: impl Fn(&PreparedLink, J) -> (Turn, f64),
    ) {
        let mut rotation = *self.root_from_base.rotation.matrix();
        let mut origin = self.root_from_base.translation.vector;
        trace.axes.clear();
        for (link, joint) in self.links.iter().zip(joints) {
            let (Turn { sin, cos }, d_m) = about_z(link, joint);
            let z_before: Vector3<f64> = rotation.column(2).into();
            let x = rotation.column(0) * cos + rotation.column(1) * sin;
            let y = rotation.column(1) * cos - rotation.column(0) * sin;
            let origin_after = origin + x * link.a_m + z_before * d_m;
            rotation = link.after_turn(x, y, z_before);
            trace.axes.push(LinkAxes {
                joint: link.joint,
                z_before,
                origin_before: origin,
                x,
                y_after: rotation.column(1).into(),
                origin_after,
            });
            origin = origin_after;
        }
        let last = Pose::from_parts(origin.into(), nalgebra::Rotation3::from_matrix_unchecked(rotation));
        trace.end = self.last_from_end.map_or(last, |last_from_end| last * last_from_end);
    }
}
