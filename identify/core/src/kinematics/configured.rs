//! Nominal chains of robot and bar, from the robot's file and the bar's file.

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

/// The robot with the bar's tool and offset plate: in its last link (`d` and `a`), or after the flange if the flange does not
/// continue the last link.
pub fn robot_chain(robot: &RobotConfig, bar: &BallBarConfig) -> Chain {
    let mut chain = flange_chain(robot);
    let end = DhLink { a_m: bar.plate_m, d_m: bar.tool_m, ..DhLink::default() };
    match chain.links.last_mut() {
        Some(last) if last.alpha_rad == 0.0 && chain.last_from_end == Pose::identity() => {
            last.a_m += bar.plate_m;
            last.d_m += bar.tool_m;
        }
        _ => chain.last_from_end *= end.transform(0.0),
    }
    chain
}

/// The robot without a bar up to its flange, as standard links.
///
/// A modified table has the transform to the next axis, `Tx(a) Rx(alpha)`, at the start of the next row; the
/// first row's belongs to the base.
pub fn flange_chain(robot: &RobotConfig) -> Chain {
    let mut chain = Chain::new(pose(&robot.base), robot.links.iter().map(link).collect());
    chain.last_from_end = pose(&robot.flange);
    if robot.convention == Convention::Modified {
        // No transform follows the last axis; the first row's precedes the first axis.
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

/// The ball-bar with its length in `d` of link 3 and its base at the root's origin: a calibration estimates the base.
pub fn ball_bar_chain(bar: &BallBarConfig) -> Chain {
    let mut chain = Chain::new(Pose::identity(), bar.links.iter().map(link).collect());
    if let Some(rod) = chain.links.get_mut(ROD_LINK) {
        rod.d_m += bar.length_m;
    }
    chain
}
