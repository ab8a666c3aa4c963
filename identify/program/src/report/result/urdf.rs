//! The identified robot as URDF, for ROS, MoveIt, Pinocchio and whatever else reads it.

use std::fmt::Write;

use shared::config::{BallBarConfig, JointKind, RobotConfig};

use crate::kinematics::{Chain, DhLink, Pose, roll_pitch_yaw};

/// Joints move about or along z of frames `axis_1`, `axis_2` and so on; joint variables are those of the model (see the
/// robot's configuration for signs and zeros of the controller). `flange` is the robot's own, `ball_bar_end` where plate and
/// tool of the bar end.
///
/// `about` is written as a comment. Effort and velocity, which URDF demands, are not known to a calibration and are zero.
pub fn urdf(robot: &RobotConfig, identified: &Chain, bar: Option<&BallBarConfig>, about: &str) -> String {
    let mut text = String::from("<?xml version=\"1.0\"?>\n");
    // Writing to a string cannot fail.
    let _ = writeln!(text, "<!-- Written by identify. Lengths in m, angles in rad.{about} -->");
    let _ = writeln!(text, "<robot name=\"{}\">", escaped(&robot.name));
    let _ = writeln!(text, "  <link name=\"base\"/>");
    let mut from_parent = identified.root_from_base;
    let mut parent = "base".to_owned();
    for ((index, link), limits) in identified.links.iter().enumerate().zip(robot.joint_limits()) {
        let child = format!("axis_{}", index + 1);
        let axis = Some((link.joint, limits));
        joint(&mut text, &format!("joint_{}", index + 1), &parent, &child, &from_parent, axis);
        from_parent = link.transform(0.0);
        parent = child;
    }
    let end = from_parent * identified.last_from_end;
    let behind_flange =
        |bar: &BallBarConfig| DhLink { a_m: bar.plate_m, d_m: bar.tool_m, ..DhLink::default() };
    let flange = bar.map_or(end, |bar| end * behind_flange(bar).transform(0.0).inverse());
    joint(&mut text, "to_flange", &parent, "flange", &flange, None);
    if bar.is_some() {
        joint(&mut text, "to_ball_bar_end", &parent, "ball_bar_end", &end, None);
    }
    text.push_str("</robot>\n");
    text
}

/// A joint and the link after it; fixed where it has no axis.
fn joint(
    text: &mut String,
    name: &str,
    parent: &str,
    child: &str,
    origin: &Pose,
    axis: Option<(JointKind, [f64; 2])>,
) {
    let p = origin.translation.vector;
    let [roll, pitch, yaw] = roll_pitch_yaw(&origin.rotation);
    let kind = match axis {
        Some((JointKind::Revolute, _)) => "revolute",
        Some((JointKind::Prismatic, _)) => "prismatic",
        None => "fixed",
    };
    let _ = writeln!(text, "  <link name=\"{child}\"/>");
    let _ = writeln!(text, "  <joint name=\"{name}\" type=\"{kind}\">");
    let _ = writeln!(text, "    <parent link=\"{parent}\"/>");
    let _ = writeln!(text, "    <child link=\"{child}\"/>");
    let _ = writeln!(text, "    <origin xyz=\"{} {} {}\" rpy=\"{roll} {pitch} {yaw}\"/>", p.x, p.y, p.z);
    if let Some((_, [low, high])) = axis {
        let _ = writeln!(text, "    <axis xyz=\"0 0 1\"/>");
        let _ = writeln!(text, "    <limit lower=\"{low}\" upper=\"{high}\" effort=\"0\" velocity=\"0\"/>");
    }
    let _ = writeln!(text, "  </joint>");
}

fn escaped(name: &str) -> String {
    name.replace('&', "&amp;").replace('"', "&quot;").replace('<', "&lt;").replace('>', "&gt;")
}
