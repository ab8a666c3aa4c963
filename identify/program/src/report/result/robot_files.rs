//! Files with the identified robot for controllers and other programs: `robot.urdf`, and the tables of corrections. This
//! module decides which of these files are written. It also converts the identified links to a kinematic chain.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use shared::config::{BallBarConfig, JointKind, RobotConfig};

use super::corrections::{corrections, csv, log_corrections};
use super::file::{CalibrationFile, FileError, ParameterEntry, replace};
use crate::calibrate::validation::deployment::Deployment;
use crate::kinematics::{Chain, DhLink, Pose, flange_chain, robot_chain, roll_pitch_yaw};
use crate::logs::LoggedJoints;
use crate::model::ParameterId;

impl CalibrationFile {
    /// Builds the chain of the robot's links, beginning at the root. `number` selects the number of an entry that is used,
    /// such as the identified value or the nominal value. A joint is prismatic if the validity ranges list it as prismatic.
    pub(crate) fn links(&self, number: impl Fn(&ParameterEntry) -> f64) -> Chain {
        let mut links: Vec<DhLink> = Vec::new();
        for entry in &self.parameters {
            let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
            let is_prismatic =
                self.validity.as_ref().is_some_and(|validity| validity.prismatic.contains(&link));
            let joint = if is_prismatic { JointKind::Prismatic } else { JointKind::Revolute };
            if links.len() <= link {
                links.resize_with(link + 1, DhLink::default);
            }
            links[link].joint = joint;
            *links[link].number_mut(parameter) = number(entry);
        }
        Chain::new(Pose::identity(), links)
    }

    /// Kinematic chain of the identified robot. It ends where the calibration's last link ends: at the flange, or at the end
    /// of the ball-bar's plate and tool.
    pub fn robot_chain(&self, robot: &RobotConfig, bar: Option<&BallBarConfig>) -> Chain {
        let mut chain = bar.map_or_else(|| flange_chain(robot), |bar| robot_chain(robot, bar));
        for entry in &self.parameters {
            let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
            let Some(link) = chain.links.get_mut(link) else { continue };
            *link.number_mut(parameter) = entry.value;
        }
        chain
    }

    /// Writes the files that a controller can apply, for each deployment that [`CalibrationFile::serves`] accepts.
    /// `robot.urdf` and `corrections.csv` contain links without joint errors. `offsets.csv` contains joint offsets alone.
    /// For each of the two tables, a second table contains the joint offsets in units and signs of the joints in `logged`.
    /// Each file is written completely or not at all. Returns the paths of the files.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write_robot(
        &self,
        robot: &RobotConfig,
        bar: Option<&BallBarConfig>,
        logged: Option<&LoggedJoints>,
        directory: &Path,
    ) -> Result<Vec<PathBuf>, FileError> {
        let mut written = Vec::new();
        for (name, deployment) in [("corrections", Deployment::Dh), ("offsets", Deployment::Offsets)] {
            if !self.serves(deployment) {
                continue;
            }
            let tables = [
                ("", corrections(self, robot, deployment)),
                ("_log", log_corrections(self, robot, logged, deployment)?),
            ];
            for (ending, rows) in tables {
                written.push(replace(directory, &format!("{name}{ending}.csv"), &csv(&rows)?)?);
            }
        }
        if self.serves(Deployment::Dh) {
            let links = self.deployed(Deployment::Dh).robot_chain(robot, bar);
            let about = self.held_out_m(Deployment::Dh).map_or_else(String::new, |[nominal_m, links_m]| {
                format!(
                    " Links alone, without errors of joints: held-out positions {:.4} mm RMS, nominal {:.4}.",
                    links_m * 1e3,
                    nominal_m * 1e3
                )
            });
            written.push(replace(directory, "robot.urdf", &urdf(robot, &links, bar, &about))?);
        }
        Ok(written)
    }
}

/// The robot as URDF. Joints move about or along the z axes of the frames `axis_1`, `axis_2` and so on. Joint variables are
/// those of the model. How the joint variables relate to the signs and offsets of the controller is defined by the robot's
/// configuration. Frame `flange` is the robot's flange, and frame `ball_bar_end` is the end of the bar's plate and tool.
///
/// `about` is written as a comment. URDF requires limits of effort and velocity. They are written as zero, because a
/// calibration does not determine them.
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
        append_joint(&mut text, &format!("joint_{}", index + 1), &parent, &child, &from_parent, axis);
        from_parent = link.transform(0.0);
        parent = child;
    }
    let end = from_parent * identified.last_from_end;
    // The link from the flange to the end of the bar: plate and tool.
    let behind_flange =
        |bar: &BallBarConfig| DhLink { a_m: bar.plate_m, d_m: bar.tool_m, ..DhLink::default() };
    let flange = bar.map_or(end, |bar| end * behind_flange(bar).transform(0.0).inverse());
    append_joint(&mut text, "to_flange", &parent, "flange", &flange, None);
    if bar.is_some() {
        append_joint(&mut text, "to_ball_bar_end", &parent, "ball_bar_end", &end, None);
    }
    text.push_str("</robot>\n");
    text
}

/// Appends a link and the joint that connects it to its parent. The joint is fixed if `axis` is `None`.
fn append_joint(
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
