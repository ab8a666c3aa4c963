//! Known quantities of an instrument's parts, such as distances between sockets. In the fit they are additional samples
//! ([`crate::cost::LoopProblem::with_knowns`]). [`Knowns::contradicted`] tests whether the measured samples contradict them.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use shared::config::Violation;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::model::{Geometry, ParameterId, Unit};

/// Probability that at least one quantity is reported although the table is correct.
const CONTRADICTED_BY_CHANCE: f64 = 1e-3;

/// Maximum distance in a table \[mm\]. If a distance is larger, its unit is wrong.
pub(super) const SPAN_MM_MAX: f64 = 20_000.0;

/// Refuses two blocks of a table for the same pair of parts, in any order. Their values would count as independent. `block`
/// is the name of the blocks, and `pairs` contains their keys `between`.
pub(super) fn ensure_pairs_differ<'a>(
    block: &str,
    pairs: impl Iterator<Item = &'a [String; 2]>,
) -> Result<(), Violation> {
    let mut before: Vec<[&String; 2]> = Vec::new();
    for (i, [first, second]) in pairs.enumerate() {
        let same = before.iter().position(|pair| [[first, second], [second, first]].contains(pair));
        if let Some(earlier) = same {
            let problem = format!("`{first}` and `{second}` are also in {block}[{earlier}]");
            let key = format!("{block}[{i}].between");
            return Err(Violation::new(key, problem, "keep one block for these two"));
        }
        before.push([first, second]);
    }
    Ok(())
}

/// Known lengths, positions and angles of the parts of an instrument.
pub trait Knowns: fmt::Debug + Sync {
    /// Number of known quantities.
    fn knowns(&self) -> usize;

    /// Number of residuals of a known quantity.
    fn rows_of(&self, known: usize) -> usize;

    /// A known quantity: its name in messages, such as `the distance between faces ...`, its standard uncertainty in SI
    /// units, and its unit. `None` if it does not exist.
    fn stated(&self, known: usize) -> Option<(String, f64, Unit)>;

    /// Residual of a known quantity: estimated minus known value, in standard deviations. Also the
    /// derivatives of the residual. [`Knowns::column`] assigns parameters to the columns of the derivatives.
    /// `None` if the geometry does not contain a part.
    fn known(&self, known: usize, geometry: &Geometry) -> Option<(DVector<f64>, DMatrix<f64>)>;

    /// Column of a parameter in the derivatives. `None` if the residuals do not depend on the parameter.
    fn column(&self, id: ParameterId) -> Option<usize>;

    /// Finds the known quantities that the estimated geometry contradicts. Returns the name of each quantity with its
    /// deviation and its uncertainty, as text for messages.
    ///
    /// Each quantity is tested by chi-squared. [`CONTRADICTED_BY_CHANCE`] is the probability of a false report among all
    /// quantities together. The test is conservative, because the fit also uses the known values.
    fn contradicted(&self, geometry: &Geometry) -> Vec<String> {
        let chance = CONTRADICTED_BY_CHANCE / self.knowns().max(1) as f64;
        let contradiction = |known: usize| {
            let (residual, _) = self.known(known, geometry)?;
            let distribution = ChiSquared::new(residual.len() as f64).ok()?;
            let (name, sigma, unit) = self.stated(known)?;
            let (factor, symbol) = (unit.display_factor(), unit.display_symbol());
            let (off, expected) = (residual.norm() * sigma * factor, sigma * factor);
            let contradicted = distribution.sf(residual.norm_squared()) < chance;
            contradicted.then(|| format!("{name} by {off:.3} {symbol} (expected within {expected:.3})"))
        };
        (0..self.knowns()).filter_map(contradiction).collect()
    }
}
