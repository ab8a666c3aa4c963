//! Text for the terminal with the results of `identify plan`: a planned or checked path ([`summary`]), positions of the bar
//! ([`places`]) and selected poses ([`poses`]). It reports motion, margins and expected accuracy. [`pose_table`] creates the
//! table of the selected poses and the mapping of its columns.

use std::fmt::Write;

use shared::config::{self, AngleUnit, JointKind, RobotConfig};

use crate::kinematics::{Chain, Joints};
use crate::logs::{
    EulerFrame, LengthColumn, LengthUnit, MeasuredLengthMapping, MeasuredPoseMapping, PositionColumns,
    RotationColumns, RotationForm, joint_columns,
};
use crate::model::ParameterId;
use crate::plan::{
    BestPath, Checked, Constraints, ExpectedPosition, Information, MeasuredQuantity, Places, PlannedPoses,
    Way, position_m_min,
};

/// Largest number of bar positions that are listed.
const PLACES_SHOWN: usize = 10;
/// Undetermined parameters of a group are listed by name up to this number.
const NAMED: usize = 12;

/// Text about a path: expected accuracy, search, position of the bar, motion, margins and violations. `found` is the result
/// of the search that planned the path, or `None` if the path was only checked.
pub fn summary(
    checked: &Checked,
    constraints: &Constraints<'_>,
    information: &Information,
    found: Option<&BestPath>,
) -> String {
    let mut text = accuracy(checked, constraints, information);
    // Writing to a string cannot fail.
    if let Some(found) = found {
        let best = found.random_scores.iter().copied().fold(f64::INFINITY, f64::min);
        let _ = writeln!(
            text,
            "{} moves; {} of {} changes taken; criterion {:.3} times that of the best of {} random paths",
            found.route.path.moves.len(),
            found.progress.taken,
            found.progress.tried,
            found.progress.score / best,
            found.random_scores.len()
        );
    }
    let [x, y, z] = constraints.design.base_m;
    let _ = writeln!(
        text,
        "centre of the bar's gimbal in the robot's base frame: {x:.3}, {y:.3}, {z:.3} m (--base)"
    );
    let arm = constraints.robot;
    text.push_str(&ends(checked, arm));
    let rates = [&checked.speed_rad_s, &checked.acceleration_rad_s2, &checked.jerk_rad_s3];
    text.push_str(&joint_rows(&checked.joint_range_rad, rates, arm));
    let winding = |end: usize| checked.winding_rad.iter().map(move |range| range[end].to_degrees());
    text.push_str(&row("bar joint from start [deg]", winding(0), 1));
    text.push_str(&row("", winding(1), 1));
    let clearance =
        checked.clearance_m.map_or_else(String::new, |m| format!(", clearance {:.0} mm", m * 1e3));
    let _ = writeln!(
        text,
        "nearest to a singular pose of the bar {:.1} deg, of the robot {:.3} (singular value){clearance};\n\
         off the sphere at most {}",
        checked.bar_margin_rad.to_degrees(),
        checked.dexterity,
        mm(checked.off_sphere_m)
    );
    for violation in &checked.violations {
        let _ = writeln!(
            text,
            "violated: {}, first at {:.3} s, for {:.3} s in all",
            violation.obstacle, violation.first_s, violation.duration_s
        );
    }
    if checked.violations.is_empty() {
        text.push_str("all constraints are kept, checked every millisecond\n");
    }
    text
}

