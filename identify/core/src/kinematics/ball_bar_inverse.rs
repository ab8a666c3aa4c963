//! Inverse kinematics of the ball-bar: the bar's joint angles at a pose. For the nominal bar there is a closed form; for a
//! bar with errors, iterations refine the result of the closed form. The module also defines the four configurations of the
//! bar, and computes the distance from a singular pose.

use std::f64::consts::PI;

use super::inverse::{
    distance_squared, nearest_turn, point_z, refine, right_angle, turn_and_twist, wrapped, wrist_angles,
};
use super::{Chain, DhLink, InverseError, Pose};

/// Number of joints of the bar: three of the gimbal at the base, two of the cardan joint at the flange.
pub const BAR_JOINTS: usize = 5;

/// The side to which a joint is bent: the sign of its sine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// The sine is not negative.
    Positive,
    /// The sine is negative.
    Negative,
}

impl Side {
    fn from_angle(angle_rad: f64) -> Self {
        if angle_rad.sin() < 0.0 { Self::Negative } else { Self::Positive }
    }

    fn sign(self) -> f64 {
        match self {
            Self::Positive => 1.0,
            Self::Negative => -1.0,
        }
    }
}

/// One of the four sets of joint angles (configurations) with which the bar reaches the same pose.
///
/// If the gimbal is turned over, the angles change to `b1 + pi, -b2, b3 + pi`. If the cardan joint is turned
/// over, they change to `b3 + pi, -b4, b5 + pi`. A bar changes its configuration only in a singular pose, so a
/// run keeps one configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Configuration {
    /// Sign of sin b2.
    pub gimbal: Side,
    /// Sign of sin b4.
    pub cardan: Side,
}

impl Configuration {
    /// All four configurations, positive sides first.
    pub const ALL: [Self; 4] = [
        Self { gimbal: Side::Positive, cardan: Side::Positive },
        Self { gimbal: Side::Positive, cardan: Side::Negative },
        Self { gimbal: Side::Negative, cardan: Side::Positive },
        Self { gimbal: Side::Negative, cardan: Side::Negative },
    ];

    /// The configuration of a bar at these joint variables \[rad\].
    pub fn from_joints(bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> Self {
        let angles_rad = angles_from_joints(bar_links, bar_rad);
        Self { gimbal: Side::from_angle(angles_rad[1]), cardan: Side::from_angle(angles_rad[3]) }
    }

    /// Converts joint variables to this configuration, without changing the pose. The results are in (-pi, pi].
    pub fn carry(self, bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        let (from, angles_rad) =
            (Self::from_joints(bar_links, bar_rad), angles_from_joints(bar_links, bar_rad));
        joints_from_angles(bar_links, &self.carry_from(from, &angles_rad))
    }

    /// Converts link angles from configuration `from` to this configuration, without changing the pose. Whole
    /// turns are not removed.
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

/// Distance from the nearest singular pose \[rad\]. The distances of b2 and of b4 from the nearest multiple of pi are
/// computed, and the smaller one is returned. At sin b2 = 0 the rod is along the base axis, and at sin b4 = 0 it is
/// along the last axis. In these poses one joint is undetermined. Near them, encoder errors are amplified by the
/// inverse of this distance.
///
/// `bar_rad` are joint variables. This function adds the links' offsets `theta`.
pub fn singularity_margin_rad(bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> f64 {
    let angles_rad = angles_from_joints(bar_links, bar_rad);
    let to_multiple_of_pi = |angle: f64| (angle - PI * (angle / PI).round()).abs();
    to_multiple_of_pi(angles_rad[1]).min(to_multiple_of_pi(angles_rad[3]))
}

/// Signs of the parameters alpha (twists of +-90 degrees) of links 1 to 4.
fn twist_signs(chain: &Chain) -> Result<[f64; 4], InverseError> {
    if chain.links.len() != BAR_JOINTS {
        return Err(InverseError::Links { found: chain.links.len(), expected: BAR_JOINTS });
    }
    Ok([right_angle(chain, 0)?, right_angle(chain, 1)?, right_angle(chain, 2)?, right_angle(chain, 3)?])
}

/// Joint angles \[rad\] of the nominal bar at a pose, for each configuration in the order of [`Configuration::ALL`].
///
/// A pose has six degrees of freedom, but the bar has five joints. The result therefore agrees with `target` in the bar's
/// direction and in the rotation of its end, while the distance of `target` from the gimbal is ignored. The closed form
/// includes no errors of the chain except joint offsets. For other errors, use [`ball_bar_inverse_refined`].
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

/// As [`ball_bar_inverse`], but only for the first configuration of [`Configuration::ALL`].
///
/// # Errors
/// As [`ball_bar_inverse`].
pub fn first_ball_bar_inverse(chain: &Chain, target: &Pose) -> Result<[f64; BAR_JOINTS], InverseError> {
    inverse_in_first(chain, target).map(|(_, angles_rad)| joints_from_angles(&chain.links, &angles_rad))
}

/// Converts joint variables to link angles by adding the links' offsets `theta`.
fn angles_from_joints(bar_links: &[DhLink], bar_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
    std::array::from_fn(|joint| bar_rad[joint] + theta_rad(bar_links, joint))
}

/// Converts link angles to joint variables, each in (-pi, pi], by subtracting the links' offsets `theta`.
fn joints_from_angles(bar_links: &[DhLink], angles_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
    std::array::from_fn(|joint| wrapped(angles_rad[joint] - theta_rad(bar_links, joint)))
}

/// Offset `theta` of a joint; zero if the link does not exist.
fn theta_rad(bar_links: &[DhLink], joint: usize) -> f64 {
    bar_links.get(joint).map_or(0.0, |link| link.theta_rad)
}

/// Solves for the first configuration of [`Configuration::ALL`]. Returns this configuration and the link angles (joint
/// variable + theta) \[rad\].
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
    // Joints 1 and 2 point the rod at the target position. Joints 3 to 5 rotate the end like a wrist.
    let (b1, b2) = point_z(&rod, [s1, s2], configuration.gimbal.sign(), 0.0);
    let base_from_rod = turn_and_twist(b1, s1) * turn_and_twist(b2, s2);
    let rod_from_end = base_from_rod.transpose() * base_from_end.rotation.matrix();
    let [b3, b4, b5] = wrist_angles(&rod_from_end, [s3, s4], configuration.cardan.sign(), 0.0);
    Ok((configuration, [b1, b2, b3, b4, b5]))
}

/// Joint angles \[rad\] that bring the end of `chain` closest to `target`. The chain may have geometric errors. Of all
/// equivalent solutions, the result is the one in the configuration of `near`, with each joint within half a turn of `near`.
///
/// Minimises the sum of squares of position error \[m\] and rotation vector \[rad\]. The end reaches `target` exactly only
/// if the bar can reach it.
///
/// # Errors
/// [`InverseError::NotConverged`] at a singular pose. If the chain is not a ball-bar, the errors of [`ball_bar_inverse`].
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
