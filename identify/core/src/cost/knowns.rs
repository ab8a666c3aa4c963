//! Rows of sockets or faces as samples, followed by one sample for each known property of the instrument ([`Knowns`], such as
//! the distance between two sockets). A property has its own standard deviation, and derivatives by its own parameters.

use super::{CostError, DataSet, LoopProblem, Residual};
use crate::instrument::Knowns;
use crate::model::{Model, Observation, RobotMotion};
use crate::solver::{Linearisation, Prior, Problem};

/// Rows with their residual, followed by known properties of the instrument.
#[derive(Debug)]
pub struct BesideKnowns<'a, R, M, K> {
    rows: LoopProblem<'a, R, M>,
    knowns: &'a K,
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
        knowns: &'a K,
        sigma: f64,
    ) -> Result<Self, CostError> {
        Ok(Self { rows: LoopProblem::new(model, motion, observations, residual, sigma)?, knowns })
    }
}

impl<R: Residual, M: RobotMotion, K: Knowns> DataSet for BesideKnowns<'_, R, M, K> {
    fn at_into<'a>(&'a self, x: &[f64], columns: &'a [usize]) -> Linearisation<'a> {
        let geometry = self.rows.model().geometry(x);
        let mut linearise_row = self.rows.linearised(geometry.clone(), columns);
        Box::new(move |sample, residual, block| {
            let Some(known) = sample.checked_sub(self.rows.samples()) else {
                return linearise_row(sample, residual, block);
            };
            let Some((value, derivatives)) = self.knowns.known(known, &geometry) else { return false };
            residual.copy_from_slice(value.as_slice());
            for (&column, id) in columns.iter().zip(self.rows.ids()) {
                let Some(known_column) = self.knowns.column(*id) else { continue };
                let derivative = derivatives.column(known_column);
                block.column_mut(column).iter_mut().zip(derivative.iter()).for_each(|(to, from)| *to = *from);
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
        self.rows.samples() + self.knowns.knowns()
    }

    fn rows(&self) -> usize {
        self.rows.rows()
    }

    fn rows_of(&self, sample: usize) -> usize {
        sample.checked_sub(self.rows.samples()).map_or(self.rows(), |known| self.knowns.rows_of(known))
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
