//! Factorisation of normal equations, with columns in metres, radians and seconds scaled to unit length first.

use nalgebra::linalg::Cholesky;
use nalgebra::{DMatrix, DVector, Dyn};

/// `S N S = L L^T`, where `S N S` has ones on its diagonal.
#[derive(Debug, Clone)]
pub struct ScaledCholesky {
    factor: Cholesky<f64, Dyn>,
    /// Diagonal of `S`; zero for an undetermined column, whose solution is then zero.
    scale: DVector<f64>,
}

impl ScaledCholesky {
    /// Factor of a symmetric matrix. `None` if its columns are linearly dependent; zero columns are ignored.
    pub fn new(normal: DMatrix<f64>) -> Option<Self> {
        let squared = normal.diagonal();
        Self::damped(normal, &squared, 0.0)
    }

    /// Factor of `N + lambda D`, with columns scaled by the square root of the diagonal `D` (Marquardt 1963).
    pub fn damped(mut normal: DMatrix<f64>, squared: &DVector<f64>, lambda: f64) -> Option<Self> {
        let scale = squared.map(|squared| if squared > 0.0 { squared.sqrt().recip() } else { 0.0 });
        for (j, mut column) in normal.column_iter_mut().enumerate() {
            column.component_mul_assign(&scale);
            column *= scale[j];
            column[j] += if scale[j] > 0.0 { lambda } else { 1.0 };
        }
        Some(Self { factor: normal.cholesky()?, scale })
    }

    /// Whether every column is determined: each has a part of at least a millionth that is independent of the columns before
    /// it.
    pub fn is_complete(&self) -> bool {
        const APART_MIN: f64 = 1e-6;
        let apart = self.factor.l_dirty().diagonal();
        self.scale.iter().zip(&apart).all(|(scale, apart)| *scale > 0.0 && *apart > APART_MIN)
    }

    /// `N^-1 b`
    pub fn solve(&self, b: &DVector<f64>) -> DVector<f64> {
        self.factor.solve(&b.component_mul(&self.scale)).component_mul(&self.scale)
    }

    /// `ln det N` of the columns that are not zero.
    pub fn log_determinant(&self) -> f64 {
        let of_scale = self.scale.iter().filter(|scale| **scale > 0.0).map(|scale| scale.ln()).sum::<f64>();
        2.0 * (self.factor.l_dirty().diagonal().iter().map(|pivot| pivot.ln()).sum::<f64>() - of_scale)
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
