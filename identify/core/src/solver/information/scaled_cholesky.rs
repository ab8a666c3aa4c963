//! The one factorisation of normal equations: columns in metres, radians and seconds are scaled to unit length first.

use nalgebra::linalg::Cholesky;
use nalgebra::{DMatrix, DVector, Dyn};

/// `S N S = L L^T`, where `S N S` has ones on its diagonal.
#[derive(Debug, Clone)]
pub struct ScaledCholesky {
    factor: Cholesky<f64, Dyn>,
    /// Diagonal of `S`; zero for a column that nothing determines, so that its solution is zero.
    scale: DVector<f64>,
}

impl ScaledCholesky {
    /// Of a symmetric matrix. None where its columns depend on each other; one that is zero does not count.
    pub fn new(normal: DMatrix<f64>) -> Option<Self> {
        let squared = normal.diagonal();
        Self::damped(normal, &squared, 0.0)
    }

    /// Of `N + lambda D`, columns scaled by the square root of the diagonal `D` (Marquardt 1963).
    pub fn damped(mut normal: DMatrix<f64>, squared: &DVector<f64>, lambda: f64) -> Option<Self> {
        let scale = squared.map(|squared| if squared > 0.0 { squared.sqrt().recip() } else { 0.0 });
        for (j, mut column) in normal.column_iter_mut().enumerate() {
            column.component_mul_assign(&scale);
            column *= scale[j];
            column[j] += if scale[j] > 0.0 { lambda } else { 1.0 };
        }
        Some(Self { factor: normal.cholesky()?, scale })
    }

    /// Every column is determined, by more than rounding: none is a combination of those before it but for a millionth part.
    pub fn is_complete(&self) -> bool {
        const APART_MIN: f64 = 1e-6;
        let apart = self.factor.l_dirty().diagonal();
        self.scale.iter().zip(&apart).all(|(scale, apart)| *scale > 0.0 && *apart > APART_MIN)
    }

    /// `N^-1 b`
    pub fn solve(&self, b: &DVector<f64>) -> DVector<f64> {
        self.factor.solve(&b.component_mul(&self.scale)).component_mul(&self.scale)
    }

    /// `ln det N` of the columns that something determines.
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
