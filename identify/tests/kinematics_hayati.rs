//! Links in the standard and in Hayati's convention describe the same robot.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use identify::kinematics::{Chain, DhLink, robot_chain};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;

/// If the sine of the angle between two directions is below this value, they are treated as parallel. If the cosine is
/// below, they are treated as perpendicular.
const DEGENERATE: f64 = 1e-12;

/// A point on the next axis \[m\] and the direction of that axis. Both are in the frame before the
/// link, at joint angle zero.
fn axis_after(link: &DhLink) -> (Vector3<f64>, Vector3<f64>) {
    let pose = link.transform(0.0);
    (pose.translation.vector, pose.rotation * Vector3::z())
}

/// Hayati's link (Hayati and Mirmirani 1985) to the same axis, with this `d`. The origin of the link is the point at
/// which the axis intersects a plane perpendicular to the previous axis. Then the link has a second rotation. `None`
/// if axis and plane do not intersect.
fn hayati_link(link: &DhLink, d_m: f64) -> Option<DhLink> {
    let (point_m, direction) = axis_after(link);
    if direction.z.abs() < DEGENERATE {
        return None;
    }
    let crossing = point_m + direction * ((d_m - point_m.z) / direction.z);
    let length_m = crossing.x.hypot(crossing.y);
    let sign = if link.a_m < 0.0 { -1.0 } else { 1.0 };
    let theta_rad =
        if length_m > 0.0 { (sign * crossing.y).atan2(sign * crossing.x) } else { link.theta_rad };
    // Rx(alpha) Ry(beta) z = (sin beta, -sin alpha cos beta, cos alpha cos beta)
    let turned = Rotation3::from_axis_angle(&Vector3::z_axis(), -theta_rad) * direction;
    let beta_rad = turned.x.atan2(turned.y.hypot(turned.z));
    let alpha_rad = (-turned.y).atan2(turned.z);
    Some(DhLink { a_m: sign * length_m, alpha_rad, d_m, theta_rad, beta_rad, ..*link })
}

/// The standard link to the same axis. `None` if the two axes are parallel.
fn standard_link(link: &DhLink) -> Option<DhLink> {
    let (point_m, u) = axis_after(link);
    let sine = u.x.hypot(u.y);
    if sine < DEGENERATE {
        return None;
    }
    // The x axis of the link is perpendicular to both axes. It has two possible directions. Use the one
    // that keeps the sign of the length.
    let foot = point_m - u * ((point_m.x * u.x + point_m.y * u.y) / (sine * sine));
    let across = Vector3::new(-u.y, u.x, 0.0) / sine;
    let length = across.dot(&foot);
    let same = if length.abs() > 0.0 { length * link.a_m >= 0.0 } else { link.alpha_rad >= 0.0 };
    let x = if same { across } else { -across };
    Some(DhLink {
        a_m: x.dot(&foot),
        alpha_rad: (-u.dot(&Vector3::z().cross(&x))).atan2(u.z),
        d_m: foot.z,
        theta_rad: x.y.atan2(x.x),
        beta_rad: 0.0,
        ..*link
    })
}

/// The chain with another link to the same axis. The next link compensates the difference along and about this axis.
fn replaced(chain: &Chain, link: usize, other: impl Fn(&DhLink) -> Option<DhLink>) -> Option<Chain> {
    let mut chain = chain.clone();
    let [old, next] = chain.links.get_mut(link..link + 2)? else { return None };
    let new = other(old)?;
    let rest = new.transform(0.0).inverse() * old.transform(0.0);
    let turn = rest.rotation.matrix();
    next.theta_rad += turn[(1, 0)].atan2(turn[(0, 0)]);
    next.d_m += rest.translation.z;
    *old = new;
    Some(chain)
}

fn with_hayati(chain: &Chain, link: usize, d_m: f64) -> Option<Chain> {
    replaced(chain, link, |old| hayati_link(old, d_m))
}

