//! Finds groups of dependent parameters from a sparse basis of the Jacobian's null space.
//! `identifiability` reports these groups.
//!
//! In an orthonormal basis, usually all entries are nonzero. This module converts the basis to vectors that are zero at
//! the pivots of the other vectors. The pivots are chosen so that a direction with many parameters, such as a common scale
//! of all lengths, becomes a vector of its own. The other vectors then become sparse. For example, one has two nonzero
//! entries if only the sum of two parameters is determined. The support of a vector is the set of columns with nonzero
//! entries; overlapping supports are merged to groups.

use nalgebra::DMatrix;

use crate::solver::DependentGroup;
use crate::statistics::largest_size;

/// Entries below this fraction of the largest entry of their vector count as zero.
const ENTRY_TOLERANCE: f64 = 1e-4;

/// Groups of dependent columns, from an orthonormal null basis of the column-scaled Jacobian. The basis has one column for
/// each vector; `zero_columns` of the Jacobian belong to no group.
pub(in crate::solver) fn dependent_groups(
    null_basis: &DMatrix<f64>,
    zero_columns: &[usize],
) -> Vec<DependentGroup> {
    let mut basis = null_basis.clone();
    for &column in zero_columns {
        basis.row_mut(column).fill(0.0);
    }
    let mut supports: Vec<Vec<usize>> = sparse_basis(basis).iter().map(|vector| support(vector)).collect();
    supports.retain(|members| !members.is_empty());
    supports.sort_by_key(Vec::len);
    let mut groups = merge_overlapping(supports);
    // The order follows the column indices, so that small numerical differences do not change it.
    groups.sort_by(|a, b| (a.columns.len(), &a.columns).cmp(&(b.columns.len(), &b.columns)));
    groups
}

/// Merges supports to groups. A support that overlaps exactly one group extends this group. A support that overlaps no group
/// or several groups becomes a group of its own.
fn merge_overlapping(supports: Vec<Vec<usize>>) -> Vec<DependentGroup> {
    let mut groups: Vec<DependentGroup> = Vec::new();
    for members in supports {
        let mut overlapping =
            groups.iter_mut().filter(|group| members.iter().any(|m| group.columns.contains(m)));
        match (overlapping.next(), overlapping.next()) {
            (Some(group), None) => {
                group.columns.extend(members);
                group.columns.sort_unstable();
                group.columns.dedup();
                group.excess += 1;
            }
            _ => groups.push(DependentGroup { columns: members, excess: 1 }),
        }
    }
    groups
}

/// Columns where a null vector is not zero.
fn support(vector: &[f64]) -> Vec<usize> {
    let largest = largest_size(vector);
    let is_nonzero = |v: &f64| v.abs() > ENTRY_TOLERANCE * largest;
    vector.iter().enumerate().filter(|(_, v)| is_nonzero(v)).map(|(column, _)| column).collect()
}

/// Basis of the same null space, in which each vector is zero at the pivots of the other vectors.
fn sparse_basis(mut basis: DMatrix<f64>) -> Vec<Vec<f64>> {
    let full = basis.clone();
    let mut pivots = Vec::new();
    while basis.ncols() > 0 {
        let Some(pivot) = next_pivot(&basis) else { break };
        pivots.push(pivot);
        basis = vanishing_at(&basis, pivot);
    }
    if pivots.is_empty() {
        return Vec::new();
    }
    // With these coefficients a vector is one at its own pivot and zero at the other pivots.
    let at_pivots = full.select_rows(&pivots);
    let Some(inverse) = at_pivots.pseudo_inverse(1e-12).ok() else { return Vec::new() };
    let reduced = full * inverse;
    reduced.column_iter().map(|column| column.iter().copied().collect()).collect()
}

/// The row of `basis` with the largest number of parallel rows. The parameters of parallel rows share one null direction.
fn next_pivot(basis: &DMatrix<f64>) -> Option<usize> {
    let norms: Vec<f64> = basis.row_iter().map(|row| row.norm()).collect();
    let largest = norms.iter().copied().fold(0.0, f64::max);
    let nonzero: Vec<usize> =
        (0..basis.nrows()).filter(|&i| norms[i] > ENTRY_TOLERANCE * largest && largest > 1e-9).collect();
    let count_parallel = |i: usize| {
        let is_parallel = |j: &&usize| {
            let cosine = basis.row(i).dot(&basis.row(**j)) / (norms[i] * norms[**j]);
            cosine.abs() > 1.0 - 1e-6
        };
        nonzero.iter().filter(is_parallel).count()
    };
    // Among rows with the same number of parallel rows, the longest is the best conditioned pivot.
    nonzero
        .iter()
        .copied()
        .max_by(|&i, &j| count_parallel(i).cmp(&count_parallel(j)).then(norms[i].total_cmp(&norms[j])))
}

/// Orthonormal basis of the vectors in the span of `basis` that are zero at `pivot`.
fn vanishing_at(basis: &DMatrix<f64>, pivot: usize) -> DMatrix<f64> {
    // A reflection transforms the columns so that the pivot's row is zero except for its first entry. All
    // columns except the first are then zero at the pivot.
    let row = basis.row(pivot).transpose();
    let mut axis = row.clone();
    axis[0] += row.norm().copysign(row[0]);
    let scale = 2.0 / axis.norm_squared();
    let reflected = basis - (basis * &axis) * axis.transpose() * scale;
    reflected.remove_column(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Orthonormal basis of the span, mixed by a rotation.
    fn mixed(vectors: &[Vec<f64>]) -> DMatrix<f64> {
        let columns = vectors.len();
        let rows = vectors[0].len();
        let basis = DMatrix::from_fn(rows, columns, |i, j| vectors[j][i]);
        let q = basis.qr().q();
        let mix = DMatrix::from_fn(columns, columns, |i, j| ((3 * i + 5 * j + 1) as f64).sin()).qr().q();
        q * mix
    }

    #[test]
    fn a_scale_through_everything_does_not_hide_the_pairs() {
        // Parameters: 0 to 5 are lengths with a common scale. 0 and 5 are a pair, 1, 6 and 7 a triple, 8 and 9 a pair of
        // angles. 10 is alone.
        let scale = vec![1.0, 2.0, 0.5, 0.3, 0.7, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let pair = vec![1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let triple_a = vec![0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        let triple_b = vec![0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0];
        let angles = vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.6, 0.0];
        let groups = dependent_groups(&mixed(&[scale, pair, triple_a, triple_b, angles]), &[]);
        let find = |columns: &[usize]| groups.iter().find(|g| g.columns == columns).map(|g| g.excess);
        assert_eq!(find(&[0, 5]), Some(1));
        assert_eq!(find(&[1, 6, 7]), Some(2));
        assert_eq!(find(&[8, 9]), Some(1));
        assert_eq!(groups.len(), 4);
        assert!(groups[3].columns.contains(&2) && !groups[3].columns.contains(&10));
    }
}
