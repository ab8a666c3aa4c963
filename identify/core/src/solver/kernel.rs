//! The inner loops of a solve: products of columns, Householder reflections, and a test for finite numbers, all on a short
//! panel of rows. The crate `pulp` selects the widest SIMD instructions of the processor at run time. A binary for any
//! x86-64 therefore uses AVX2 and FMA where available.
//!
//! A panel is column-major: column `c` begins at index `c * stride`.
//!
//! ```text
//!              column 0   column 1   column 2
//! row 0        [0]        [stride]   [2 * stride]   \
//! row 1        [1]        ..         ..             |  `rows`, a multiple of ROW_STEP; the last of these rows
//! ..           ..         ..         ..             |  can be padding, filled with zeros
//! row rows-1   ..         ..         ..             /
//! ..           ..         ..         ..             rows not in use, up to `stride`
//! ```

use pulp::{Arch, Simd, WithSimd};

/// The number of rows of a panel is a multiple of this number. The widest SIMD register (AVX-512)
/// contains this many numbers.
pub(super) const ROW_STEP: usize = 8;

/// The number of columns for [`add_products`] is a multiple of this number.
pub(super) const COLUMN_STEP: usize = TILE;

/// Products are computed in square tiles of this many columns. A tile contains the dot products of the columns `x0 x1 x2`
/// with the columns `y0 y1 y2`:
///
/// ```text
///          x0      x1      x2
/// y0    x0.y0   x1.y0   x2.y0
/// y1    x0.y1   x1.y1   x2.y1
/// y2    x0.y2   x1.y2   x2.y2
/// ```
///
/// The nine sums stay in registers, and each loaded number is used three times.
const TILE: usize = 3;

/// A column with a smaller sum of squares is treated as zero. Otherwise the division by the squared length of `v` in
/// the reflection could overflow.
const SQUARE_MIN: f64 = f64::MIN_POSITIVE / f64::EPSILON;

/// Dimensions of a column-major panel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shape {
    /// Distance between the starts of two columns.
    pub(super) stride: usize,
    /// Rows in use, a multiple of [`ROW_STEP`].
    pub(super) rows: usize,
    /// Number of columns in use.
    pub(super) columns: usize,
}

/// Adds `panel^T panel` to `sums`, a column-major square matrix. Only the tiles on the diagonal of `sums` and below are
/// updated. The number of columns is a multiple of [`COLUMN_STEP`].
pub(super) fn add_products(panel: &[f64], shape: Shape, sums: &mut [f64]) {
    Arch::new().dispatch(AddProducts { panel, shape, sums });
}

struct AddProducts<'a> {
    panel: &'a [f64],
    shape: Shape,
    sums: &'a mut [f64],
}

impl WithSimd for AddProducts<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Shape { stride, rows, columns } = self.shape;
        let tile_columns = |first: usize| {
            let column = |i: usize| S::as_simd_f64s(&self.panel[(first + i) * stride..][..rows]).0;
            [column(0), column(1), column(2)]
        };
        for right in (0..columns).step_by(TILE) {
            let y = tile_columns(right);
            for left in (right..columns).step_by(TILE) {
                let products = tile_products(simd, tile_columns(left), y);
                for (j, products) in products.iter().enumerate() {
                    let sums = &mut self.sums[(right + j) * columns + left..][..TILE];
                    for (sum, product) in sums.iter_mut().zip(products) {
                        *sum += product;
                    }
                }
            }
        }
    }
}

/// The dot products of the columns `x` and `y`, which form a tile. Entry `[j][i]` is `x_i . y_j`.
#[inline(always)]
fn tile_products<S: Simd>(simd: S, x: [&[S::f64s]; TILE], y: [&[S::f64s]; TILE]) -> [[f64; TILE]; TILE] {
    let mut sums = [[simd.splat_f64s(0.0); TILE]; TILE];
    let ([x0, x1, x2], [y0, y1, y2]) = (x, y);
    for (((((&x0, &x1), &x2), &y0), &y1), &y2) in x0.iter().zip(x1).zip(x2).zip(y0).zip(y1).zip(y2) {
        let (x, y) = ([x0, x1, x2], [y0, y1, y2]);
        for j in 0..TILE {
            for i in 0..TILE {
                sums[j][i] = simd.mul_add_e_f64s(x[i], y[j], sums[j][i]);
            }
        }
    }
    let mut reduced = [[0.0; TILE]; TILE];
    for j in 0..TILE {
        for i in 0..TILE {
            reduced[j][i] = simd.reduce_sum_f64s(sums[j][i]);
        }
    }
    reduced
}

/// Replaces `triangle` (column-major, upper, square) by the triangular factor `R` of the stacked matrix `[triangle; panel]`,
/// by Householder reflections. `R^T R` increases by `panel^T panel`, although this product is never computed. The contents
/// of the panel are meaningless afterwards.
pub(super) fn fold_into_triangle(panel: &mut [f64], shape: Shape, triangle: &mut [f64]) {
    Arch::new().dispatch(FoldTriangle { panel, shape, triangle });
}

struct FoldTriangle<'a> {
    panel: &'a mut [f64],
    shape: Shape,
    triangle: &'a mut [f64],
}

