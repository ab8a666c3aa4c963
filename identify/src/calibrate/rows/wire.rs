//! Poses with a measured length each: a draw-wire or a telescoping bar between robot and cell.

use nalgebra::Vector3;

use super::{RowError, each_has_rows};
use crate::instrument::{LengthRow, RejectedRow, Rejection};
use crate::kinematics::Chain;

/// Fewest rows of a fit: the seven unknowns of the wire and as many again.
pub(super) const ROWS_MIN: usize = 14;
/// Of each anchor, where there are several: its start is linear in four numbers, and a part is held out.
const ANCHOR_ROWS_MIN: usize = 8;
/// Of each place on the flange: its three numbers twice.
const ATTACHMENT_ROWS_MIN: usize = 6;

pub(super) fn check_rows(rows: &[LengthRow]) -> Result<(), RowError> {
    for (index, row) in rows.iter().enumerate() {
        let bad = |what| Err(RowError::BadRow { row: index + 1, what });
        if !row.joints_rad.iter().chain(row.flange_m.iter().flatten()).all(|v| v.is_finite()) {
            return bad("a number that is not finite");
        }
        if !(row.length_m.is_finite() && row.length_m > 0.0) {
            return bad("a length that is not above zero");
        }
    }
    let needed = [("anchor", ANCHOR_ROWS_MIN), ("attachment", ATTACHMENT_ROWS_MIN)];
    each_has_rows(rows.iter().map(|row| row.set_up), needed)
}

/// Rows whose controller position is not where their joint angles put the flange.
pub(super) fn contradicting(rows: &[LengthRow], robot: &Chain) -> Vec<RejectedRow> {
    /// Above what controllers round, and nominal links they know better \[m\].
    const TOLERANCE_M: f64 = 5e-3;
    let distance_m = |row: &LengthRow| {
        let claimed_m = row.flange_m.map(Vector3::from)?;
        Some((robot.forward(&row.joints_rad).translation.vector - claimed_m).norm())
    };
    let rejected = |(index, row): (usize, &LengthRow)| {
        let distance_m = distance_m(row).filter(|distance_m| *distance_m > TOLERANCE_M)?;
        Some(RejectedRow { row: index, why: Rejection::FlangeContradicts { distance_m } })
    };
    rows.iter().enumerate().filter_map(rejected).collect()
}
