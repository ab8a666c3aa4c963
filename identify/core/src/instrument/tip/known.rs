//! Prior knowledge of an instrument's parts, such as distances of sockets: additional samples in the fit
//! ([`crate::cost::LoopProblem::with_knowns`]), and a test whether the other samples contradict it.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::model::{Geometry, ParameterId, Unit};

/// Probability of a false alarm for a correct table.
const CONTRADICTED_BY_CHANCE: f64 = 1e-3;

/// Largest distance \[mm\]: a larger one has a wrong unit.
pub(super) const SPAN_MM_MAX: f64 = 20_000.0;

/// Known lengths, places and angles.
pub trait Knowns: fmt::Debug + Sync {
    /// Number of known quantities.
    fn knowns(&self) -> usize;

    /// Number of residuals of one known quantity.
    fn rows_of(&self, known: usize) -> usize;

    /// Name in messages, such as `the distance between faces ...`.
    fn name_of(&self, known: usize) -> String;

    /// Standard uncertainty of one, in SI units, and its unit.
    fn sigma_of(&self, known: usize) -> (f64, Unit);

    /// Estimated minus known value, in standard deviations, and its derivatives by the columns of [`Knowns::column`]; `None`
    /// for a part that the geometry lacks.
    fn known(&self, known: usize, geometry: &Geometry) -> Option<(DVector<f64>, DMatrix<f64>)>;

    /// Column of a parameter in these derivatives.
    fn column(&self, id: ParameterId) -> Option<usize>;

    /// Known quantities that the estimated geometry contradicts.
    ///
    /// Chi-squared test of each, with a probability of [`CONTRADICTED_BY_CHANCE`] for all together. The estimates are
    /// constrained to the known values, so the test is conservative.
    fn contradicted(&self, geometry: &Geometry) -> Vec<Contradiction> {
        let chance = CONTRADICTED_BY_CHANCE / self.knowns().max(1) as f64;
        let contradiction = |known: usize| {
            let (residual, _) = self.known(known, geometry)?;
            let distribution = ChiSquared::new(residual.len() as f64).ok()?;
            let (sigma, unit) = self.sigma_of(known);
            let contradicted = distribution.sf(residual.norm_squared()) < chance;
            let off = residual.norm() * sigma;
            contradicted.then(|| Contradiction { name: self.name_of(known), off, sigma, unit })
        };
        (0..self.knowns()).filter_map(contradiction).collect()
    }
}

/// A known length, position or angle that the samples contradict.
#[derive(Debug, Clone, PartialEq)]
pub struct Contradiction {
    /// Name of the quantity in messages.
    pub name: String,
    /// Difference between estimated and known value, SI.
    pub off: f64,
    /// Its standard uncertainty, SI.
    pub sigma: f64,
    /// Unit of `off` and `sigma`.
    pub unit: Unit,
}

impl fmt::Display for Contradiction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, off, sigma, unit } = self;
        let (factor, symbol) = (unit.display_factor(), unit.display_symbol());
        write!(f, "{name} by {:.3} {symbol} (expected within {:.3})", off * factor, sigma * factor)
    }
}
