//! Inspection of a robot's own log: clock and time stamps, repeated rows, and joints that are constant, hardly
//! move, or are impossibly fast.

use std::ops::Range;

use shared::config::{JointKind, RobotConfig};

use super::{Inspection, JointLine, joint_lines, stamps, suspect_still, unwrapped};
use crate::kinematics::Joints;
use crate::logs::{RESOLUTION_STEPS, RobotLog, ValueOrigin};
use crate::prepare::unwrapped_log;

/// If at least this number of rows repeat the row before and then a joint jumps, the robot did not stand still. Instead, the
/// logger received no new values.
const FROZEN_ROWS_MIN: usize = 3;
/// A step of a joint after repeated rows that is larger by [`RESOLUTION_STEPS`] counts as a jump \[rad\].
const FROZEN_STEP_RAD: f64 = 1e-3;

/// Reports the content of a robot's log and warns about suspicious findings.
pub fn robot_log(log: &RobotLog, robot: &RobotConfig) -> Inspection {
    let mut inspection = Inspection::default();
    if let Some(name) = &log.robot {
        inspection.fact("robot", name.clone());
    }
    inspection.fact("length", format!("{:.1} s, {} rows", log.q_rad.duration_s(), log.q_rad.len()));
    inspection.fact("clock", format!("{}, first stamp {} ns", log.clock, log.q_rad.first_stamp_ns));
    inspection.fact("angles", log.origin.name());
    if let Some(force) = &log.force {
        let numbers = force.values.iter().flat_map(|row| row.iter());
        let most = numbers.fold(0.0_f64, |most, value| most.max(value.abs()));
        inspection.fact("force on the bar", format!("{}, up to {most:.1}", force.kind.describe()));
    }
    let quality = &log.quality;
    stamps(&mut inspection, &log.q_rad.t_s, quality);
    if log.origin == ValueOrigin::Commanded {
        inspection
            .suspect("the angles are commanded ones, without servo lag; log the measured ones if possible");
    }
    let (continuous, wrapped) = unwrapped_log(log);
    let repeated = repeated_rows(&log.q_rad, &continuous.q_rad.resolutions());
    if repeated > 0 {
        inspection.suspect(format!(
            "{repeated} rows repeat the joints of the row before, and then the joints jump: the logger got no new values"
        ));
    }
    inspection.suspicious.extend_from_slice(&quality.remarks);
    unwrapped(&mut inspection, &wrapped);
    inspection.joints = joint_lines('q', robot.joint_kinds(), &continuous.q_rad.t_s, &continuous.q_rad);
    suspect_still(&mut inspection, "check what the logger reads for it");
    suspect_constant_columns(&mut inspection, log);
    suspect_fast(&mut inspection);
    inspection
}

/// Warns about joints that are constant while other joints move, because the logger probably did not read them.
fn suspect_constant_columns(inspection: &mut Inspection, log: &RobotLog) {
    let rows = &log.q_rad;
    let is_long = |part: &Range<usize>| part.len() >= FROZEN_ROWS_MIN;
    // Ranges that extend to the end of the log are reported, too.
    let constant = rows.constant_ranges(is_long, |_, _| true);
    for (joint, part) in (1..).zip(constant).filter_map(|(joint, part)| Some((joint, part?))) {
        let (from_s, to_s) = (rows.t_s[part.start], rows.t_s[part.end - 1]);
        inspection.suspect(format!(
            "q{joint} is constant from {from_s:.2} s to {to_s:.2} s while other joints move; check what the logger reads for it"
        ));
    }
}

/// Warns about joints that are faster than those of any robot. Their stamps or values are wrong.
fn suspect_fast(inspection: &mut Inspection) {
    /// Twice the speed of the last joint of small robots \[deg/s\].
    const SPEED_MAX_DEG_S: f64 = 3000.0;
    /// Twice the speed of fast linear axes \[mm/s\].
    const SPEED_MAX_MM_S: f64 = 10_000.0;
    let reached = |JointLine { name, kind, speed_max, .. }: &JointLine| {
        let limit = if *kind == JointKind::Revolute { SPEED_MAX_DEG_S } else { SPEED_MAX_MM_S };
        (*speed_max > limit).then(|| format!("{name} reaches {speed_max:.0} {}/s", kind.display_symbol()))
    };
    inspection
        .suspect_joints(reached, ": no robot is so fast; look for rows with a wrong stamp or a wrong value");
}

/// Number of rows that repeat the row before, in segments of constant joints that end with a jump of a joint. `resolutions`
/// are the steps to which the values of each joint are rounded.
fn repeated_rows(rows: &[Joints], resolutions: &[f64]) -> usize {
    let mut count = 0;
    let mut start = 0;
    for index in 1..rows.len() {
        if rows[index] == rows[index - 1] {
            continue;
        }
        let repeated = index - 1 - start;
        let mut steps = rows[index].iter().zip(&rows[start]).zip(resolutions);
        let jumps = steps.any(|((to, from), resolution)| {
            (to - from).abs() > FROZEN_STEP_RAD + RESOLUTION_STEPS * resolution
        });
        if repeated >= FROZEN_ROWS_MIN && jumps {
            count += repeated;
        }
        start = index;
    }
    count
}
