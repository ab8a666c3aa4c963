//! What is known of an instrument's parts before anything is measured: samples of their own beside the rows.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::model::{Geometry, ParameterId, Unit};

/// Chance of a false alarm for a table that is right.
const CONTRADICTED_BY_CHANCE: f64 = 1e-3;

/// Known lengths, places and angles.
pub trait Knowns: fmt::Debug + Sync {
    /// How many there are.
    fn knowns(&self) -> usize;

    /// Numbers of one of them.
    fn rows_of(&self, known: usize) -> usize;

    /// Name in messages, such as `the distance between faces ...`.
    fn name_of(&self, known: usize) -> String;

    /// Its standard uncertainty, SI.
    fn sigma_of(&self, known: usize) -> (f64, Unit);

    /// Found minus known, in standard deviations, and its derivatives in the columns of [`Knowns::column`]; `None` for a part that
    /// the geometry lacks.
    fn known(&self, known: usize, geometry: &Geometry) -> Option<(DVector<f64>, DMatrix<f64>)>;

    /// The column of a parameter in these derivatives.
    fn column(&self, id: ParameterId) -> Option<usize>;

    /// What is known but contradicted by the geometry.
    ///
    /// The chi-squared test of each, at a chance of [`CONTRADICTED_BY_CHANCE`] for all: what is found is drawn to what is known,
    /// so that fewer are named that hold.
    fn contradicted(&self, geometry: &Geometry) -> Vec<Contradiction> {
        let chance = CONTRADICTED_BY_CHANCE / self.knowns().max(1) as f64;
        let one = |known: usize| {
            let (residual, _) = self.known(known, geometry)?;
            let squared = ChiSquared::new(residual.len() as f64).ok()?;
            let (sigma, unit) = self.sigma_of(known);
            let contradicted = squared.sf(residual.norm_squared()) < chance;
            let off = residual.norm() * sigma;
            contradicted.then(|| Contradiction { name: self.name_of(known), off, sigma, unit })
        };
        (0..self.knowns()).filter_map(one).collect()
    }
}

/// A known length, place or angle that samples contradict.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradiction {
    /// As messages call it.
    pub name: String,
    /// How far it is off, SI.
    pub off: f64,
    /// Its standard uncertainty, SI.
    pub sigma: f64,
    /// Unit of both.
    pub unit: Unit,
}

impl fmt::Display for Contradiction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, off, sigma, unit } = self;
        let (factor, symbol) = (unit.display_factor(), unit.display_symbol());
        write!(f, "{name} by {:.3} {symbol} (expected within {:.3})", off * factor, sigma * factor)
    }
}
