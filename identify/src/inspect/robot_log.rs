//! A robot's own log.

use super::{Inspection, joint_lines, stamps, suspect_still, unwrapped};
use crate::kinematics::Joints;
use crate::logs::{Origin, RobotLog};
use crate::prepare::unwrapped_log;

/// Rows that repeat all joints while the log moves on either side are frozen, not still.
const FROZEN_ROWS_MIN: usize = 3;
/// A joint that moved by this much over a frozen stretch was moving \[rad\].
const FROZEN_STEP_RAD: f64 = 1e-3;

/// What a robot's log holds.
pub fn robot_log(log: &RobotLog) -> Inspection {
    let mut inspection = Inspection::default();
    if let Some(robot) = &log.robot {
        inspection.fact("robot", robot.clone());
    }
    inspection.fact("length", format!("{:.1} s, {} rows", log.duration_s(), log.t_s.len()));
    inspection.fact("clock", format!("{}, first stamp {} ns", log.clock, log.first_stamp_ns));
    inspection.fact("angles", log.origin.name());
    if let Some(force) = &log.force {
        let numbers = force.values.iter().flat_map(|row| row.iter());
        let most = numbers.fold(0.0_f64, |most, value| most.max(value.abs()));
        inspection.fact("force on the bar", format!("{}, up to {most:.1}", force.kind.describe()));
    }
    let quality = &log.quality;
    stamps(&mut inspection, quality);
    if log.origin == Origin::Commanded {
        inspection.suspect(
            "the angles are what the controller asked for: servo lag is not in them; log the measured ones if possible",
        );
    }
    let frozen = frozen_rows(&log.q_rad);
    if frozen > 0 {
        inspection.suspect(format!(
            "{frozen} rows repeat the joints of the row before and then jump: the logger was not served in time"
        ));
    }
    for remark in &quality.remarks {
        inspection.suspect(remark.clone());
    }
    let (continuous, begun_anew) = unwrapped_log(log);
    unwrapped(&mut inspection, &begun_anew);
    inspection.joints = joint_lines('q', &log.t_s, &continuous.q_rad);
    suspect_still(&mut inspection);
    inspection
}

/// Rows in stretches where every joint repeats itself exactly, and that end in a jump.
fn frozen_rows(rows: &[Joints]) -> usize {
    let mut frozen = 0;
    let mut start = 0;
    for index in 1..rows.len() {
        if rows[index] == rows[index - 1] {
            continue;
        }
        let repeated = index - 1 - start;
        let step = rows[index].iter().zip(&rows[start]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        if repeated >= FROZEN_ROWS_MIN && step > FROZEN_STEP_RAD {
            frozen += repeated;
        }
        start = index;
    }
    frozen
}
