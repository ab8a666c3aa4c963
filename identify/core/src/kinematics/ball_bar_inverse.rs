//! Inverse kinematics of the ball-bar: its joints at a pose, in closed form for the nominal bar and refined for one with errors;
//! its four configurations, and how near a pose is to a singular one.

use std::f64::consts::PI;

use super::inverse::{
    distance_squared, nearest_turn, point_z, refine, right_angle, turn_and_twist, wrapped, wrist_angles,
};
use super::{Chain, DhLink, InverseError, Pose};

/// Joints of the bar: three of the gimbal at the base, two of the cardan at the flange.
pub const BAR_JOINTS: usize = 5;

/// Which way a joint is bent: the sign of its sine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// The sine is not negative.
    Positive,
    /// The sine is negative.
    Negative,
}

impl Side {
    fn of(angle_rad: f64) -> Self {
        if angle_rad.sin() < 0.0 { Self::Negative } else { Self::Positive }
    }

    fn sign(self) -> f64 {
        match self {
            Self::Positive => 1.0,
            Self::Negative => -1.0,
        }
    }
}

/// One of the four ways in which the bar takes the same pose.
///
/// Gimbal turned over: `b1 + pi, -b2, b3 + pi`; cardan turned over: `b3 + pi, -b4, b5 + pi`. A bar changes from one to
/// another only through a singular pose, so a run stays in one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Configuration {
    /// Sign of sin b2.
    pub gimbal: Side,
    /// Sign of sin b4.
    pub cardan: Side,
}

impl Configuration {
    /// All four, the positive ones first.
    pub const ALL: [Self; 4] = [
        Self { gimbal: Side::Positive, cardan: Side::Positive },
        Self { gimbal: Side::Positive, cardan: Side::Negative },
        Self { gimbal: Side::Negative, cardan: Side::Positive },
        Self { gimbal: Side::Negative, cardan: Side::Negative },
    ];

