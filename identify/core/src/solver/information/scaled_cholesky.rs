//! Cholesky factorisation of a normal matrix `N`. Parameters are in metres, radians and seconds, so the columns are scaled
//! to unit length first. Used for steps, covariances of folds, and tests. The rank is not determined here, but in
//! `identifiability`, from an orthogonal factorisation.

use nalgebra::linalg::Cholesky;
use nalgebra::{DMatrix, DVector, Dyn};

/// `S N S = L L^T`, where `S N S` has ones on its diagonal.
#[derive(Debug, Clone)]
pub struct ScaledCholesky {
    factor: Cholesky<f64, Dyn>,
    /// Diagonal of `S`. It is zero for a zero column, so that the solution is zero there too.
    scale: DVector<f64>,
}

impl ScaledCholesky {
    /// Factor of a symmetric matrix. `None` if its columns are linearly dependent; zero columns are ignored.
    pub fn new(normal: DMatrix<f64>) -> Option<Self> {
        let diagonal = normal.diagonal();
        Self::damped(normal, &diagonal, 0.0)
    }

    /// Factor of `N + lambda D`, with a diagonal matrix `D` (Marquardt 1963). Columns are scaled by the square roots of `D`.
    pub fn damped(mut normal: DMatrix<f64>, d: &DVector<f64>, lambda: f64) -> Option<Self> {
        let scale = d.map(|d| if d > 0.0 { d.sqrt().recip() } else { 0.0 });
        for (j, mut column) in normal.column_iter_mut().enumerate() {
            column.component_mul_assign(&scale);
            column *= scale[j];
            column[j] += if scale[j] > 0.0 { lambda } else { 1.0 };
        }
        Some(Self { factor: normal.cholesky()?, scale })
    }

    /// Whether every column is determined. A column is determined if at least a millionth of its length is
    /// independent of the columns before it.
    pub fn is_complete(&self) -> bool {
        const PIVOT_MIN: f64 = 1e-6;
        let pivots = self.factor.l_dirty().diagonal();
        self.scale.iter().zip(&pivots).all(|(scale, pivot)| *scale > 0.0 && *pivot > PIVOT_MIN)
    }

    /// `N^-1 b`
    pub fn solve(&self, b: &DVector<f64>) -> DVector<f64> {
        self.factor.solve(&b.component_mul(&self.scale)).component_mul(&self.scale)
    }

    /// `ln det N`, without the zero columns.
    pub fn log_determinant(&self) -> f64 {
        let log_scales = self.scale.iter().filter(|scale| **scale > 0.0).map(|scale| scale.ln()).sum::<f64>();
        let log_pivots = self.factor.l_dirty().diagonal().iter().map(|pivot| pivot.ln()).sum::<f64>();
        2.0 * (log_pivots - log_scales)
    }

    /// `N^-1`
    pub fn inverse(&self) -> DMatrix<f64> {
        let mut inverse = self.factor.inverse();
        for (j, mut column) in inverse.column_iter_mut().enumerate() {
            column.component_mul_assign(&self.scale);
            column *= self.scale[j];
        }
        inverse
    }
}
