//! Rows of a tracker or a wire.

use shared::config::RobotConfig;
use shared::output::named;

use super::contacts::ranges;
use super::{Inspection, stamps};
use crate::calibrate::rows::{Mistake, Sizes, likely, misfit, wire_misfit};
use crate::instrument::{LengthRow, PoseRow};
use crate::kinematics::flange_chain;
use crate::logs::{LogQuality, MeasuredLengths, MeasuredPoses, TimedPoses};
use crate::statistics::extremes;

/// Names of set-ups that are listed.
const NAMED: usize = 8;

/// Rows of a tracker with the robot's joints, and how far the nominal robot is from them where tracker and probe are fitted to it.
pub fn poses(read: &MeasuredPoses, robot: &RobotConfig) -> Inspection {
    let mut inspection = Inspection::default();
    let rows: Vec<PoseRow> = read.rows.iter().map(PoseRow::from).collect();
    let turned = rows.iter().any(|row| row.rotation.is_some());
    let what = if turned { "positions with orientations" } else { "positions" };
    inspection.fact("rows", format!("{}, {what}", rows.len()));
    set_ups(&mut inspection, [("stations", &read.stations), ("targets", &read.targets)]);
    extent(&mut inspection, rows.iter().map(|row| row.position_m.into()));
    ranges(&mut inspection, rows.iter().map(|row| row.joints_rad), robot);
    let chain = flange_chain(robot);
    if let Some(figures) = misfit(&rows, &chain) {
        let rotation = figures.rotation_rad.map(|sizes| format!(" and {:.2} mrad", sizes.rms * 1e3));
        inspection.fact(
            "nominal robot",
            format!(
                "{:.2} mm{} (RMS) from the rows",
                figures.position_m.rms * 1e3,
                rotation.unwrap_or_default()
            ),
        );
    }
    if let Some(likely) = likely(&rows, &chain, &Mistake::of_joints(robot.axes())) {
        inspection.suspect(format!("most likely {likely}"));
    }
    inspection
}

/// Rows of a tracker on its own clock: their joints are in the robot's log.
pub fn timed_poses(read: &TimedPoses) -> Inspection {
    let mut inspection = Inspection::default();
    inspection.fact("rows", format!("{} over {:.1} s", read.rows.len(), read.rows.duration_s()));
    let quality = LogQuality { stamps: read.stamps.clone(), ..LogQuality::default() };
    stamps(&mut inspection, &read.rows.t_s, &quality);
    set_ups(&mut inspection, [("stations", &read.stations), ("targets", &read.targets)]);
    extent(&mut inspection, read.rows.iter().map(|row| row.position_m.into()));
    read.remarks.iter().for_each(|remark| inspection.suspect(remark.clone()));
    inspection
}

/// Rows of a wire, and what the nominal robot leaves of its lengths where the wire is fitted to it.
pub fn lengths(read: &MeasuredLengths, robot: &RobotConfig) -> Inspection {
    /// A nominal robot that leaves more of the lengths' variation is not the one of the rows, or they are read wrong.
    const LEFT: f64 = 0.3;
    let mut inspection = Inspection::default();
    let rows: Vec<LengthRow> = read.rows.iter().map(LengthRow::from).collect();
    let [low_m, high_m] = extremes(rows.iter().map(|row| row.length_m));
    inspection
        .fact("rows", format!("{}, lengths of {:.2} to {:.2} mm", rows.len(), low_m * 1e3, high_m * 1e3));
    set_ups(&mut inspection, [("anchors", &read.anchors), ("attachments", &read.attachments)]);
    ranges(&mut inspection, rows.iter().map(|row| row.joints_rad), robot);
    if let Some(Sizes { rms, .. }) = wire_misfit(&rows, &flange_chain(robot)) {
        inspection.fact("nominal robot", format!("lengths {:.2} mm off (RMS)", rms * 1e3));
        if rms > LEFT * (high_m - low_m) {
            inspection.suspect(
                "the nominal robot does not explain the lengths: check their unit, the joints' units and signs, and the robot's file",
            );
        }
    }
    inspection
}

fn set_ups(inspection: &mut Inspection, all: [(&str, &Vec<String>); 2]) {
    for (what, names) in all.into_iter().filter(|(_, names)| !names.is_empty()) {
        inspection.fact(what, format!("{}: {}", names.len(), named(names, NAMED)));
    }
}

/// The box in which the positions are.
fn extent(inspection: &mut Inspection, positions_m: impl Iterator<Item = [f64; 3]> + Clone) {
    let axes = ["x", "y", "z"].into_iter().enumerate().map(|(axis, name)| {
        let [low, high] = extremes(positions_m.clone().map(|position_m| position_m[axis] * 1e3));
        format!("{name} {low:.1} to {high:.1}")
    });
    inspection.fact("positions [mm]", axes.collect::<Vec<_>>().join(", "));
}