/// Lists the expected position error after a calibration for several sets of estimated terms, the parameters that the path
/// does not separate, and the efficiency of the path.
fn accuracy(checked: &Checked, constraints: &Constraints<'_>, information: &Information) -> String {
    let mut text = String::new();
    let expected = information.position(&checked.normal);
    let _ = writeln!(
        text,
        "{:.1} s; expected RMS position error over the workspace after a calibration, from white noise:\n\
         {} where the axes have no errors, {} with all terms of the axes, {} with the plate's length, too;\n\
         of the terms a calibration takes those that it finds, each of them alone:",
        checked.duration_s,
        mm(expected.axes_exact_m),
        mm(expected.with_terms_m),
        mm(expected.with_plate_m)
    );
    for with_group in information.with_each(&checked.normal) {
        let _ = writeln!(text, "  {:<33} {}", with_group.group.name(), mm(with_group.position_m));
    }
    let names =
        |group: &Vec<ParameterId>| group.iter().map(ToString::to_string).collect::<Vec<_>>().join("|");
    let not_separated: Vec<String> = information.not_separated(&checked.normal).iter().map(names).collect();
    if !not_separated.is_empty() {
        let _ = writeln!(text, "not separated by the data of this path: {}", not_separated.join(", "));
    }
    // The errors are squared, because efficiency is a ratio of variances.
    if let Some(least_m) = position_m_min(checked, constraints, information) {
        let _ = writeln!(
            text,
            "efficiency {:.0} %: no run of this length in this configuration of the arm has an expected error below {} with all terms",
            100.0 * (least_m / expected.with_terms_m).powi(2),
            mm(least_m)
        );
    }
    text
}

fn mm(length_m: f64) -> String {
    format!("{:.4} mm", length_m * 1e3)
}

/// One line with a name and its values. Adding zero turns -0 into 0.
fn row(name: &str, values: impl IntoIterator<Item = f64>, digits: usize) -> String {
    let values: String = values.into_iter().map(|value| format!("{:>9.digits$}", value + 0.0)).collect();
    format!("{name:<28}{values}\n")
}

/// Whether an arm has a prismatic axis, whose positions are in metres.
pub fn has_prismatic(arm: &Chain) -> bool {
    arm.links.iter().any(|link| link.joint == JointKind::Prismatic)
}

/// Lines with the extreme positions of the robot's joints and their largest speeds, accelerations and jerks, each in
/// the unit of its axis.
fn joint_rows(ranges: &[[f64; 2]], [speed, acceleration, jerk]: [&Joints; 3], arm: &Chain) -> String {
    let range = |end: usize| {
        ranges.iter().zip(&arm.links).map(move |(range, link)| range[end] * link.joint.display_factor())
    };
    let units = match has_prismatic(arm) {
        true => ["deg,mm", "rad/s,m/s", "rad/s2,m/s2", "rad/s3,m/s3"],
        false => ["deg", "rad/s", "rad/s2", "rad/s3"],
    };
    [
        row(&format!("robot joint, lowest [{}]", units[0]), range(0), 1),
        row(&format!("  highest [{}]", units[0]), range(1), 1),
        row(&format!("  speed [{}]", units[1]), speed.iter().copied(), 2),
        row(&format!("  acceleration [{}]", units[2]), acceleration.iter().copied(), 2),
        row(&format!("  jerk [{}]", units[3]), jerk.iter().copied(), 0),
    ]
    .concat()
}

/// A line that states whether the arm ends where it began. If the end differs from the start, the arm cannot return to the
/// start in a straight line in joint space while the bar is attached.
fn ends(checked: &Checked, arm: &Chain) -> String {
    /// Joint positions at start and end count as equal up to this difference \[rad, m\].
    const SAME: f64 = 1e-3;
    let states = &checked.visited.robot;
    let (Some(start), Some(end)) = (states.first(), states.last()) else { return String::new() };
    let distances = start.q.iter().zip(&*end.q).map(|(start, end)| (end - start).abs());
    let of_joints = distances.zip(&arm.links).enumerate();
    match of_joints.max_by(|(_, (a, _)), (_, (b, _))| a.total_cmp(b)) {
        Some((joint, (away, link))) if away > SAME => format!(
            "the path does not end where it begins: joint {} is {:.1} {} away; detach the bar before the arm drives back\n",
            joint + 1,
            away * link.joint.display_factor(),
            link.joint.display_symbol()
        ),
        _ => "the path ends where it begins\n".into(),
    }
}

