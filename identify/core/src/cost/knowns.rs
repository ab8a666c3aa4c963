//! Rows, followed by the known properties of an instrument's parts as additional samples.

use super::{CostError, DataSet, LoopProblem, Residual};
use crate::instrument::Knowns;
use crate::model::{Model, Observation, RobotMotion};
use crate::solver::{Linearisation, Prior, Problem};

/// Rows with their residual, followed by known properties of the instrument.
#[derive(Debug)]
pub struct BesideKnowns<'a, R, M, K> {
    rows: LoopProblem<'a, R, M>,
    known: &'a K,
}

impl<'a, R: Residual, M: RobotMotion, K: Knowns> BesideKnowns<'a, R, M, K> {
    /// `sigma` is the standard deviation of a row's residual; known properties have their own.
    ///
    /// # Errors
    /// [`CostError`].
    pub fn new(
        model: &'a Model,
        motion: &'a M,
        observations: &'a [Observation],
        residual: R,
        known: &'a K,
        sigma: f64,
    ) -> Result<Self, CostError> {
        Ok(Self { rows: LoopProblem::new(model, motion, observations, residual, sigma)?, known })
    }
}

impl<R: Residual, M: RobotMotion, K: Knowns> DataSet for BesideKnowns<'_, R, M, K> {
    fn at_into<'a>(&'a self, x: &[f64], columns: &'a [usize]) -> Linearisation<'a> {
        let geometry = self.rows.model().geometry(x);
        let mut rows = self.rows.linearised(geometry.clone(), columns);
        Box::new(move |sample, residual, block| {
            let Some(known) = sample.checked_sub(self.rows.samples()) else {
                return rows(sample, residual, block);
            };
            let Some((value, derivative)) = self.known.known(known, &geometry) else { return false };
            residual.copy_from_slice(value.as_slice());
            for (&column, id) in columns.iter().zip(self.rows.ids()) {
                let Some(by) = self.known.column(*id) else { continue };
                let by = derivative.column(by);
                block.column_mut(column).iter_mut().zip(by.iter()).for_each(|(to, by)| *to = *by);
            }
            true
        })
    }
}

impl<R: Residual, M: RobotMotion, K: Knowns> Problem for BesideKnowns<'_, R, M, K> {
    fn columns(&self) -> usize {
        self.rows.columns()
    }

    fn column_name(&self, column: usize) -> String {
        self.rows.column_name(column)
    }

    fn samples(&self) -> usize {
        self.rows.samples() + self.known.knowns()
    }

    fn rows(&self) -> usize {
        self.rows.rows()
    }

    fn rows_of(&self, sample: usize) -> usize {
        sample.checked_sub(self.rows.samples()).map_or(self.rows(), |known| self.known.rows_of(known))
    }

    fn is_known(&self, sample: usize) -> bool {
        sample >= self.rows.samples()
    }

    fn priors(&self) -> &[Prior] {
        self.rows.priors()
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        self.at_into(x, self.rows.own_columns())
    }
}