fn with_standard(chain: &Chain, link: usize) -> Option<Chain> {
    replaced(chain, link, standard_link)
}

fn nominal(which: usize) -> Chain {
    let robots = [crate::support::irb2400(), crate::support::nj220()];
    robot_chain(&robots[which], &crate::support::bar())
}

fn pose_error(a: &Chain, b: &Chain, joints: &[f64; 6]) -> f64 {
    (a.forward(joints).to_homogeneous() - b.forward(joints).to_homogeneous()).amax()
}

proptest! {
    /// Every link has errors of some milliradians, as in a calibration. Axes 2 and 3 are then nearly parallel, and the
    /// standard `d` of link 2 can be hundreds of metres.
    #[test]
    fn there_and_back_gives_the_same_poses_and_the_same_links(
        which in 0..2usize,
        link in prop::sample::select(vec![1usize]),
        errors in prop::collection::vec(-5e-3..5e-3f64, 24),
        d_m in -0.2..0.2f64,
        joints in prop::array::uniform6(-3.0..3.0f64),
    ) {
        let mut chain = nominal(which);
        for (link, e) in chain.links.iter_mut().zip(errors.chunks_exact(4)) {
            link.a_m += e[0];
            link.alpha_rad += e[1];
            link.d_m += e[2];
            link.theta_rad += e[3];
        }
        prop_assume!(chain.links[link].alpha_rad.abs() > 1e-5);
        let hayati = with_hayati(&chain, link, d_m).unwrap();
        prop_assert_eq!(hayati.links[link].d_m, d_m);
        prop_assert!(hayati.links[link].beta_rad.abs() < 0.1);
        prop_assert!(pose_error(&chain, &hayati, &joints) < 1e-9, "{}", pose_error(&chain, &hayati, &joints));
        let back = with_standard(&hayati, link).unwrap();
        prop_assert_eq!(back.links[link].beta_rad, 0.0);
        // If the axes are nearly parallel, rounding errors are amplified by the inverse of the angle between them.
        let limit = 1e-13 / chain.links[link].alpha_rad.abs().powi(2) + 1e-10;
        prop_assert!(pose_error(&chain, &back, &joints) < limit);
        prop_assert!((back.links[link].a_m - chain.links[link].a_m).abs() < limit);
        prop_assert!((back.links[link].d_m - chain.links[link].d_m).abs() < limit);
        prop_assert!((back.links[link].theta_rad - chain.links[link].theta_rad).sin().abs() < limit);
    }

    /// For a Hayati link with errors, the standard parameters are large but exact.
    #[test]
    fn a_hayati_link_becomes_a_standard_one_however_far_its_common_normal_lies(
        alpha in 1e-4..2e-2f64, beta in 1e-4..2e-2f64, joints in prop::array::uniform6(-3.0..3.0f64),
    ) {
        let mut chain = nominal(0);
        chain.links[1].alpha_rad = alpha;
        chain.links[1].beta_rad = beta;
        let standard = with_standard(&chain, 1).unwrap();
        // The distance of the common normal is the length divided by the angle. This is metres to kilometres.
        prop_assert!(pose_error(&chain, &standard, &joints) < 1e-12 / alpha.min(beta));
    }
}

#[test]
fn some_links_have_one_form_only() {
    let chain = nominal(0);
    assert!(with_standard(&chain, 1).is_none());
    assert!(with_hayati(&chain, 5, 0.0).is_none());
    assert!(with_standard(&chain, 9).is_none());
    let mut square = chain.clone();
    square.links[2].alpha_rad = std::f64::consts::FRAC_PI_2;
    // The floating-point cosine of pi/2 is not exactly zero. It must be treated as zero.
    assert!(with_hayati(&square, 2, 0.0).is_none());
    let same = with_hayati(&chain, 1, chain.links[1].d_m).unwrap();
    assert!(pose_error(&chain, &same, &[0.3; 6]) < 1e-15);
}
