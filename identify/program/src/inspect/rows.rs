//! Inspection of rows of a tracker, a wire or a touch probe. It reports the ranges of measurements and joints, and the
//! residuals of the nominal robot after a fit of the instrument. If these residuals are large, it names the mistake in the
//! file that most likely explains them.

use shared::config::RobotConfig;
use shared::output::named;

use super::contacts::ranges;
use super::{Inspection, stamps};
use crate::calibrate::rows::{likely, misfit, some_of};
use crate::instrument::{FaceTable, Instrument, Mistake, PoseError, Touch, Tracker, Wire};
use crate::kinematics::flange_chain;
use crate::logs::{LogQuality, MeasuredLengths, MeasuredPoses, TimedPoses, Touches, drop_copies};
use crate::report::rows::OTHER_ROBOT_M;
use crate::statistics::extremes;

/// Largest number of names of stations, targets or faces that are listed.
const NAMED: usize = 8;
/// If the RMS error of the nominal robot's orientations is larger than this, the rows probably belong
/// to another robot \[rad\].
const OTHER_ROBOT_RAD: f64 = 0.1;

/// Inspects rows of a tracker that contain the robot's joints.
pub fn poses(read: &MeasuredPoses, robot: &RobotConfig) -> Inspection {
    let mut inspection = Inspection::default();
    let rows = &read.rows;
    let turned = rows.iter().any(|row| row.rotation.is_some());
    let what = if turned { "positions with orientations" } else { "positions" };
    inspection.fact("rows", format!("{}, {what}", rows.len()));
    set_ups(&mut inspection, [("stations", &read.stations), ("targets", &read.targets)]);
    extent(&mut inspection, rows.iter().map(|row| row.position_m.into()));
    inspection.suspicious.extend(drop_copies(&mut rows.to_vec(), |row| &mut row.line));
    nominal_robot(&mut inspection, &Tracker::new(rows).into(), robot);
    inspection
}

/// Reports the range of each joint, and the residuals of the nominal robot after a fit of the instrument. If the residuals
/// are large, also reports their probable cause.
fn nominal_robot(inspection: &mut Inspection, instrument: &Instrument, robot: &RobotConfig) {
    ranges(inspection, instrument.joints().into_iter(), robot);
    let chain = flange_chain(robot);
    if let Err(error) = instrument.contradicting(&chain) {
        inspection.suspect(error.to_string());
    }
    let thinned = some_of(instrument);
    let error = misfit(&thinned, &chain);
    if let Some(PoseError { position_m, rotation_rad }) = error {
        let rotation = rotation_rad.map(|rad| format!(" and {:.2} mrad", rad * 1e3)).unwrap_or_default();
        let fact = format!("{:.2} mm{rotation} (RMS) from the rows", position_m * 1e3);
        inspection.fact("nominal robot", fact);
    }
    let is_of_another = |error: PoseError| {
        error.position_m > OTHER_ROBOT_M || error.rotation_rad.is_some_and(|rad| rad > OTHER_ROBOT_RAD)
    };
    let mut mistakes = instrument.mistakes(robot.axes());
    // Displacements of an instrument or target are not reported, because the calibration finds them.
    mistakes.retain(|mistake| !matches!(mistake, Mistake::Moved(_)));
    if let Some(likely) = likely(instrument, &chain, &mistakes) {
        inspection.suspect(format!("most likely {likely}"));
    } else if error.is_some_and(is_of_another) {
        inspection.suspect(
            "the rows differ from the nominal robot by more than errors of a robot: check that the file is that of this robot, and \
             units, signs and frames of the measurement",
        );
    }
}

/// Inspects rows of a tracker that contain times on the tracker's clock instead of joints. The joints are
/// in the robot's log.
pub fn timed_poses(read: &TimedPoses) -> Inspection {
    let mut inspection = Inspection::default();
    inspection.fact("rows", format!("{} over {:.1} s", read.rows.len(), read.rows.duration_s()));
    let quality = LogQuality { stamps: read.stamps.clone(), ..LogQuality::default() };
    stamps(&mut inspection, &read.rows.t_s, &quality);
    set_ups(&mut inspection, [("stations", &read.stations), ("targets", &read.targets)]);
    extent(&mut inspection, read.rows.iter().map(|row| row.position_m.into()));
    inspection.suspicious.extend_from_slice(&read.remarks);
    inspection
}

/// Inspects rows of a wire.
pub fn lengths(read: &MeasuredLengths, robot: &RobotConfig) -> Inspection {
    let mut inspection = Inspection::default();
    let rows = &read.rows;
    let [low_m, high_m] = extremes(rows.iter().map(|row| row.length_m));
    inspection
        .fact("rows", format!("{}, lengths of {:.2} to {:.2} mm", rows.len(), low_m * 1e3, high_m * 1e3));
    set_ups(&mut inspection, [("anchors", &read.anchors), ("attachments", &read.attachments)]);
    inspection.suspicious.extend(drop_copies(&mut rows.to_vec(), |row| &mut row.line));
    nominal_robot(&mut inspection, &Wire::new(rows).into(), robot);
    inspection
}

/// Inspects rows of a touch probe or dial gauge that touches flat faces.
pub fn touches(read: &Touches, robot: &RobotConfig) -> Inspection {
    let mut inspection = Inspection::default();
    let rows = &read.rows;
    inspection.fact("rows", rows.len().to_string());
    let [low_m, high_m] = extremes(rows.iter().map(|row| row.reading_m));
    if low_m < high_m {
        inspection.fact("readings", format!("{:.3} to {:.3} mm", low_m * 1e3, high_m * 1e3));
    }
    inspection.fact("faces", format!("{}: {}", read.faces.len(), named(&read.faces, NAMED)));
    inspection.suspicious.extend(drop_copies(&mut rows.to_vec(), |row| &mut row.line));
    let touch = Touch::new(rows, &read.faces, &FaceTable::default(), &flange_chain(robot));
    nominal_robot(&mut inspection, &touch.into(), robot);
    inspection
}

/// Reports the names of stations and targets in the rows.
fn set_ups(inspection: &mut Inspection, lists: [(&str, &Vec<String>); 2]) {
    for (what, names) in lists.into_iter().filter(|(_, names)| !names.is_empty()) {
        inspection.fact(what, format!("{}: {}", names.len(), named(names, NAMED)));
    }
}

/// Reports the range of the positions along each axis.
fn extent(inspection: &mut Inspection, positions_m: impl Iterator<Item = [f64; 3]> + Clone) {
    let axes = ["x", "y", "z"].into_iter().enumerate().map(|(axis, name)| {
        let [low, high] = extremes(positions_m.clone().map(|position_m| position_m[axis] * 1e3));
        format!("{name} {low:.1} to {high:.1}")
    });
    inspection.fact("positions [mm]", axes.collect::<Vec<_>>().join(", "));
}
