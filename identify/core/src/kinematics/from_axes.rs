//! Computes Denavit-Hartenberg links of an arm from the lines of its joint axes. The import of URDF files uses it,
//! because a URDF file defines an arm by such lines.
//!
//! An axis line is a point and a direction, with all joints at zero. The motion of the arm depends only on
//! these lines and on the pose of its end (product of exponentials, Brockett 1984). Any links along the same
//! lines therefore move the end in the same way.
//!
//! Each link connects one line with the next line by the common normal of the two lines. If the lines are nearly parallel,
//! the common normal is not unique, or further away than a robot is long. Hayati's link is then used instead. It ends where
//! the next line intersects a plane perpendicular to the previous line.

use nalgebra::{Matrix3, Rotation3, Vector3};
use shared::config::JointKind;

use super::{Chain, DhLink, LENGTH_M_MAX, Pose, rotation_vector};

/// The line of a joint axis in the root frame, with all joints at zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisLine {
    /// Whether the joint is revolute or prismatic.
    pub joint: JointKind,
    /// A point on the axis \[m\]; arbitrary for a prismatic axis.
    pub point_m: Vector3<f64>,
    /// Direction of the axis, a unit vector.
    pub direction: Vector3<f64>,
}

/// Two axes count as parallel if the sine of the angle between them is below this limit. Such an angle is as small as errors
/// of calibration and rounding, so the position of the common normal is arbitrary.
const NEARLY_PARALLEL: f64 = 1e-3;
/// Hayati's link is used if the common normal is further away than the longest link and the sine of the angle
/// between the axes is below this limit. At such angles Hayati's link is short, because its plane intersects the
/// next axis within about the length of the link.
const HAYATI_SINE_MAX: f64 = 0.5;
/// Lengths \[m\] and angles \[rad\] below this are rounding errors.
const ROUNDING: f64 = 1e-12;

impl Chain {
    /// Computes the links along `axes` (base to end) of an arm whose end has the pose `end` with all joints at zero.
    pub fn from_axes(axes: &[AxisLine], end: &Pose) -> Self {
        let Some(first) = axes.first() else {
            return Self { last_from_end: *end, ..Self::new(Pose::identity(), vec![]) };
        };
        let root_from_base = base_frame(first);
        let mut frame = root_from_base;
        let mut links = Vec::with_capacity(axes.len());
        let end_line = AxisLine {
            joint: JointKind::Revolute,
            point_m: end.translation.vector,
            direction: end.rotation * Vector3::z(),
        };
        let next_axes = axes.iter().skip(1).map(Some).chain([None]);
        for (axis, next) in axes.iter().zip(next_axes) {
            // For parallel axes, any plane perpendicular to them is possible. The last link uses the plane through the
            // origin of the end.
            let link = match next {
                Some(next) => link_to(&frame, next, 0.0),
                None => {
                    let end_height_m = frame.inverse_transform_point(&end_line.point_m.into()).z;
                    link_to(&frame, &end_line, end_height_m)
                }
            };
            let link = DhLink { joint: axis.joint, ..link };
            frame *= link.transform(0.0);
            links.push(link);
        }
        // The last link cannot include a rotation of the end about its own z or a shift along it. These
        // two remain in `last_from_end`.
        let last_from_end = frame.inverse() * end;
        let last_from_end = if is_identity(&last_from_end) { Pose::identity() } else { last_from_end };
        Self { root_from_base, links, last_from_end }
    }
}

/// Whether a pose is the identity, up to rounding errors. [`rotation_vector`] is zero for the identity and also for a
/// rotation by 180 degrees, which the condition on the trace excludes.
fn is_identity(pose: &Pose) -> bool {
    pose.translation.vector.norm() < ROUNDING
        && rotation_vector(pose.rotation.matrix()).norm() < ROUNDING
        && pose.rotation.matrix().trace() > 0.0
}

/// Base frame of the chain. Its z axis is along the first joint axis. Its origin is the point of this joint axis
/// nearest to the root. Its x axis is as near as possible to the root's x axis, or to the root's y axis if the
/// joint axis is nearly along the root's x axis.
fn base_frame(first: &AxisLine) -> Pose {
    let z = first.direction;
    let origin_m = match first.joint {
        JointKind::Revolute => first.point_m - z * z.dot(&first.point_m),
        JointKind::Prismatic => Vector3::zeros(),
    };
    let across = |axis: Vector3<f64>| axis - z * z.dot(&axis);
    let x = across(Vector3::x());
    let x = if x.norm() > 0.1 { x } else { across(Vector3::y()) }.normalize();
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, z.cross(&x), z]));
    let pose = Pose::from_parts(origin_m.into(), rotation);
    if is_identity(&pose) { Pose::identity() } else { pose }
}

/// The link from `frame`, whose z is a joint axis, to the next axis. For nearly parallel axes the link ends where the next
/// axis intersects the plane `z = plane_m` of `frame`.
fn link_to(frame: &Pose, next: &AxisLine, plane_m: f64) -> DhLink {
    // Direction u and point p of the next axis in the frame. The position of a prismatic axis is arbitrary.
    let u = frame.rotation.inverse() * next.direction;
    let p = match next.joint {
        JointKind::Revolute => frame.inverse_transform_point(&next.point_m.into()).coords,
        JointKind::Prismatic => Vector3::zeros(),
    };
    let sine = u.x.hypot(u.y);
    let snapped = |value: f64| if value.abs() < ROUNDING { 0.0 } else { value };
    let angle = |y: f64, x: f64| snapped(y.atan2(x));
    // The foot of the common normal on the next axis.
    let foot = p - u * ((p.x * u.x + p.y * u.y) / (sine * sine));
    if sine < NEARLY_PARALLEL || (sine < HAYATI_SINE_MAX && foot.z.abs() > LENGTH_M_MAX) {
        // Intersection of the next axis with the plane.
        let crossing = p - u * ((p.z - plane_m) / u.z);
        let a_m = snapped(crossing.x.hypot(crossing.y));
        let theta_rad = if a_m > 0.0 { angle(crossing.y, crossing.x) } else { 0.0 };
        // Formula: Rz(-theta) u = Rx(alpha) Ry(beta) z = (sin beta, -sin alpha cos beta, cos alpha cos beta)
        let turned = Rotation3::from_axis_angle(&Vector3::z_axis(), -theta_rad) * u;
        let beta_rad = angle(turned.x, turned.y.hypot(turned.z));
        return DhLink {
            a_m,
            alpha_rad: angle(-turned.y, turned.z),
            d_m: plane_m,
            theta_rad,
            beta_rad,
            ..DhLink::default()
        };
    }
    // The common normal is the direction x of the link. If the two lines intersect, both signs of x are
    // possible, and the sign with the smaller rotation about z is used. In the frame with the axes x, z cross x
    // and z, the direction u is (0, -sin alpha, cos alpha).
    let normal = Vector3::new(-u.y, u.x, 0.0) / sine;
    let length = normal.dot(&foot);
    let x = match snapped(length) {
        0.0 if normal.x < -ROUNDING || (normal.x <= ROUNDING && normal.y < 0.0) => -normal,
        length if length < 0.0 => -normal,
        _ => normal,
    };
    DhLink {
        a_m: snapped(x.dot(&foot)),
        alpha_rad: angle(-u.dot(&Vector3::z().cross(&x)), u.z),
        d_m: snapped(foot.z),
        theta_rad: angle(x.y, x.x),
        ..DhLink::default()
    }
}