/// Lists the best positions of the bar, one line each. If a second run was evaluated, the errors of both runs together
/// follow: first with the second run at the best position, then with the second run at another position.
pub fn places(places: &Places, duration_s: f64) -> String {
    let cells = |expected: &ExpectedPosition| {
        format!("{:>12.4}{:>12.4}", expected.axes_exact_m * 1e3, expected.with_terms_m * 1e3)
    };
    let list = |numbers: &[f64], digits: usize| {
        let numbers: Vec<String> = numbers.iter().map(|x| format!("{:.digits$}", x + 0.0)).collect();
        numbers.join(",")
    };
    let mut text = format!(
        "{} places of the bar with a path, {} without; expected RMS position error [mm] if the axes have no errors, and with the \
         errors of all their terms\n\
         {:>26}{:>9}{:>12}{:>12}   {}\n",
        places.found.len(),
        places.without_path,
        "--base [m]",
        "rod [m]",
        "no errors",
        "all terms",
        "--posture [deg, mm]"
    );
    for place in places.found.iter().take(PLACES_SHOWN) {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:>26}{:>9.3}{}   {}",
            list(&place.base_m, 2),
            place.length_m,
            cells(&place.expected),
            list(&place.posture_deg, 0)
        );
    }
    if let (Some(first), Some(second)) = (places.found.first(), &places.second) {
        let gain = |expected: &ExpectedPosition| {
            let um = (first.expected.with_terms_m - expected.with_terms_m) * 1e6;
            format!("{:>14.3}", um / (duration_s / 60.0))
        };
        let _ = writeln!(
            text,
            "a second run of this length: errors as above [mm], and the decrease with all terms per minute of its recording\n\
             {:>35}{:>12}{:>12}{:>14}\n\
             {:>35}{}\n{:>35}{}{}\n{:>35}{}{}\n\
             the station: --base {} --posture {}",
            "",
            "no errors",
            "all terms",
            "[um/min]",
            "best place alone",
            cells(&first.expected),
            "recorded twice as long",
            cells(&second.twice_as_long),
            gain(&second.twice_as_long),
            "second station of the bar",
            cells(&second.expected),
            gain(&second.expected),
            list(&second.place.base_m, 2),
            list(&second.place.posture_deg, 0)
        );
    }
    text
}

/// Text about poses that were selected out of `candidates` candidate poses, and about the accuracy of
/// the parameters that they determine.
pub fn poses(planned: &PlannedPoses, candidates: usize) -> String {
    let mut text = format!(
        "{} of {candidates} poses; RMS position error over all of them that is expected of a calibration:\n\
         {:.4} mm, with as many random ones {:.4} mm, of the robot as it is {:.4} mm\n\
         {:<36}{:>10}{:>16}{:>16}{:>14}\n",
        planned.joints.len(),
        planned.position_m * 1e3,
        planned.random_m * 1e3,
        planned.before_m * 1e3,
        "standard deviations (RMS)",
        "number",
        "before",
        "after",
        "undetermined"
    );
    for kind in &planned.determined {
        let undetermined: Vec<String> = kind.undetermined().map(|id| id.to_string()).collect();
        let size = |si: f64| kind.ids.first().map_or_else(String::new, |id| id.unit().display(si));
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:<36}{:>10}{:>16}{:>16}{:>14}",
            kind.name,
            kind.ids.len(),
            size(kind.prior),
            size(kind.sigma),
            undetermined.len()
        );
        if (1..=NAMED).contains(&undetermined.len()) {
            let _ = writeln!(text, "  undetermined: {}", undetermined.join(" "));
        }
    }
    if let Some(ways) = ways(planned) {
        text.push_str(&ways);
        text.push('\n');
    }
    text
}

/// A sentence about moves that avoid an obstacle or are blocked; `None` if there are no such moves.
pub fn ways(planned: &PlannedPoses) -> Option<String> {
    let detours = planned.ways.iter().filter(|way| matches!(way, Way::Through(_))).count();
    let blocked: Vec<String> = planned.blocked().iter().map(usize::to_string).collect();
    match (detours, blocked.is_empty()) {
        (0, true) => None,
        (_, true) => Some(format!(
            "{detours} moves avoid an obstacle by way of intermediate postures (column `way` of the table)"
        )),
        _ => Some(format!(
            "no path without collision was found to pose {}: a program stops before it; jog there by hand",
            blocked.join(", ")
        )),
    }
}

/// Columns of a measured position in the table of poses.
const POSITION: [&str; 3] = ["x_mm", "y_mm", "z_mm"];
/// Columns of a measured orientation.
const ROTATION: [&str; 3] = ["rx_deg", "ry_deg", "rz_deg"];
/// Column of a measured length.
const LENGTH: &str = "length_mm";