    /// The configuration of joint variables \[rad\].
    pub fn of(bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> Self {
        let angles_rad = angles_from_joints(bar_links, bar_rad);
        Self { gimbal: Side::of(angles_rad[1]), cardan: Side::of(angles_rad[3]) }
    }

    /// The joint variables of the same pose in this configuration, each in (-pi, pi].
    pub fn carry(self, bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        let (from, angles_rad) = (Self::of(bar_links, bar_rad), angles_from_joints(bar_links, bar_rad));
        joints_from_angles(bar_links, &self.carry_from(from, &angles_rad))
    }

    /// The angles of the links of the same pose in this configuration, with whole turns left in them.
    fn carry_from(self, from: Self, angles_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        let mut b = *angles_rad;
        if from.gimbal != self.gimbal {
            b = [b[0] + PI, -b[1], b[2] + PI, b[3], b[4]];
        }
        if from.cardan != self.cardan {
            b = [b[0], b[1], b[2] + PI, -b[3], b[4] + PI];
        }
        b
    }
}

/// Distance to the nearest singular pose \[rad\]: rod along the base axis (sin b2 = 0) or along the last axis
/// (sin b4 = 0). There one joint is undetermined and encoder errors are amplified by the inverse of this number.
///
/// `bar_rad` are joint variables: the links' offsets `theta` are added here.
pub fn singularity_margin_rad(bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> f64 {
    let angles_rad = angles_from_joints(bar_links, bar_rad);
    let to_multiple_of_pi = |angle: f64| (angle - PI * (angle / PI).round()).abs();
    to_multiple_of_pi(angles_rad[1]).min(to_multiple_of_pi(angles_rad[3]))
}

/// Signs of the twists of links 1 to 4.
fn twist_signs(chain: &Chain) -> Result<[f64; 4], InverseError> {
    if chain.links.len() != BAR_JOINTS {
        return Err(InverseError::Links { found: chain.links.len(), expected: BAR_JOINTS });
    }
    Ok([right_angle(chain, 0)?, right_angle(chain, 1)?, right_angle(chain, 2)?, right_angle(chain, 3)?])
}

/// Joint angles \[rad\] of the nominal bar for a pose, in each configuration, in the order of [`Configuration::ALL`].
///
/// The bar has five joints, a pose six freedoms: direction of the rod and rotation of the end frame are met, the
/// distance from the gimbal is ignored. Errors of the chain enter only by its joint offsets; see
/// [`ball_bar_inverse_refined`].
///
/// # Errors
/// [`InverseError::Structure`] or [`InverseError::Links`] if the chain is not a ball-bar.
pub fn ball_bar_inverse(
    chain: &Chain,
    target: &Pose,
) -> Result<[(Configuration, [f64; BAR_JOINTS]); 4], InverseError> {
    let (first, angles_rad) = inverse_in_first(chain, target)?;
    Ok(Configuration::ALL.map(|configuration| {
        (configuration, joints_from_angles(&chain.links, &configuration.carry_from(first, &angles_rad)))
    }))
}

/// [`ball_bar_inverse`] in the first of [`Configuration::ALL`].
///
/// # Errors
/// As [`ball_bar_inverse`].
pub fn first_ball_bar_inverse(chain: &Chain, target: &Pose) -> Result<[f64; BAR_JOINTS], InverseError> {
    inverse_in_first(chain, target).map(|(_, angles_rad)| joints_from_angles(&chain.links, &angles_rad))
}

/// Angles of the links: joint variables with the links' offsets `theta`.
fn angles_from_joints(bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
    std::array::from_fn(|joint| bar_rad[joint] + theta_rad(bar_links, joint))
}

/// Joint variables, each in (-pi, pi], from the angles of the links: without the links' offsets `theta`.
fn joints_from_angles(bar_links: &[DhLink], angles_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
    std::array::from_fn(|joint| wrapped(angles_rad[joint] - theta_rad(bar_links, joint)))
}

/// Offset of a link's angle; zero for a missing link.
fn theta_rad(bar_links: &[DhLink], joint: usize) -> f64 {
    bar_links.get(joint).map_or(0.0, |link| link.theta_rad)
}

/// The first of [`Configuration::ALL`], and the angles of the links in it (joint variable + theta) \[rad\].
fn inverse_in_first(
    chain: &Chain,
    target: &Pose,
) -> Result<(Configuration, [f64; BAR_JOINTS]), InverseError> {
    let configuration = Configuration::ALL[0];
    let [s1, s2, s3, s4] = twist_signs(chain)?;
    let after_joint5 = chain.links.last().map_or_else(Pose::identity, |link| link.after_joint());
    let base_from_end = chain.root_from_base.inverse() * target * after_joint5.inverse();
    let rod = base_from_end.translation.vector;
    let rod = if rod.norm() > 0.0 { rod.normalize() } else { rod };
    // Joints 1 and 2 point the rod at the end; joints 3 to 5 rotate the end like a wrist.
    let (b1, b2) = point_z(&rod, [s1, s2], configuration.gimbal.sign(), 0.0);
    let base_from_rod = turn_and_twist(b1, s1) * turn_and_twist(b2, s2);
    let rod_from_end = base_from_rod.transpose() * base_from_end.rotation.matrix();
    let [b3, b4, b5] = wrist_angles(&rod_from_end, [s3, s4], configuration.cardan.sign(), 0.0);
    Ok((configuration, [b1, b2, b3, b4, b5]))
}

/// Joint angles \[rad\] that bring the end of `chain` closest to `target`, in the configuration and the turns nearest to `near`.
/// The chain may have geometric errors.
///
/// Least squares over position \[m\] and rotation vector \[rad\]: `target` is reached exactly only if the bar can reach it.
///
/// # Errors
/// [`InverseError::NotConverged`] at a singular pose; as [`ball_bar_inverse`] for another structure.
pub fn ball_bar_inverse_refined(
    chain: &Chain,
    target: &Pose,
    near: &[f64; BAR_JOINTS],
) -> Result<[f64; BAR_JOINTS], InverseError> {
    let mut starts = ball_bar_inverse(chain, target)?
        .map(|(_, joints)| std::array::from_fn(|i| nearest_turn(joints[i], near[i])));
    starts
        .sort_by(|a: &[f64; BAR_JOINTS], b| distance_squared(a, near).total_cmp(&distance_squared(b, near)));
    refine(chain, target, starts[0])
}
