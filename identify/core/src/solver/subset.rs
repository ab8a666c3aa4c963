//! A part of a problem's samples as a problem of its own.

use super::{Block, Prior, Problem};

/// Some samples of a problem, with all of its columns and priors.
#[derive(Debug)]
pub struct Subset<'a, P> {
    /// The whole.
    pub of: &'a P,
    /// Numbers of its samples, in the order in which they come here.
    pub samples: Vec<usize>,
}

impl<P: Problem> Problem for Subset<'_, P> {
    type Point = P::Point;

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

    fn point(&self, x: &[f64]) -> P::Point {
        self.of.point(x)
    }

    fn sample(
        &self,
        point: &mut P::Point,
        sample: usize,
        residual: &mut [f64],
        block: &mut Block<'_>,
    ) -> bool {
        self.samples.get(sample).is_some_and(|&sample| self.of.sample(point, sample, residual, block))
    }
}
