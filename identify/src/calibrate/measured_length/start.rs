//! A first anchor without a first guess.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{LengthError, LengthRow};
use crate::kinematics::Chain;

/// Anchor of a wire attached near the flange's origin, by a linear fit of a sphere's centre.
///
/// `|p - c|^2 = l^2` is linear in `c` and `|c|^2 - offset terms`: `2 p.c - k = |p|^2 - l^2`.
pub(super) fn anchor_by_sphere(
    robot: &Chain,
    rows: &[LengthRow],
    chosen: &[usize],
) -> Result<Vector3<f64>, LengthError> {
    /// Singular values below this part of the largest mean that the positions do not span space.
    const FLATNESS: f64 = 1e-6;
    let chosen: Vec<&LengthRow> = chosen.iter().filter_map(|&row| rows.get(row)).collect();
    let positions: Vec<Vector3<f64>> =
        chosen.iter().map(|row| robot.forward(&row.joints_rad).translation.vector).collect();
    let matrix =
        DMatrix::from_fn(positions.len(), 4, |i, j| if j < 3 { 2.0 * positions[i][j] } else { -1.0 });
    let right = DVector::from_iterator(
        positions.len(),
        positions.iter().zip(&chosen).map(|(p, row)| p.norm_squared() - row.length_m.powi(2)),
    );
    let svd = matrix.svd(true, true);
    let (largest, smallest) = (svd.singular_values.max(), svd.singular_values.min());
    if smallest <= FLATNESS * largest {
        return Err(LengthError::NoAnchor);
    }
    let solution = svd.solve(&right, 0.0).map_err(|_| LengthError::NoAnchor)?;
    Ok(solution.fixed_rows::<3>(0).into())
}
