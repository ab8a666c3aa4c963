//! A selection of a problem's samples as a problem of its own.

use super::{LeastSquares, Linearisation, Prior};

/// A problem with selected samples of another problem, and with all columns and priors of that problem.
pub struct Subset<'p> {
    /// The problem that contains the samples.
    pub of: &'p dyn LeastSquares,
    /// Indices of the selected samples in that problem, in the order of the subset.
    pub samples: Vec<usize>,
}

impl LeastSquares for Subset<'_> {
    fn columns(&self) -> usize {
        self.of.columns()
    }

    fn column_name(&self, column: usize) -> String {
        self.of.column_name(column)
    }

    fn samples(&self) -> usize {
        self.samples.len()
    }

    fn rows(&self) -> usize {
        self.of.rows()
    }

    fn rows_of(&self, sample: usize) -> usize {
        self.samples.get(sample).map_or(0, |&sample| self.of.rows_of(sample))
    }

    fn priors(&self) -> &[Prior] {
        self.of.priors()
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let mut whole = self.of.at(x);
        Box::new(move |sample, residual, block| {
            self.samples.get(sample).is_some_and(|&sample| whole(sample, residual, block))
        })
    }
}
