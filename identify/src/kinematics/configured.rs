//! Nominal chains from configuration.

use shared::config::{BallBarConfig, LinkConfig, RobotConfig};

use super::{Chain, DhLink, Pose};

fn link(config: &LinkConfig) -> DhLink {
    DhLink {
        a_m: config.a_m,
        alpha_rad: config.alpha_deg.to_radians(),
        d_m: config.d_m,
        theta_rad: config.theta_deg.to_radians(),
        beta_rad: 0.0,
    }
}

fn chain(links: &[LinkConfig]) -> Chain {
    Chain { root_from_base: Pose::identity(), links: links.iter().map(link).collect() }
}

/// The robot with the bar's tool and offset plate folded into its last link (`d` and `a`).
pub fn robot_chain(robot: &RobotConfig, bar: &BallBarConfig) -> Chain {
    let mut chain = chain(&robot.links);
    if let Some(last) = chain.links.last_mut() {
        last.a_m += bar.plate_m;
        last.d_m += bar.tool_m;
    }
    chain
}

/// The robot by itself, to its flange.
pub fn flange_chain(robot: &RobotConfig) -> Chain {
    chain(&robot.links)
}

/// The ball-bar with its length in `d` of link 3, standing at the root's origin: its base is found by calibration.
pub fn ball_bar_chain(bar: &BallBarConfig) -> Chain {
    /// The rod lies along z of frame 2.
    const ROD_LINK: usize = 2;
    let mut chain = chain(&bar.links);
    if let Some(rod) = chain.links.get_mut(ROD_LINK) {
        rod.d_m += bar.length_m;
    }
    chain
}
