//! Adapts a problem of this project to the crate `levenberg-marquardt`, which is a port of MINPACK's lmder.

use identify::solver::{LeastSquares, stacked};
use levenberg_marquardt::LeastSquaresProblem;
use nalgebra::storage::Owned;
use nalgebra::{DMatrix, DVector, Dyn};

pub struct Other<'a> {
    problem: &'a dyn LeastSquares,
    pub x: DVector<f64>,
    /// Residuals and Jacobian at the current point. They are stored, because that crate requests them separately.
    at_x: Option<(DVector<f64>, DMatrix<f64>)>,
}

impl<'a> Other<'a> {
    pub fn new(problem: &'a dyn LeastSquares, start: &[f64]) -> Self {
        Self { problem, x: DVector::from_column_slice(start), at_x: stacked(problem, start) }
    }
}

impl LeastSquaresProblem<f64, Dyn, Dyn> for Other<'_> {
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, Dyn>;
    type ParameterStorage = Owned<f64, Dyn>;

    fn set_params(&mut self, x: &DVector<f64>) {
        self.x.copy_from(x);
        self.at_x = stacked(self.problem, x.as_slice());
    }

    fn params(&self) -> DVector<f64> {
        self.x.clone()
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        self.at_x.as_ref().map(|(residual, _)| residual.clone())
    }

    fn jacobian(&self) -> Option<DMatrix<f64>> {
        self.at_x.as_ref().map(|(_, jacobian)| jacobian.clone())
    }
}
