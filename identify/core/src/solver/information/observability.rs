//! The five observability indices. Each is a number that describes how well a set of poses determines the parameters.
//!
//! Names and formulas are those of Sun and Hollerbach, "Observability index selection for robot calibration" (ICRA 2008).
//! `s1 >= .. >= sL` are the singular values of the Jacobian over `m` poses and `L` parameters. Larger is better. All indices
//! depend on units, so the columns are first scaled by given units, such as one millimetre for lengths.

use std::fmt;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

/// O1 to O5. All are zero if a parameter is not determined.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Observability {
    /// `(s1 s2 .. sL)^(1/L) / sqrt(m)`, from the volume of the ellipsoid of the Jacobian. Poses that maximise it are
    /// D-optimal (Borm and Menq 1991).
    pub o1: f64,
    /// `sL / s1`: the inverse condition number (Driels and Pathre 1990).
    pub o2: f64,
    /// `sL`: information about the weakest direction. Poses that maximise it are E-optimal (Nahvi,
    /// Hollerbach and Hayward 1994).
    pub o3: f64,
    /// `sL^2 / s1`: the noise amplification index (Nahvi and Hollerbach 1996).
    pub o4: f64,
    /// `1 / (1/s1 + .. + 1/sL)`: close to A-optimal (Sun and Hollerbach 2008).
    pub o5: f64,
}

impl fmt::Display for Observability {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { o1, o2, o3, o4, o5 } = self;
        write!(f, "O1 {o1:.2e}  O2 {o2:.2e}  O3 {o3:.2e}  O4 {o4:.2e}  O5 {o5:.2e}")
    }
}

impl Observability {
    /// Computes the indices. `triangle` is a matrix with the singular values of the Jacobian, such as its triangular factor.
    /// Its columns are multiplied by `scales`, one for each column.
    ///
    /// If a singular value is at most `tolerance` times the largest, a parameter is not determined and all indices are zero.
    pub fn new(triangle: &DMatrix<f64>, scales: &[f64], poses: usize, tolerance: f64) -> Self {
        let mut scaled = triangle.clone();
        for (mut column, scale) in scaled.column_iter_mut().zip(scales) {
            column *= *scale;
        }
        let columns = scaled.ncols();
        let values = scaled.singular_values();
        let (first, last) = (values.max(), values.min());
        if values.len() < columns
            || columns == 0
            || last.partial_cmp(&(tolerance * first)).is_none_or(|o| o.is_le())
        {
            return Self::default();
        }
        let mean_logarithm = values.iter().map(|s| s.ln()).sum::<f64>() / columns as f64;
        Self {
            o1: mean_logarithm.exp() / (poses as f64).sqrt(),
            o2: last / first,
            o3: last,
            o4: last * last / first,
            o5: values.iter().map(|s| s.recip()).sum::<f64>().recip(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_indices_of_known_singular_values() {
        // A rotation makes the triangle differ from a diagonal matrix of singular values. The scales undo the
        // factors of the columns.
        let turn = DMatrix::from_row_slice(2, 2, &[0.6, -0.8, 0.8, 0.6]);
        let triangle = turn * DMatrix::from_row_slice(2, 2, &[8.0, 0.0, 0.0, 1.0]);
        let found = Observability::new(&triangle, &[1.0, 2.0], 4, 1e-6);
        let expected = Observability { o1: 2.0, o2: 0.25, o3: 2.0, o4: 0.5, o5: 1.6 };
        for (found, expected) in [
            (found.o1, expected.o1),
            (found.o2, expected.o2),
            (found.o3, expected.o3),
            (found.o4, expected.o4),
            (found.o5, expected.o5),
        ] {
            assert!((found - expected).abs() < 1e-12, "{found} instead of {expected}");
        }
    }

    #[test]
    fn nothing_is_observable_where_one_direction_is_not() {
        let triangle = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1e-9]);
        assert_eq!(Observability::new(&triangle, &[1.0, 1.0], 9, 1e-6), Observability::default());
        assert_eq!(Observability::new(&DMatrix::zeros(1, 2), &[1.0, 1.0], 1, 1e-6), Observability::default());
    }
}
