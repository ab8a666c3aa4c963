//! Robust losses `rho(s)` of the squared residual norm `s = |r|^2` of a sample, and their weights `rho'(s)` for iteratively
//! reweighted least squares. Scales come from `robust`, weights are applied in each `pass`.

use serde::{Deserialize, Serialize};

/// Weight of samples that do not fit. Scales are such that one clean sample in a hundred is beyond them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum LossName {
    /// Every sample has its full weight.
    None,
    /// Beyond the scale the influence of a residual is constant: for few outliers.
    Huber,
    /// Beyond the scale the influence of a residual decreases.
    Cauchy,
    /// A gross outlier has no influence: for many outliers.
    GemanMcclure,
}

/// Quantile of the squared norm of `n = rows` standard normal variables, `n (1 - v + z sqrt(v))^3` with `v = 2 / (9 n)` and `z`
/// the quantile of one such variable (Wilson and Hilferty 1931).
pub(super) fn squared_norm_quantile(rows: usize, z: f64) -> f64 {
    let n = rows as f64;
    let v = 2.0 / (9.0 * n);
    n * (1.0 - v + z * v.sqrt()).powi(3)
}

/// Contribution of a sample's squared norm to the cost. Scales are in the residual's (whitened) unit.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Loss {
    /// Least squares without a robust loss.
    #[default]
    Squared,
    /// Quadratic up to `scale`, linear beyond (Huber 1964).
    Huber {
        /// Norm at which it becomes linear.
        scale: f64,
    },
    /// `c^2 ln(1 + s / c^2)`.
    Cauchy {
        /// The constant `c`, as a norm of the residual.
        scale: f64,
    },
    /// `c^2 s / (c^2 + s)`: bounded, so that a gross outlier has almost no weight (Geman and McClure 1985).
    GemanMcClure {
        /// The constant `c`, as a norm of the residual.
        scale: f64,
    },
}

impl Loss {
    /// `rho(s)`; equals `s` for small `s`.
    pub fn rho(self, s: f64) -> f64 {
        match self {
            Self::Squared => s,
            Self::Huber { scale } if s <= scale * scale => s,
            Self::Huber { scale } => 2.0 * scale * s.sqrt() - scale * scale,
            Self::Cauchy { scale } => scale * scale * (s / (scale * scale)).ln_1p(),
            Self::GemanMcClure { scale } => scale * scale * s / (scale * scale + s),
        }
    }

    /// `rho'(s)`, the weight of iteratively reweighted least squares; one at zero.
    pub fn weight(self, s: f64) -> f64 {
        match self {
            Self::Squared => 1.0,
            Self::Huber { scale } if s <= scale * scale => 1.0,
            Self::Huber { scale } => scale / s.sqrt(),
            Self::Cauchy { scale } => 1.0 / (1.0 + s / (scale * scale)),
            Self::GemanMcClure { scale } => (scale * scale / (scale * scale + s)).powi(2),
        }
    }

    /// The loss for samples of `rows` residuals if this one is for samples of `usual` residuals: the same part of clean samples
    /// is beyond its scale.
    pub(super) fn of_rows(self, rows: usize, usual: usize) -> Self {
        /// Standard normal quantile of 0.99, by which `robust` defines scales.
        const Z: f64 = 2.326;
        self.widened((squared_norm_quantile(rows, Z) / squared_norm_quantile(usual, Z)).sqrt())
    }

    /// The loss with its scale multiplied by `factor`.
    pub fn widened(self, factor: f64) -> Self {
        match self {
            Self::Squared => Self::Squared,
            Self::Huber { scale } => Self::Huber { scale: scale * factor },
            Self::Cauchy { scale } => Self::Cauchy { scale: scale * factor },
            Self::GemanMcClure { scale } => Self::GemanMcClure { scale: scale * factor },
        }
    }

    /// The scale; `None` for plain least squares.
    pub fn scale(self) -> Option<f64> {
        match self {
            Self::Squared => None,
            Self::Huber { scale } | Self::Cauchy { scale } | Self::GemanMcClure { scale } => Some(scale),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_slopes_of_the_losses_and_all_start_as_least_squares() {
        let losses = [
            Loss::Squared,
            Loss::Huber { scale: 1.3 },
            Loss::Cauchy { scale: 0.7 },
            Loss::GemanMcClure { scale: 2.0 },
        ];
        for loss in losses {
            assert_eq!(loss.weight(0.0), 1.0);
            for s in [0.01, 0.5, 3.0, 40.0] {
                let h = 1e-6 * s;
                let slope = (loss.rho(s + h) - loss.rho(s - h)) / (2.0 * h);
                assert!((slope - loss.weight(s)).abs() < 1e-7, "{loss:?} at {s}");
            }
        }
    }
}
