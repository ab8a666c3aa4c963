//! Effect of an error in a fixed value on the estimated values. To first order it is `-J_e^+ J_h`, where `J_e` are the
//! columns of estimated parameters, `J_h` those of fixed parameters, and `+` is the pseudo-inverse. Used for
//! considered parameters and by `identify examine`.

use nalgebra::{DMatrix, DVector};

use super::identifiability::{Open, require_start, sample_triangle, with_priors};
use crate::solver::pass::Taking;
use crate::solver::{LeastSquares, Options, SolveError};

/// Sensitivity of estimates to fixed values, to first order.
#[derive(Debug, Clone, PartialEq)]
pub struct Influence {
    /// Names of the estimated columns.
    pub estimated: Vec<String>,
    /// Names of the fixed columns, called `held` throughout this file.
    pub held: Vec<String>,
    /// Change of the estimate per error of the fixed value, in the units of both parameters. One row for each estimate, one
    /// column for each fixed value.
    pub change: DMatrix<f64>,
}

/// Influence of the columns `held` of a problem on its other columns.
///
/// All columns are free in the problem. The estimates minimise `|J_e dx + J_h dh|`, so an error `dh` of the fixed values
/// changes them by `-J_e^+ J_h dh`. Samples have the weight of the robust loss at `x`, and priors of estimated columns are
/// included. The estimated columns must be identifiable when the columns `held` are fixed.
///
/// # Errors
/// [`SolveError`] if no sample has a value, or [`SolveError::Dependent`] if the estimated columns are linearly dependent.
pub fn influence(
    problem: &dyn LeastSquares,
    x: &[f64],
    held: &[usize],
    options: &Options<'_>,
) -> Result<Influence, SolveError> {
    require_start(problem, x)?;
    let (triangle, _) = sample_triangle(problem, x, options, Taking::WhatIsThere)
        .map_err(|error| error.at_start(problem.samples()))?;
    let estimated: Vec<usize> = (0..problem.columns()).filter(|column| !held.contains(column)).collect();
    let columns = estimated.iter().copied();
    let without_prior = Open::new(&triangle, columns, problem.priors(), options.rank_tolerance);
    if without_prior.missing() > 0 {
        return Err(SolveError::Dependent);
    }
    let priors = problem.priors().iter().filter(|prior| estimated.contains(&prior.column));
    let triangle = with_priors(priors, &triangle);
    let names = |columns: &[usize]| columns.iter().map(|&column| problem.column_name(column)).collect();
    let (j_e, j_h) = (triangle.select_columns(&estimated), triangle.select_columns(held));
    let change = -least_squares(&j_e, &j_h).ok_or(SolveError::Dependent)?;
    Ok(Influence { estimated: names(&estimated), held: names(held), change })
}

/// Minimises `|A X - B|` over `X`, using the singular values of the column-scaled matrix `A`. `None` if a column of `A` is
/// zero, if `A` has fewer rows than columns, or if a number is not finite.
fn least_squares(a: &DMatrix<f64>, b: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let lengths = DVector::from_iterator(a.ncols(), a.column_iter().map(|column| column.norm()));
    if a.nrows() < a.ncols() || !lengths.iter().all(|length| length.is_finite() && *length > 0.0) {
        return None;
    }
    let mut scaled = a.clone();
    scaled.column_iter_mut().zip(lengths.iter()).for_each(|(mut column, length)| column /= *length);
    let svd = scaled.svd(true, true);
    let mut solved = svd.solve(b, 0.0).ok()?;
    solved.row_iter_mut().zip(lengths.iter()).for_each(|(mut row, length)| row /= *length);
    Some(solved)
}
