//! Text for `identify robot check`, which checks the configuration of a robot.

use std::fmt::Write;

use shared::config::RobotConfig;

use crate::robot::RobotCheck;

/// Lists properties of the robot, one line for each axis, and the findings that look wrong.
pub fn robot_check(robot: &RobotConfig, check: &RobotCheck) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    for (what, fact) in &check.facts {
        let _ = writeln!(text, "{what:<24} {fact}");
    }
    let _ = writeln!(text, "\naxis  kind       limits                  at zero: through [m]           along");
    for (((kind, point, along), [low, high]), number) in check.axes.iter().zip(robot.joint_limits()).zip(1..)
    {
        let (factor, unit) = (kind.display_factor(), kind.display_symbol());
        let _ = writeln!(
            text,
            "{number:<4}  {:<9}  {:>8.1} to {:>6.1} {unit:<4} {:>8.4} {:>8.4} {:>8.4}   {:>6.3} {:>6.3} {:>6.3}",
            format!("{kind:?}").to_lowercase(),
            low * factor,
            high * factor,
            point.x,
            point.y,
            point.z,
            along.x,
            along.y,
            along.z
        );
    }
    text.push('\n');
    if check.suspicious.is_empty() {
        text.push_str("nothing looks wrong\n");
    }
    for sentence in &check.suspicious {
        let _ = writeln!(text, "! {sentence}");
    }
    text
}
