//! Known quantities of an instrument's parts, such as distances between sockets. In the fit they are additional samples
//! ([`crate::cost::LoopProblem::with_knowns`]). [`Knowns::contradicted`] tests whether the measured samples contradict them.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::model::{Geometry, ParameterId, Unit};

/// Probability that at least one quantity is reported although the table is correct.
const CONTRADICTED_BY_CHANCE: f64 = 1e-3;

/// Maximum distance in a table \[mm\]. If a distance is larger, its unit is wrong.
pub(super) const SPAN_MM_MAX: f64 = 20_000.0;

/// Known lengths, positions and angles of the parts of an instrument.
pub trait Knowns: fmt::Debug + Sync {
    /// Number of known quantities.
    fn knowns(&self) -> usize;

    /// Number of residuals of a known quantity.
    fn rows_of(&self, known: usize) -> usize;

    /// Name in messages, such as `the distance between faces ...`.
    fn name_of(&self, known: usize) -> String;

    /// Standard uncertainty of a known quantity, in SI units, and the unit of the quantity.
    fn sigma_of(&self, known: usize) -> (f64, Unit);

    /// Residual of a known quantity: estimated minus known value, in standard deviations. Also the
    /// derivatives of the residual. [`Knowns::column`] assigns parameters to the columns of the derivatives.
    /// `None` if the geometry does not contain a part.
    fn known(&self, known: usize, geometry: &Geometry) -> Option<(DVector<f64>, DMatrix<f64>)>;

    /// Column of a parameter in the derivatives. `None` if the residuals do not depend on the parameter.
    fn column(&self, id: ParameterId) -> Option<usize>;

    /// Finds the known quantities that the estimated geometry contradicts.
    ///
    /// Each quantity is tested by chi-squared. [`CONTRADICTED_BY_CHANCE`] is the probability of a false report among all
    /// quantities together. The test is conservative, because the fit also uses the known values.
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
    /// Absolute difference between estimated and known value, SI.
    pub off: f64,
    /// Standard uncertainty of the known value, SI.
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
