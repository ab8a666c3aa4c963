//! Between standard Denavit-Hartenberg links and Hayati's, exactly.
//!
//! Both say where the next joint's axis runs. For nearly parallel axes the standard link does so by a common normal that
//! may lie anywhere along them; Hayati's link (Hayati and Mirmirani 1985) takes the point where the axis crosses a plane
//! across the one before, and a second rotation. Where along the axis the new frame stands, and how it is turned about it,
//! differs: the next link's `d` and `theta` take that up, so that the poses of the chain stay the same.

use nalgebra::{Rotation3, Vector3};

use super::{Chain, DhLink, Pose};

/// Why a link cannot be written in the other way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ConversionError {
    /// There is no link after it that could take up shift and turn along the axis.
    #[error("link {link} has no link after it that takes up the difference; convert an inner link")]
    LastLink {
        /// Link from 1.
        link: usize,
    },
    /// The axis does not cross the plane.
    #[error("the axis of link {link} is at right angles to the one before; only standard links describe it")]
    Perpendicular {
        /// Link from 1.
        link: usize,
    },
    /// There are many common normals.
    #[error(
        "the axis of link {link} is parallel to the one before; its standard d would be arbitrary, keep Hayati's link"
    )]
    Parallel {
        /// Link from 1.
        link: usize,
    },
}

/// Below this sine or cosine two directions count as parallel or perpendicular.
const DEGENERATE: f64 = 1e-12;

/// The next axis, seen from the frame before the link at joint angle zero.
struct Axis {
    point_m: Vector3<f64>,
    direction: Vector3<f64>,
}

impl Axis {
    fn of(link: &DhLink) -> Self {
        let pose = link.transform(0.0);
        Self { point_m: pose.translation.vector, direction: pose.rotation * Vector3::z() }
    }

    /// `x` and `y` of the point `along` the axis.
    fn at(&self, along_m: f64) -> Vector3<f64> {
        self.point_m + self.direction * along_m
    }
}

/// Length and angle of a vector in the xy plane; the length takes the sign of `like`.
fn polar(x: f64, y: f64, like: f64) -> (f64, f64) {
    let sign = if like < 0.0 { -1.0 } else { 1.0 };
    (sign * x.hypot(y), (sign * y).atan2(sign * x))
}

impl DhLink {
    /// Hayati's link to the same axis, with this `d`. None where the axis does not cross the plane.
    fn hayati(&self, d_m: f64) -> Option<Self> {
        let axis = Axis::of(self);
        if axis.direction.z.abs() < DEGENERATE {
            return None;
        }
        let crossing = axis.at((d_m - axis.point_m.z) / axis.direction.z);
        let (a_m, theta_rad) = if crossing.x.hypot(crossing.y) > 0.0 {
            polar(crossing.x, crossing.y, self.a_m)
        } else {
            (0.0, self.theta_rad)
        };
        // Rx(alpha) Ry(beta) z = (sin beta, -sin alpha cos beta, cos alpha cos beta)
        let seen = Rotation3::from_axis_angle(&Vector3::z_axis(), -theta_rad) * axis.direction;
        let beta_rad = seen.x.atan2(seen.y.hypot(seen.z));
        Some(Self { a_m, alpha_rad: (-seen.y).atan2(seen.z), d_m, theta_rad, beta_rad, ..*self })
    }

    /// The standard link to the same axis. None where the axes are parallel.
    fn standard(&self) -> Option<Self> {
        let axis = Axis::of(self);
        let u = axis.direction;
        let sine = u.x.hypot(u.y);
        if sine < DEGENERATE {
            return None;
        }
        // x of the link is across both axes; of its two directions the one that leaves the length its sign.
        let foot = axis.at(-(axis.point_m.x * u.x + axis.point_m.y * u.y) / (sine * sine));
        let across = Vector3::new(-u.y, u.x, 0.0) / sine;
        let length = across.dot(&foot);
        let same = if length.abs() > 0.0 { length * self.a_m >= 0.0 } else { self.alpha_rad >= 0.0 };
        let x = if same { across } else { -across };
        let y = Vector3::z().cross(&x);
        Some(Self {
            a_m: x.dot(&foot),
            alpha_rad: (-u.dot(&y)).atan2(u.z),
            d_m: foot.z,
            theta_rad: x.y.atan2(x.x),
            beta_rad: 0.0,
            ..*self
        })
    }
}

impl Chain {
    /// The same chain with Hayati's link at `link` (from 0), its `d` as given \[m\]; zero as Hayati has it.
    ///
    /// # Errors
    /// [`ConversionError::Perpendicular`], [`ConversionError::LastLink`].
    pub fn with_hayati(&self, link: usize, d_m: f64) -> Result<Self, ConversionError> {
        self.replaced(link, |old| old.hayati(d_m).ok_or(ConversionError::Perpendicular { link: link + 1 }))
    }

    /// The same chain with a standard link at `link` (from 0).
    ///
    /// # Errors
    /// [`ConversionError::Parallel`], [`ConversionError::LastLink`].
    pub fn with_standard(&self, link: usize) -> Result<Self, ConversionError> {
        self.replaced(link, |old| old.standard().ok_or(ConversionError::Parallel { link: link + 1 }))
    }

    /// Another link to the same axis; the next link takes up what differs along and about it.
    fn replaced(
        &self,
        link: usize,
        other: impl Fn(&DhLink) -> Result<DhLink, ConversionError>,
    ) -> Result<Self, ConversionError> {
        let mut chain = self.clone();
        let [old, next] = chain.links.get_mut(link..link + 2).unwrap_or_default() else {
            return Err(ConversionError::LastLink { link: link + 1 });
        };
        let new = other(old)?;
        let rest: Pose = new.transform(0.0).inverse() * old.transform(0.0);
        let turn = rest.rotation.matrix();
        next.theta_rad += turn[(1, 0)].atan2(turn[(0, 0)]);
        next.d_m += rest.translation.z;
        *old = new;
        Ok(chain)
    }
}
