//! What a calibration by measured lengths found.

use super::figures::{ErrorFigures, Figures, pick};
use super::{Drift, FaultyRun, screen};
use crate::calibrate::split::Split;
use crate::model::{Model, ParameterId, Role};
use crate::solver::{Identifiability, Solution, Summary};

/// Why a row was rejected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rejection {
    /// Controller position and joint angles do not belong together.
    FlangeContradicts {
        /// Between the two positions \[m\].
        distance_m: f64,
    },
    /// The length is far from what all others say.
    GrossResidual {
        /// Predicted minus measured \[m\].
        residual_m: f64,
    },
    /// The rows around it are off together.
    FaultyRun {
        /// Median size of the residuals of neighbouring rows \[m\].
        median_m: f64,
    },
}

/// A row that did not take part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RejectedRow {
    /// Row from 0.
    pub row: usize,
    /// Why.
    pub why: Rejection,
}

/// One estimated parameter, SI.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterEstimate {
    /// Which.
    pub id: ParameterId,
    /// Data sheet; zero for the wire.
    pub nominal: f64,
    /// Found.
    pub value: f64,
    /// Standard deviation from lengths and priors.
    pub sigma: Option<f64>,
    /// Standard deviation of the prior; none for parameters found from lengths alone.
    pub prior_sigma: Option<f64>,
}

impl ParameterEstimate {
    /// Part of the prior's variance that the lengths removed: near 1 the data spoke, near 0 only the prior did.
    pub fn learned(&self) -> Option<f64> {
        Some(1.0 - (self.sigma? / self.prior_sigma?).powi(2).min(1.0))
    }
}

/// Outcome of a calibration by measured lengths.
#[derive(Debug, Clone, PartialEq)]
pub struct LengthReport {
    /// Rows that the fit saw, without rejected ones.
    pub fitted: Figures,
    /// Held-out rows, without those whose own data contradict each other and those in faulty runs.
    pub held_out: Figures,
    /// All held-out rows.
    pub held_out_with_rejected: Figures,
    /// The same by the robot alone, fitted without a drift.
    pub held_out_robot_alone: Figures,
    /// Drift of the instrument's zero, where left-out rows asked for it; the figures above are with it.
    pub drift: Option<Drift>,
    /// Rows that did not take part, and why.
    pub rejected: Vec<RejectedRow>,
    /// Faulty runs, with what would explain them.
    pub runs: Vec<FaultyRun>,
    /// Everything that was estimated.
    pub parameters: Vec<ParameterEstimate>,
    /// Standard deviation of a length that the solve assumed \[m\].
    pub length_sigma_m: f64,
    /// How the last solve went.
    pub summary: Summary,
    /// What lengths and priors determine.
    pub identifiability: Identifiability,
    /// The calibrated model.
    pub model: Model,
}

/// What the calibration hands over.
pub(super) struct Outcome {
    pub(super) model: Model,
    pub(super) solution: Solution,
    pub(super) before: Vec<f64>,
    pub(super) robot_alone: Vec<f64>,
    pub(super) after: Vec<f64>,
    pub(super) split: Split,
    pub(super) rejected: Vec<RejectedRow>,
    pub(super) runs: Vec<FaultyRun>,
    pub(super) sigma_m: f64,
    pub(super) drift: Option<Drift>,
}

pub(super) fn assemble(outcome: Outcome) -> LengthReport {
    let Outcome { model, solution, before, robot_alone, after, split, rejected, runs, sigma_m, drift } =
        outcome;
    let between = |after: &[f64], rows: &[usize]| Figures {
        before: ErrorFigures::of(&pick(&before, rows)),
        after: ErrorFigures::of(&pick(after, rows)),
    };
    let figures = |rows: &[usize]| between(&after, rows);
    let estimate = |(column, parameter): (usize, &crate::model::Parameter)| ParameterEstimate {
        id: parameter.id,
        nominal: parameter.nominal,
        value: parameter.value,
        sigma: solution.covariance.sigma(column),
        prior_sigma: match parameter.role {
            Role::Prior { sigma, .. } => Some(sigma),
            Role::Free | Role::Fixed => None,
        },
    };
    LengthReport {
        fitted: figures(&screen::without(&split.fitting, &rejected)),
        held_out: figures(&screen::without(&split.held_out, &rejected)),
        held_out_with_rejected: figures(&split.held_out),
        held_out_robot_alone: between(&robot_alone, &split.held_out),
        drift,
        parameters: model.columns().enumerate().map(estimate).collect(),
        rejected,
        runs,
        length_sigma_m: sigma_m,
        summary: solution.summary,
        identifiability: solution.identifiability,
        model,
    }
}
