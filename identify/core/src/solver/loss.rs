//! Robust losses. A loss `rho(s)` is a function of the squared residual norm `s = |r|^2` of a sample. Its derivative
//! `rho'(s)` is the weight of the sample in iteratively reweighted least squares. The module `robust` estimates the
//! scales of losses, and `pass` applies the weights.

use serde::{Deserialize, Serialize};

/// Robust loss, which reduces the weight of samples with large residuals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum LossName {
    /// Least squares: every sample keeps its full weight.
    None,
    /// Beyond a limit the influence of a residual stays constant; for few outliers.
    Huber,
    /// Beyond a limit the influence of a residual decreases.
    Cauchy,
    /// The influence of a gross outlier is almost zero; for many outliers.
    GemanMcclure,
}

/// Quantile of the squared norm of `n = rows` independent standard normal variables: `n (1 - v + z sqrt(v))^3` with
/// `v = 2 / (9 n)`. `z` is the standard normal quantile of the same probability (Wilson and Hilferty 1931).
pub(super) fn squared_norm_quantile(rows: usize, z: f64) -> f64 {
    let n = rows as f64;
    let v = 2.0 / (9.0 * n);
    n * (1.0 - v + z * v.sqrt()).powi(3)
}

/// Standard normal quantile of 0.99. If the scale of a loss is computed from this quantile, one in a hundred
/// samples that are not outliers is beyond the scale.
pub(super) const CLEAN_QUANTILE: f64 = 2.326;

/// Loss of a sample: the contribution of its squared residual norm `s` to the cost. The scale `c` is a norm in
/// the residual's (whitened) unit:
///
/// - `huber` is quadratic in the norm up to `c`, and linear beyond (Huber 1964).
/// - `cauchy` is `c^2 ln(1 + s / c^2)`.
/// - `geman_mcclure` is `c^2 s / (c^2 + s)`. It is bounded, so a gross outlier has almost no weight
///   (Geman and McClure 1985).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Loss {
    /// Formula of the loss.
    pub name: LossName,
    /// The scale `c`. Plain least squares ignore it.
    pub scale: f64,
}

impl Loss {
    /// Least squares without a robust loss.
    pub const SQUARED: Self = Self { name: LossName::None, scale: 1.0 };

    /// The loss `rho(s)`. It is approximately `s` for small `s`.
    pub fn rho(self, s: f64) -> f64 {
        let squared = self.scale * self.scale;
        match self.name {
            LossName::None => s,
            LossName::Huber if s <= squared => s,
            LossName::Huber => 2.0 * self.scale * s.sqrt() - squared,
            LossName::Cauchy => squared * (s / squared).ln_1p(),
            LossName::GemanMcclure => squared * s / (squared + s),
        }
    }

    /// The derivative `rho'(s)`, which is the weight in iteratively reweighted least squares. It is one at zero.
    pub fn weight(self, s: f64) -> f64 {
        let squared = self.scale * self.scale;
        match self.name {
            LossName::None => 1.0,
            LossName::Huber if s <= squared => 1.0,
            LossName::Huber => self.scale / s.sqrt(),
            LossName::Cauchy => 1.0 / (1.0 + s / squared),
            LossName::GemanMcclure => (squared / (squared + s)).powi(2),
        }
    }

    /// Converts the scale of this loss from samples with `usual` residuals to samples with `rows` residuals. The fraction of
    /// non-outlier samples beyond the scale stays equal.
    pub(super) fn of_rows(self, rows: usize, usual: usize) -> Self {
        let [rows, usual] = [rows, usual].map(|rows| squared_norm_quantile(rows, CLEAN_QUANTILE));
        Self { scale: self.scale * (rows / usual).sqrt(), ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_slopes_of_the_losses_and_all_start_as_least_squares() {
        let losses = [
            (LossName::None, 1.0),
            (LossName::Huber, 1.3),
            (LossName::Cauchy, 0.7),
            (LossName::GemanMcclure, 2.0),
        ];
        for (name, scale) in losses {
            let loss = Loss { name, scale };
            assert_eq!(loss.weight(0.0), 1.0);
            for s in [0.01, 0.5, 3.0, 40.0] {
                let h = 1e-6 * s;
                let slope = (loss.rho(s + h) - loss.rho(s - h)) / (2.0 * h);
                assert!((slope - loss.weight(s)).abs() < 1e-7, "{loss:?} at {s}");
            }
        }
    }
}
