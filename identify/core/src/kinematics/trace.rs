//! One forward pass along a [`Chain`] that yields the end pose ([`Trace`]) and its derivative by every parameter of every link,
//! a [`Twist`]. All residuals and inverse kinematics use it.
//!
//! A parameter of link i moves everything after it as one rigid body, by a twist about an axis that the forward pass
//! computes: `theta` and `d` about and along z of frame i-1, `alpha` and `a` about and along x of link i, `beta`
//! about y of frame i. Neither finite differences nor symbolic expressions are needed.

use nalgebra::{Matrix3, Vector3, Vector6};
use shared::config::JointKind;

use super::{Chain, Pose};

/// Velocity of the end frame when one parameter moves at unit speed, in root coordinates.
///
/// With `R`, `p` the end pose and `[w]` the matrix of the cross product: `dR = [angular] R`, `dp = linear`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Twist {
    /// Angular velocity of the frame.
    pub angular: Vector3<f64>,
    /// Velocity of the end frame's origin.
    pub linear: Vector3<f64>,
}

impl Twist {
    /// Twist of a frame with its origin at `end` by a rotation about `axis` through `point`.
    #[inline]
    pub fn rotation(axis: Vector3<f64>, point: Vector3<f64>, end: Vector3<f64>) -> Self {
        Self { angular: axis, linear: axis.cross(&(end - point)) }
    }

    /// The same motion at another speed.
    #[inline]
    pub fn scaled(&self, speed: f64) -> Self {
        Self { angular: self.angular * speed, linear: self.linear * speed }
    }

    /// Linear, then angular velocity: a column of a Jacobian.
    #[inline]
    pub fn column(&self) -> Vector6<f64> {
        let Self { angular, linear } = self;
        Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    }

    /// Twist of a point that the frame carries, at this vector from the frame's origin.
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

/// Sine and cosine of an angle: a rotation needs nothing else.
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
    pub fn of(angle_rad: f64) -> Self {
        /// Below this the truncated series are exact to rounding.
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

    /// Sine and cosine of a multiple of the angle, by a few products: a direct evaluation takes ten times as long.
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

/// The five parameters of a link; its joint has the effect of `theta`, or of `d` if it is prismatic.
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
    /// All five parameters, those of the standard convention first.
    pub const ALL: [Self; 5] = [Self::A, Self::D, Self::Alpha, Self::Theta, Self::Beta];
    /// Parameters of the standard convention, in the order of the thesis' tables.
    pub const STANDARD: [Self; 4] = [Self::A, Self::D, Self::Alpha, Self::Theta];

    /// The parameter that the variable of a joint is added to: the joint's offset.
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
    /// x of link i: that of frame i before `Ry(beta)`.
    x: Vector3<f64>,
    y_after: Vector3<f64>,
    origin_after: Vector3<f64>,
}

impl LinkAxes {
    /// Twist of a point after the joint by the joint's motion.
    #[inline]
    fn twist(&self, point: Vector3<f64>) -> Twist {
        match self.joint {
            JointKind::Revolute => Twist::rotation(self.z_before, self.origin_before, point),
            JointKind::Prismatic => Twist::translation(self.z_before),
        }
    }
}

/// A forward pass: end pose and the axes that derivatives need. Reused from sample to sample.
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
    /// `root_from_end`.
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

    /// Twist of the end frame by a parameter of link `link` (from 0); `None` after the last link.
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

    /// A point on each joint's axis \[m\] and the axis' direction, base to end.
    pub fn joint_axes(&self) -> impl Iterator<Item = (Vector3<f64>, Vector3<f64>)> {
        self.axes.iter().map(|axes| (axes.origin_before, axes.z_before))
    }

    /// Twists of a point carried by the first `joints` joints, by each of them.
    pub fn point_twists(&self, point: Vector3<f64>, joints: usize) -> impl Iterator<Item = Twist> {
        self.axes.iter().take(joints).map(move |axes| axes.twist(point))
    }

    /// Velocity of the end at joint rates, base to end.
    pub fn moved_by(&self, rates: &[f64]) -> Twist {
        let at_rest = Twist { angular: Vector3::zeros(), linear: Vector3::zeros() };
        let moving = self.joint_twists().zip(rates).filter(|(_, rate)| **rate != 0.0);
        moving.fold(at_rest, |sum, (twist, &rate)| Twist {
            angular: sum.angular + twist.angular * rate,
            linear: sum.linear + twist.linear * rate,
        })
    }

    /// Twists of all joints, base to end.
    pub fn joint_twists(&self) -> impl Iterator<Item = Twist> {
        self.point_twists(self.position_m(), self.axes.len())
    }
}

/// A chain prepared for many forward passes: quantities that do not depend on the joints are computed once.
#[derive(Debug, Clone, PartialEq)]
pub struct Tracer {
    root_from_base: Pose,
    links: Vec<PreparedLink>,
    /// From the last link to the end; `None` for the identity.
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
    /// Axes rotated by `Rx(alpha) Ry(beta)`: each rotation combines two of them.
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
            theta: Turn::of(link.theta_rad),
            alpha: Turn::of(link.alpha_rad),
            beta: (link.beta_rad != 0.0).then(|| Turn::of(link.beta_rad)),
            a_m: link.a_m,
            d_m: link.d_m,
        });
        let last_from_end = (chain.last_from_end != Pose::identity()).then_some(chain.last_from_end);
        Self { root_from_base: chain.root_from_base, links: links.collect(), last_from_end }
    }

    /// Sets `d` of one link (from 0) \[m\]; no effect for a link that does not exist.
    #[inline]
    pub fn set_d(&mut self, link: usize, d_m: f64) {
        if let Some(link) = self.links.get_mut(link) {
            link.d_m = d_m;
        }
    }

    /// Forward pass at joint variables \[rad, m\] (missing ones are zero), into a trace that is overwritten.
    pub fn trace(&self, joints: &[f64], trace: &mut Trace) {
        let joints = joints.iter().copied().chain(std::iter::repeat(0.0));
        self.pass(trace, joints, |link, joint| match link.joint {
            JointKind::Revolute => (link.theta.and(Turn::of(joint)), link.d_m),
            JointKind::Prismatic => (link.theta, link.d_m + joint),
        });
    }

    /// The same for revolute joints with known sines and cosines of their angles, one for each link.
    pub fn trace_turns(&self, joints: impl IntoIterator<Item = Turn>, trace: &mut Trace) {
        self.pass(trace, joints, |link, joint| (link.theta.and(joint), link.d_m));
    }

    /// Forward pass along all links; `about_z` returns a link's rotation about z and offset along z \[m\] at its joint variable.
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
