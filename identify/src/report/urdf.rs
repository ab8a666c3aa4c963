//! The identified robot as URDF, for ROS, MoveIt, Pinocchio and whatever else reads it.

use std::fmt::Write;

use nalgebra::Matrix3;
use shared::config::{BallBarConfig, RobotConfig};

use crate::kinematics::{Chain, DhLink, Pose};

/// Joints turn about z of frames `axis_1` to `axis_6`; joint angles are those of the model (see the robot's configuration
/// for signs and zeros of the controller). `flange` is the robot's own, `ball_bar_end` where plate and tool of the bar end.
///
/// Effort and velocity, which URDF demands, are not known to a calibration and are zero.
pub fn urdf(robot: &RobotConfig, identified: &Chain, bar: Option<&BallBarConfig>) -> String {
    let mut text = String::from("<?xml version=\"1.0\"?>\n");
    // Writing to a string cannot fail.
    let _ = writeln!(text, "<!-- Written by identify. Lengths in m, angles in rad. -->");
    let _ = writeln!(text, "<robot name=\"{}\">", escaped(&robot.name));
    let _ = writeln!(text, "  <link name=\"base\"/>");
    let mut from_parent = identified.root_from_base;
    let mut parent = "base".to_owned();
    for (index, link) in identified.links.iter().enumerate() {
        let child = format!("axis_{}", index + 1);
        let limits_deg = robot.joint_limits_deg.get(index).copied().unwrap_or([-180.0, 180.0]);
        joint(&mut text, &format!("joint_{}", index + 1), &parent, &child, &from_parent, Some(limits_deg));
        from_parent = link.transform(0.0);
        parent = child;
    }
    if let Some(last) = identified.links.last() {
        let (plate_m, tool_m) = bar.map_or((0.0, 0.0), |bar| (bar.plate_m, bar.tool_m));
        let flange = DhLink { a_m: last.a_m - plate_m, d_m: last.d_m - tool_m, ..*last };
        joint(&mut text, "to_flange", &parent, "flange", &flange.transform(0.0), None);
        if bar.is_some() {
            joint(&mut text, "to_ball_bar_end", &parent, "ball_bar_end", &last.transform(0.0), None);
        }
    }
    text.push_str("</robot>\n");
    text
}

/// A joint and the link after it.
fn joint(
    text: &mut String,
    name: &str,
    parent: &str,
    child: &str,
    origin: &Pose,
    limits_deg: Option<[f64; 2]>,
) {
    let p = origin.translation.vector;
    let [roll, pitch, yaw] = roll_pitch_yaw(origin.rotation.matrix());
    let kind = if limits_deg.is_some() { "revolute" } else { "fixed" };
    let _ = writeln!(text, "  <link name=\"{child}\"/>");
    let _ = writeln!(text, "  <joint name=\"{name}\" type=\"{kind}\">");
    let _ = writeln!(text, "    <parent link=\"{parent}\"/>");
    let _ = writeln!(text, "    <child link=\"{child}\"/>");
    let _ = writeln!(text, "    <origin xyz=\"{} {} {}\" rpy=\"{roll} {pitch} {yaw}\"/>", p.x, p.y, p.z);
    if let Some([low, high]) = limits_deg.map(|limits| limits.map(f64::to_radians)) {
        let _ = writeln!(text, "    <axis xyz=\"0 0 1\"/>");
        let _ = writeln!(text, "    <limit lower=\"{low}\" upper=\"{high}\" effort=\"0\" velocity=\"0\"/>");
    }
    let _ = writeln!(text, "  </joint>");
}

/// `R = Rz(yaw) Ry(pitch) Rx(roll)`, as URDF has it. Links as here have a pitch near zero, far from where roll and yaw
/// become one.
fn roll_pitch_yaw(r: &Matrix3<f64>) -> [f64; 3] {
    [r[(2, 1)].atan2(r[(2, 2)]), (-r[(2, 0)]).atan2(r[(2, 1)].hypot(r[(2, 2)])), r[(1, 0)].atan2(r[(0, 0)])]
}

fn escaped(name: &str) -> String {
    name.replace('&', "&amp;").replace('"', "&quot;").replace('<', "&lt;").replace('>', "&gt;")
}
