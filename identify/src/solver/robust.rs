//! Graduated robust solves: from a wide, nearly quadratic loss to the narrow one that is wanted.
//!
//! A narrow bounded loss has a minimum at every wrong start. Widening its scale until nothing is an outlier gives a
//! good start, and each narrowing keeps it (graduated non-convexity, Blake and Zisserman 1987; the schedule factor is
//! that of Yang, Antonante, Tzoumas, Carlone 2020).

use super::{Options, Problem, Solution, SolveError, minimise, solve};

/// How the loss is narrowed.
#[derive(Debug, Clone, Copy)]
pub struct GraduatedOptions<'a> {
    /// The solve, with the final loss.
    pub solve: Options<'a>,
    /// First scale in multiples of the final one.
    pub widening_start: f64,
    /// Division of the scale from solve to solve.
    pub narrowing: f64,
    /// Iterations of each solve before the last.
    pub iterations_between: usize,
}

impl<'a> GraduatedOptions<'a> {
    /// The usual schedule for a solve.
    pub fn new(solve: Options<'a>) -> Self {
        Self { solve, widening_start: 50.0, narrowing: 1.4, iterations_between: 5 }
    }
}

/// Solves with ever narrower losses; the outcome is that of the final loss. A plain squared loss is solved once.
///
/// # Errors
/// As [`solve`].
pub fn solve_graduated<P: Problem>(
    problem: &P,
    start: &[f64],
    options: &GraduatedOptions<'_>,
) -> Result<Solution, SolveError> {
    let mut x = start.to_vec();
    let mut widening = options.widening_start;
    while options.solve.loss.scale().is_some() && widening > 1.0 {
        let between = Options {
            loss: options.solve.loss.widened(widening),
            iterations_max: options.iterations_between,
            ..options.solve
        };
        x = minimise(problem, &x, &between)?.0;
        widening /= options.narrowing.max(1.01);
    }
    solve(problem, &x, &options.solve)
}
