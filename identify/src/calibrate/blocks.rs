//! What the samples of each stretch of time say, linearised at a solution.
//!
//! A stretch's normal equations are enough to solve without it, to ask how well the rest predicts it, and to see how much
//! a solution leans on it; a hundred such solves cost less than one pass over the samples. Errors of gears and encoders
//! last for seconds, so stretches of several seconds are nearly independent where single samples are far from it.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::cross_validation::Normal;
use crate::solver::{Prior, Problem, Subset, stacked};

/// Samples whose Jacobian is held at a time.
const CHUNK: usize = 2000;

/// Normal equations of each block of samples at one point, with the loss' weights at that point.
#[derive(Debug, Clone)]
pub struct Blocks {
    blocks: Vec<NormalEquations>,
    total: NormalEquations,
    priors: Vec<Prior>,
    x: Vec<f64>,
}

/// Normal equations of weighted rows and the sum of their weights.
#[derive(Debug, Clone)]
struct NormalEquations {
    rows: f64,
    normal: Normal,
}

impl NormalEquations {
    fn zero(columns: usize) -> Self {
        Self { normal: Normal::zeros(columns), rows: 0.0 }
    }

    fn add(&mut self, other: &Self) {
        self.normal += &other.normal;
        self.rows += other.rows;
    }
}

fn normal_equations<P: Problem>(
    problem: &P,
    x: &[f64],
    weights: &[f64],
    samples: &[usize],
) -> Option<NormalEquations> {
    let weights: Vec<f64> =
        samples.iter().map(|sample| weights.get(*sample).copied()).collect::<Option<_>>()?;
    let (mut residual, mut jacobian) = stacked(&Subset { of: problem, samples: samples.to_vec() }, x)?;
    let rows = problem.rows().max(1);
    // Samples without a value have no rows; the solve gave them no weight.
    let present: Vec<f64> = if residual.len() == rows * weights.len() {
        weights
    } else {
        weights.iter().copied().filter(|weight| *weight > 0.0).collect()
    };
    if residual.len() != rows * present.len() {
        return None;
    }
    for (row, entry) in residual.iter_mut().enumerate() {
        *entry *= present[row / rows].sqrt();
    }
    for mut column in jacobian.column_iter_mut() {
        for (row, entry) in column.iter_mut().enumerate() {
            *entry *= present[row / rows].sqrt();
        }
    }
    let mut equations = NormalEquations::zero(problem.columns());
    equations.normal.add(&residual, &jacobian);
    equations.rows = present.iter().sum::<f64>() * rows as f64;
    Some(equations)
}

/// `count` stretches of nearly equal length in each run, of which `starts` gives the first samples and the total.
pub fn stretches(starts: &[usize], count: usize) -> Vec<Range<usize>> {
    let of_run = |run: &[usize]| {
        let (start, length) = (run[0], run[1] - run[0]);
        (0..count).map(move |i| start + i * length / count..start + (i + 1) * length / count)
    };
    starts.windows(2).flat_map(of_run).filter(|stretch| !stretch.is_empty()).collect()
}

impl Blocks {
    /// At `x`, with the weight of each sample; none where a block has no finite residual.
    pub fn new<P: Problem>(
        problem: &P,
        x: &[f64],
        weights: &[f64],
        stretches: &[Vec<usize>],
    ) -> Option<Self> {
        let mut total = NormalEquations::zero(problem.columns());
        let mut blocks = Vec::with_capacity(stretches.len());
        for stretch in stretches {
            let mut block = NormalEquations::zero(problem.columns());
            for chunk in stretch.chunks(CHUNK) {
                block.add(&normal_equations(problem, x, weights, chunk)?);
            }
            total.add(&block);
            blocks.push(block);
        }
        Some(Self { blocks, total, priors: problem.priors().to_vec(), x: x.to_vec() })
    }

    /// Mean squared residual of each block, predicted by a solution for `columns` from all other blocks; the other columns
    /// stay where they are. None where the others do not determine the columns.
    pub fn held_out(&self, columns: &[usize]) -> Option<Vec<f64>> {
        self.held_out_with(columns, &self.priors)
    }

