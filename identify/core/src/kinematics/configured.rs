//! Builds the nominal chains of robot and bar from their configuration files.

use nalgebra::{Rotation3, Vector3};
use shared::config::{BallBarConfig, Convention, LinkConfig, RobotConfig, TransformConfig};

use super::{Chain, DhLink, Pose, ROD_LINK};

fn link(config: &LinkConfig) -> DhLink {
    DhLink {
        joint: config.joint,
        a_m: config.a_m,
        alpha_rad: config.alpha_deg.to_radians(),
        d_m: config.d_m,
        theta_rad: config.theta_deg.to_radians(),
        beta_rad: config.beta_deg.to_radians(),
    }
}

fn pose(config: &TransformConfig) -> Pose {
    let [roll, pitch, yaw] = config.rpy_deg.map(f64::to_radians);
    Pose::from_parts(Vector3::from(config.xyz_m).into(), Rotation3::from_euler_angles(roll, pitch, yaw))
}

/// The robot with the bar's tool (length along z) and offset plate (length along x). If the last link ends at
/// the flange without a twist, the two lengths are added to `d` and `a` of this link. Otherwise they follow
/// the flange in `last_from_end`.
pub fn robot_chain(robot: &RobotConfig, bar: &BallBarConfig) -> Chain {
    let mut chain = flange_chain(robot);
    let end = DhLink { a_m: bar.plate_m, d_m: bar.tool_m, ..DhLink::default() };
    match chain.links.last_mut() {
        Some(last)
            if [last.alpha_rad, last.beta_rad] == [0.0; 2] && chain.last_from_end == Pose::identity() =>
        {
            last.a_m += bar.plate_m;
            last.d_m += bar.tool_m;
        }
        _ => chain.last_from_end *= end.transform(0.0),
    }
    chain
}

/// The robot up to its flange, without the bar, as standard Denavit-Hartenberg links.
///
/// In a table of modified Denavit-Hartenberg parameters, each row starts with the transform from the previous
/// axis, `Tx(a) Rx(alpha)`. This function moves the transform to the end of the previous link. The transform of
/// the first row moves to the base of the chain.
pub fn flange_chain(robot: &RobotConfig) -> Chain {
    let mut chain = Chain::new(pose(&robot.base), robot.links.iter().map(link).collect());
    chain.last_from_end = pose(&robot.flange);
    if robot.convention == Convention::Modified {
        // The loop goes from the last axis to the first. `after` is the transform that follows the axis of the current
        // iteration; it is the identity for the last axis. The transform before the first axis belongs to the base.
        let mut after = DhLink::default();
        for link in chain.links.iter_mut().rev() {
            let before = DhLink { theta_rad: 0.0, d_m: 0.0, ..*link };
            *link = DhLink { joint: link.joint, theta_rad: link.theta_rad, d_m: link.d_m, ..after };
            after = before;
        }
        chain.root_from_base *= after.transform(0.0);
    }
    chain
}

/// The nominal ball-bar, with its length added to `d` of link 3. Its base is at the root's origin, because the
/// position of the base is estimated by the calibration.
pub fn ball_bar_chain(bar: &BallBarConfig) -> Chain {
    let mut chain = Chain::new(Pose::identity(), bar.links.iter().map(link).collect());
    if let Some(rod) = chain.links.get_mut(ROD_LINK) {
        rod.d_m += bar.length_m;
    }
    chain
}
