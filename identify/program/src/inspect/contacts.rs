//! Inspection of rows with a ball in sockets: number of visits to each socket, ranges of the joints, orientations, and the
//! distances between ball and sockets with the nominal robot.

use nalgebra::{Rotation3, UnitQuaternion};
use shared::config::{JointKind, RobotConfig};

use super::{Inspection, TRAVEL_MIN_DEG};
use crate::instrument::{Contact, Measures, SocketTable};
use crate::kinematics::{Chain, Joints, flange_chain};
use crate::logs::{TipRow, drop_copies};
use crate::model::Model;
use crate::statistics::{Sizes, extremes};

/// Inspects rows with a ball in sockets. Also checks whether the nominal robot places the ball in the sockets
/// that the rows name.
pub fn contacts(rows: &[TipRow], table: &SocketTable, robot: &RobotConfig) -> Inspection {
    let mut inspection = Inspection::default();
    let visits = |socket: usize| rows.iter().filter(|row| row.part == socket).count();
    let counted =
        table.names().into_iter().enumerate().map(|(socket, name)| format!("{name} {}", visits(socket)));
    inspection.fact("rows", format!("{}: {}", rows.len(), counted.collect::<Vec<_>>().join(", ")));
    let counts = [(table.sockets.len(), "places"), (table.distances.len(), "distances")];
    let known = counts.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}"));
    inspection.fact("known of sockets", known.collect::<Vec<_>>().join(", "));
    inspection.suspicious.extend(drop_copies(&mut rows.to_vec(), |row| &mut row.line));
    ranges(&mut inspection, rows.iter().map(|row| row.joints_rad), robot);
    let chain = flange_chain(robot);
    few_orientations(&mut inspection, rows, table, &chain);
    match Contact::new(rows, table) {
        Ok(contact) => closure(&mut inspection, contact, &chain, rows),
        Err(error) => inspection.suspect(error.to_string()),
    }
    inspection
}

/// Reports the range of each joint, and warns about revolute joints that hardly moved.
pub(super) fn ranges(
    inspection: &mut Inspection,
    rows: impl Iterator<Item = Joints> + Clone,
    robot: &RobotConfig,
) {
    for (joint, kind) in robot.joint_kinds().enumerate() {
        let (name, unit) = (format!("q{}", joint + 1), kind.display_symbol());
        let [low, high] = extremes(rows.clone().map(|q| q[joint] * kind.display_factor()));
        inspection.fact(&name, format!("{low:.1} to {high:.1} {unit}"));
        if kind == JointKind::Revolute && high - low < TRAVEL_MIN_DEG {
            inspection.suspect(format!(
                "{name} moved by less than {TRAVEL_MIN_DEG} degrees, which does not determine its link: choose postures that move it"
            ));
        }
    }
}

/// Warns about sockets that are visited in nearly the same orientation only. Such a socket adds little information, because
/// the robot repeats the same error at each visit.
fn few_orientations(inspection: &mut Inspection, rows: &[TipRow], table: &SocketTable, chain: &Chain) {
    /// A socket is reported if the orientations at all visits differ from the orientation at the first visit by
    /// less than this \[rad\].
    const TURN_MIN_RAD: f64 = 0.35;
    for (socket, name) in table.names().into_iter().enumerate() {
        let visits = rows.iter().filter(|row| row.part == socket);
        let turns: Vec<_> = visits.map(|row| chain.forward(&row.joints_rad).rotation).collect();
        let most = largest_turn_rad(&turns);
        if turns.len() > 1 && most < TURN_MIN_RAD {
            inspection.suspect(format!(
                "socket `{name}` is visited with the flange turned by at most {:.0} degrees: tilt it further",
                most.to_degrees()
            ));
        }
    }
}

/// Largest angle between the first orientation and another one \[rad\]. It is computed by quaternions, because the arc
/// cosine of the trace of a matrix is often not a number at half a turn.
fn largest_turn_rad(orientations: &[Rotation3<f64>]) -> f64 {
    let mut turns = orientations.iter().map(UnitQuaternion::from_rotation_matrix);
    let Some(first) = turns.next() else { return 0.0 };
    turns.map(|turn| turn.angle_to(&first)).fold(0.0, f64::max)
}

/// Reports the distances between ball and socket with the nominal robot. The sockets are located by a fit to the rows.
fn closure(inspection: &mut Inspection, mut contact: Contact, chain: &Chain, rows: &[TipRow]) {
    /// Largest number of rounds. Locating the sockets (`place`) and rejecting rows (`screen`) depend on each other. Both are
    /// repeated until the rejected rows no longer change.
    const ROUNDS: usize = 4;
    let mut model = contact.fitted_out(Model::alone(chain));
    for _ in 0..ROUNDS {
        if !contact.place(&mut model, &[]).unwrap_or(false) {
            return;
        }
        if !contact.screen(&model) {
            break;
        }
    }
    let geometry = model.geometry(&[]);
    let errors = contact.errors(&geometry);
    let is_used = |row: usize| contact.rejected().iter().all(|rejected| rejected.row != row);
    let sizes =
        Sizes::from_values((0..errors.len()).filter(|row| is_used(*row)).map(|row| errors[row].position_m));
    inspection.fact(
        "nominal robot",
        format!("ball {:.2} mm (RMS) from its socket, {:.2} mm at most", sizes.rms * 1e3, sizes.max * 1e3),
    );
    for (row, remark) in contact.remarks(&geometry) {
        let off_mm = errors[row].position_m * 1e3;
        inspection.suspect(format!("line {}: the ball is off by {off_mm:.2} mm, {remark}", rows[row].line));
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{Matrix3, Vector3};

    use super::*;

    #[test]
    fn half_a_turn_is_one_with_rounding_errors_too() {
        let diagonal = Vector3::new(-1.0 - f64::EPSILON, -1.0, 1.0);
        let half = Rotation3::from_matrix_unchecked(Matrix3::from_diagonal(&diagonal));
        assert!((largest_turn_rad(&[Rotation3::identity(), half]) - PI).abs() < 1e-6);
    }
}