    /// [`Self::held_out`] with other priors than the problem's.
    pub fn held_out_with(&self, columns: &[usize], priors: &[Prior]) -> Option<Vec<f64>> {
        let error = |block: &NormalEquations| {
            let step = self.step_without(block, columns, priors)?;
            Some(block.normal.after(&step) / block.rows.max(1.0))
        };
        self.blocks.iter().map(error).collect()
    }

    /// Priors of the problem.
    pub fn priors(&self) -> &[Prior] {
        &self.priors
    }

    /// Normal matrix and gradient of priors on some columns.
    fn prior_equations(&self, columns: &[usize], priors: &[Prior]) -> (DMatrix<f64>, DVector<f64>) {
        let mut normal = DMatrix::zeros(columns.len(), columns.len());
        let mut gradient = DVector::zeros(columns.len());
        for prior in priors {
            let Some(at) = columns.iter().position(|column| *column == prior.column) else { continue };
            let weight = prior.sigma.powi(-2);
            normal[(at, at)] += weight;
            gradient[at] += weight * (self.x[prior.column] - prior.value);
        }
        (normal, gradient)
    }

    /// From `x` to the minimum over `columns` without one block, zero in the others.
    fn step_without(
        &self,
        block: &NormalEquations,
        columns: &[usize],
        priors: &[Prior],
    ) -> Option<DVector<f64>> {
        let (mut normal, mut gradient) = self.prior_equations(columns, priors);
        for (i, &a) in columns.iter().enumerate() {
            gradient[i] += self.total.normal.gradient[a] - block.normal.gradient[a];
            for (j, &b) in columns.iter().enumerate() {
                normal[(i, j)] += self.total.normal.matrix[(a, b)] - block.normal.matrix[(a, b)];
            }
        }
        let short = -solved(normal, &gradient)?;
        let mut step = DVector::zeros(self.x.len());
        columns.iter().zip(short.iter()).for_each(|(&column, value)| step[column] = *value);
        Some(step)
    }

    /// Covariance of the solution `x` by the jackknife over blocks: how much it moves where one is left out. It holds
    /// whatever errors the residuals have within a block, as long as blocks are independent; what priors contribute is
    /// added. Approximately `H^-1 (sum g g') H^-1` (a sandwich, Liang and Zeger 1986) with the correction that a block
    /// pulls the solution towards itself (Bell and McCaffrey 2002, CR3). None with fewer than two blocks.
    pub fn jackknife(&self) -> Option<DMatrix<f64>> {
        let columns: Vec<usize> = (0..self.x.len()).collect();
        let count = self.blocks.len() as f64;
        let (prior, _) = self.prior_equations(&columns, &self.priors);
        let whole = &self.total.normal.matrix + &prior;
        if count < 2.0 {
            return None;
        }
        let mut covariance = DMatrix::zeros(columns.len(), columns.len());
        for block in &self.blocks {
            let moved = solved(&whole - &block.normal.matrix, &block.normal.gradient)?;
            covariance += &moved * moved.transpose() * ((count - 1.0) / count);
        }
        let through = solved_matrix(whole.clone(), &prior)?;
        let of_priors = solved_matrix(whole, &through.transpose())?;
        Some(covariance + of_priors)
    }
}

fn solved(normal: DMatrix<f64>, right: &DVector<f64>) -> Option<DVector<f64>> {
    let right = DMatrix::from_column_slice(right.len(), 1, right.as_slice());
    Some(solved_matrix(normal, &right)?.column(0).into_owned())
}

/// Cholesky with columns scaled to unit length: metres, radians and seconds in one matrix.
fn solved_matrix(mut normal: DMatrix<f64>, right: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let scale = normal.diagonal().map(|entry| if entry > 0.0 { entry.sqrt().recip() } else { 0.0 });
    let mut right = right.clone();
    for (i, mut row) in right.row_iter_mut().enumerate() {
        row *= scale[i];
    }
    for (j, mut column) in normal.column_iter_mut().enumerate() {
        column.component_mul_assign(&scale);
        column *= scale[j];
    }
    let mut solved = normal.cholesky()?.solve(&right);
    for (i, mut row) in solved.row_iter_mut().enumerate() {
        row *= scale[i];
    }
    Some(solved)
}