/// Table of poses with empty columns for the measured quantity, and the mapping of the columns for `calibrate`. Column `way`
/// is empty if the joints move in a straight line from the previous pose.
///
/// # Errors
/// [`toml::ser::Error`] if the mapping cannot be written as TOML.
pub fn pose_table(
    planned: &PlannedPoses,
    robot: &RobotConfig,
    measures: MeasuredQuantity,
) -> Result<(String, String), toml::ser::Error> {
    let joints = joint_columns(robot);
    let (position, rotation) = (POSITION.map(str::to_owned), ROTATION.map(str::to_owned));
    let mut columns: Vec<String> = joints.iter().map(|joint| joint.column.clone()).collect();
    match measures {
        MeasuredQuantity::Lengths => columns.push(LENGTH.into()),
        MeasuredQuantity::Positions => columns.extend(position.clone()),
        MeasuredQuantity::Poses => columns.extend(position.iter().chain(&rotation).cloned()),
    }
    let mut table = columns.join(",") + ",way\n";
    let numbers = |q: &Joints| -> Vec<String> {
        q.iter().zip(&joints).map(|(q, joint)| format!("{:.6}", q / joint.unit.to_si())).collect()
    };
    for (q, way) in planned.joints.iter().zip(&planned.ways) {
        let way = match way {
            Way::Straight => String::new(),
            Way::Through(postures) => {
                let postures: Vec<String> = postures.iter().map(|q| numbers(q).join(" ")).collect();
                format!("through {}", postures.join("; "))
            }
            Way::Blocked => "BLOCKED: no path without collision from the pose before".into(),
        };
        let empty = columns[joints.len()..].iter().map(|_| String::new());
        table += &numbers(q).into_iter().chain(empty).chain([way]).collect::<Vec<_>>().join(",");
        table.push('\n');
    }
    let mapping = if measures == MeasuredQuantity::Lengths {
        let length = LengthColumn { column: LENGTH.into(), unit: LengthUnit::Mm, offset_mm: 0.0 };
        config::to_toml(&MeasuredLengthMapping { length, joints, ..MeasuredLengthMapping::default() })?
    } else {
        let turned = RotationColumns {
            form: RotationForm::Euler,
            columns: rotation.to_vec(),
            unit: Some(AngleUnit::Deg),
            order: Some("xyz".into()),
            frame: Some(EulerFrame::Moving),
        };
        config::to_toml(&MeasuredPoseMapping {
            position: PositionColumns { columns: position, unit: LengthUnit::Mm },
            rotation: (measures == MeasuredQuantity::Poses).then_some(turned),
            joints,
            ..MeasuredPoseMapping::default()
        })?
    };
    Ok((table, mapping))
}

/// Whether the measured columns of a table of poses are empty. `false` if the table has none of these columns, because another
/// program has then written the table.
pub fn has_no_measurements(table: &str) -> bool {
    let mut rows = table.lines().map(|row| row.split(','));
    let is_measured = |name: &str| name == LENGTH || POSITION.contains(&name) || ROTATION.contains(&name);
    let header: Vec<bool> = rows.next().into_iter().flatten().map(is_measured).collect();
    let is_empty = |(cell, measured): (&str, &bool)| !measured || cell.trim().is_empty();
    header.contains(&true) && rows.all(|row| row.zip(&header).all(is_empty))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::{DhLink, Pose};

    #[test]
    fn a_prismatic_axis_is_shown_in_its_own_unit() {
        let kinds = [JointKind::Prismatic, JointKind::Revolute];
        let links = kinds.map(|joint| DhLink { joint, ..DhLink::default() }).to_vec();
        let arm = Chain::new(Pose::identity(), links);
        let rates = Joints::from_array([0.5, 1.25]);
        let text = joint_rows(&[[1.0, 1.5], [-1.0, 0.5]], [&rates; 3], &arm);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "robot joint, lowest [deg,mm]   1000.0    -57.3");
        assert_eq!(lines[1], "  highest [deg,mm]             1500.0     28.6");
        assert_eq!(lines[2], "  speed [rad/s,m/s]              0.50     1.25");
    }
}
