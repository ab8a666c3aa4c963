//! Poses with a measured length each: a draw-wire or a telescoping bar between robot and cell.

use nalgebra::Vector3;

use super::{RowError, Sizes, each_has_rows};
use crate::calibrate::pipeline::{Plan, estimate};
use crate::instrument::HoldOut;
use crate::instrument::SEED;
use crate::instrument::{Instrument, LengthRow, RejectedRow, Rejection, Run, Standing, Wire};
use crate::kinematics::Chain;
use crate::model::Model;
use crate::solver::LossName;
use crate::statistics::median_size;

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

/// Residuals of the lengths with the nominal robot, the wire fitted to it with a robust loss; none if the rows do not determine the
/// place of the wire.
pub fn wire_misfit(rows: &[LengthRow], robot: &Chain) -> Option<Sizes> {
    let at = Standing::of_file(rows, |row| row.joints_rad, robot, HoldOut::Rows, SEED);
    let wire = Wire::new(at);
    let model = wire.fitted_out(Model::measured_length(robot));
    let mut run = Run { instrument: Instrument::Wire(wire), model };
    run.instrument.place(&mut run.model, &[]).ok().filter(|placed| *placed)?;
    estimate(std::slice::from_mut(&mut run), &Plan::new(LossName::Huber, Vec::new())).ok()?;
    let errors = run.instrument.errors(&run.model.geometry(&[]));
    Some(Sizes::of(errors.iter().map(|error| error.position_m)))
}

/// Single rows are of another pose; where most contradict the robot's file, that is of another robot.
pub(super) fn of_this_robot(contradicting: &[RejectedRow], rows: usize) -> Result<(), RowError> {
    let rejected = contradicting.len();
    if 2 * rejected <= rows {
        return Ok(());
    }
    let distances_m = contradicting.iter().filter_map(|one| match one.why {
        Rejection::FlangeContradicts { distance_m } => Some(distance_m),
        _ => None,
    });
    Err(RowError::OtherRobot { rejected, rows, median_mm: median_size(distances_m) * 1e3 })
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