impl WithSimd for FoldTriangle<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Shape { stride, rows, columns } = self.shape;
        for k in 0..columns {
            let (left, right) = self.panel.split_at_mut((k + 1) * stride);
            let x = S::as_simd_f64s(&left[k * stride..][..rows]).0;
            let squared = dot(simd, x, x);
            if squared < SQUARE_MIN {
                continue;
            }
            // Golub and Van Loan, algorithm 5.1.1. `pivot` is the diagonal entry of the triangle in column
            // `k`, and `x` is the panel's column `k`. The reflection `H = I - beta v v^T` with `v = (v1, x)`
            // maps `(pivot, x)` to `(reflected, 0)`.
            let pivot = self.triangle[k * columns + k];
            let reflected = -(pivot * pivot + squared).sqrt().copysign(pivot);
            let v1 = pivot - reflected;
            let beta = 2.0 / (v1 * v1 + squared);
            self.triangle[k * columns + k] = reflected;
            // Apply `H` to each of the following columns. `top` is the column's entry in row `k` of the triangle, `y` its
            // entries in the panel.
            for (j, column) in (k + 1..columns).zip(right.chunks_exact_mut(stride)) {
                let y = S::as_mut_simd_f64s(&mut column[..rows]).0;
                let top = &mut self.triangle[j * columns + k];
                let factor = beta * (v1 * *top + dot(simd, x, y));
                *top -= factor * v1;
                let minus_factor = simd.splat_f64s(-factor);
                for (y, &x) in y.iter_mut().zip(x) {
                    *y = simd.mul_add_e_f64s(minus_factor, x, *y);
                }
            }
        }
    }
}

/// Dot product. Uses four sums, so that consecutive additions do not depend on each other.
#[inline(always)]
fn dot<S: Simd>(simd: S, x: &[S::f64s], y: &[S::f64s]) -> f64 {
    const SUMS: usize = 4;
    let mut sums = [simd.splat_f64s(0.0); SUMS];
    let (x4, x1) = x.as_chunks::<SUMS>();
    let (y4, y1) = y.as_chunks::<SUMS>();
    for (x, y) in x4.iter().zip(y4) {
        for i in 0..SUMS {
            sums[i] = simd.mul_add_e_f64s(x[i], y[i], sums[i]);
        }
    }
    for (&x, &y) in x1.iter().zip(y1) {
        sums[0] = simd.mul_add_e_f64s(x, y, sums[0]);
    }
    let sum = simd.add_f64s(simd.add_f64s(sums[0], sums[1]), simd.add_f64s(sums[2], sums[3]));
    simd.reduce_sum_f64s(sum)
}

/// Whether every number in the rows and columns in use is finite.
pub(super) fn is_finite(panel: &[f64], shape: Shape) -> bool {
    Arch::new().dispatch(IsFinite { panel, shape })
}

struct IsFinite<'a> {
    panel: &'a [f64],
    shape: Shape,
}

impl WithSimd for IsFinite<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> bool {
        let zero = simd.splat_f64s(0.0);
        let mut sum = zero;
        for column in self.panel.chunks_exact(self.shape.stride).take(self.shape.columns) {
            for &value in S::as_simd_f64s(&column[..self.shape.rows]).0 {
                // The product with zero is zero for a finite number and NaN otherwise.
                sum = simd.mul_add_e_f64s(value, zero, sum);
            }
        }
        simd.reduce_sum_f64s(sum) == 0.0
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;

    const SHAPE: Shape = Shape { stride: 40, rows: 32, columns: 6 };

    fn panel(shift: f64) -> Vec<f64> {
        let value = |i: usize| if i % 40 < 32 { (1.3 * i as f64 + shift).sin() } else { f64::NAN };
        (0..SHAPE.stride * SHAPE.columns).map(value).collect()
    }

    fn matrix(panel: &[f64]) -> DMatrix<f64> {
        DMatrix::from_fn(SHAPE.rows, SHAPE.columns, |i, j| panel[j * SHAPE.stride + i])
    }

    #[test]
    fn products_are_those_of_the_matrices() {
        let mut sums = vec![1.0; 36];
        let panel = panel(0.3);
        add_products(&panel, SHAPE, &mut sums);
        let expected = matrix(&panel).tr_mul(&matrix(&panel));
        for j in 0..6 {
            for i in j..6 {
                assert!((sums[j * 6 + i] - 1.0 - expected[(i, j)]).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_triangle_has_the_products_of_all_panels_folded_into_it() {
        let mut triangle = vec![0.0; 36];
        let mut expected = DMatrix::zeros(6, 6);
        for k in 0..3 {
            let mut panel = panel(f64::from(k));
            expected += matrix(&panel).tr_mul(&matrix(&panel));
            fold_into_triangle(&mut panel, SHAPE, &mut triangle);
        }
        let triangle = DMatrix::from_column_slice(6, 6, &triangle);
        assert_eq!(triangle.lower_triangle().sum(), triangle.diagonal().sum());
        assert!((triangle.tr_mul(&triangle) - expected).amax() < 1e-12);
    }

    /// The squares of such small numbers underflow.
    #[test]
    fn numbers_next_to_nothing_leave_a_triangle_finite() {
        for size in [1e-140, 1e-155, 1e-162, 1e-200] {
            let mut triangle = vec![0.0; 36];
            let mut panel: Vec<f64> = panel(0.0).iter().map(|value| value * size).collect();
            fold_into_triangle(&mut panel, SHAPE, &mut triangle);
            assert!(triangle.iter().all(|entry| entry.is_finite()), "{size}");
        }
    }

    #[test]
    fn one_number_that_is_none_is_seen_in_the_rows_in_use_only() {
        let mut panel = panel(0.0);
        assert!(is_finite(&panel, SHAPE));
        for bad in [f64::NAN, f64::INFINITY] {
            panel[3 * SHAPE.stride + 17] = bad;
            assert!(!is_finite(&panel, SHAPE));
        }
    }
}
