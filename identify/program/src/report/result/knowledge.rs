//! Entries of `calibration.toml` and `calibration.json` about the solution: rank, observability, correlations and covariance
//! of the parameters, noise of the angles, and expected position errors.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use shared::output::named;

use super::file::CalibrationFile;
use crate::calibrate::validation::deployment::Deployment;
use crate::cost::AngleNoise;
use crate::evaluate::{CubeError, Expected, WorkspaceError};
use crate::instrument::{Noise, NoiseConfig, Run};
use crate::model::Column;
use crate::solver::{Observability, SigmasFrom, Solution};

/// Correlations with a larger absolute value are listed.
const NAMED_ABOVE: f64 = 0.8;
/// Largest number of listed pairs.
const NAMED_MAX: usize = 20;

/// Largest number of parameters that are named because only their prior determines them.
const NAMED_BY_PRIOR: usize = 8;

/// A parameter counts as determined by its prior only, if its sigma is larger than this fraction of the prior's sigma. The
/// data then contribute less than a tenth of the information.
const BY_PRIOR: f64 = 0.95;

/// Two parameters that the data can hardly separate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CorrelationEntry {
    /// Name of one parameter.
    pub first: String,
    /// Name of the other parameter.
    pub second: String,
    /// Correlation coefficient, -1 to 1.
    pub correlation: f64,
}

/// Information about the parameters in samples and priors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Knowledge {
    /// Number of directions in parameter space that samples and priors determine together.
    pub rank: usize,
    /// Number of directions that the samples alone determine.
    pub rank_of_samples: usize,
    /// Singular values of the column-scaled Jacobian with priors, in descending order. If some of them are far smaller than
    /// the others, the rank is uncertain.
    pub singular_values: Vec<f64>,
    /// Observability by the samples without priors, with columns in mm, mrad, ms and ppm. All indices are zero if the samples
    /// alone do not determine all parameters.
    pub observability: Observability,
    /// Assumption on which sigmas and covariance are based.
    #[serde(default)]
    pub sigmas_from: SigmasFrom,
    /// Parameters that the data do not determine. Only their priors limit their uncertainty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub by_prior: Vec<String>,
    /// The most strongly correlated pairs, the strongest first.
    pub correlations: Vec<CorrelationEntry>,
}

/// Noise of the angles of a run, as standard deviations \[rad\]. The cost `pose` weights residuals by this noise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NoiseEntry {
    /// Number of the run, from 1.
    pub run: usize,
    /// Noise of each bar encoder, estimated from the residuals.
    pub encoder_rad: f64,
    /// Configured noise of the encoders.
    pub encoder_rad_configured: f64,
    /// Noise of each robot joint, estimated from the residuals.
    pub robot_rad: f64,
    /// Configured noise of the joints.
    pub robot_rad_configured: f64,
    /// Correlation of the residuals of consecutive samples, which is the fraction of the residuals' variance
    /// that is not white.
    pub autocorrelation: f64,
}

impl NoiseEntry {
    /// Entries of all runs whose noise was estimated.
    pub fn all(runs: &[Run], configured: NoiseConfig) -> Vec<Self> {
        let configured = AngleNoise::from(configured);
        let entry = |(run, Run { instrument, .. }): (usize, &Run)| {
            let [autocorrelation, _] = instrument.autocorrelation()?;
            let Noise::Angles(found) = instrument.noise() else { return None };
            Some(Self {
                run: run + 1,
                encoder_rad: found.encoder_rad,
                encoder_rad_configured: configured.encoder_rad,
                robot_rad: found.robot_rad,
                robot_rad_configured: configured.robot_rad,
                autocorrelation,
            })
        };
        runs.iter().enumerate().filter_map(entry).collect()
    }

    /// The entry as a sentence.
    pub(in crate::report) fn sentence(&self) -> String {
        let urad = |found: f64, configured: f64| {
            format!("{:.1} urad (configured {:.1})", found * 1e6, configured * 1e6)
        };
        format!(
            "noise of run {}: encoders {}, robot joints {}; {:.0} % of its variance lasts from sample to sample",
            self.run,
            urad(self.encoder_rad, self.encoder_rad_configured),
            urad(self.robot_rad, self.robot_rad_configured),
            100.0 * self.autocorrelation.max(0.0)
        )
    }
}

/// Covariance in SI units: all free parameters come first, then the parameters that were fixed at uncertain values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CovarianceEntry {
    /// Parameters in the order of rows and columns.
    pub names: Vec<String>,
    /// Lower triangle of the symmetric matrix, row by row up to the diagonal. An element is absent if one of its
    /// parameters is not identified.
    pub rows: Vec<Vec<Option<f64>>>,
}

impl CovarianceEntry {
    /// Covariance of two parameters by their indices in `names`; `None` if at least one of them is not identified.
    pub fn between(&self, a: usize, b: usize) -> Option<f64> {
        self.rows.get(a.max(b))?.get(a.min(b)).copied().flatten()
    }
}

impl CalibrationFile {
    /// Adds rank, observability, correlations and covariance of a solution. `all` are the columns of the covariance.
    /// Only `calibration.json` contains the covariance.
    pub fn with_knowledge(mut self, solution: &Solution, all: &[Column]) -> Self {
        let identifiability = &solution.identifiability;
        let name = |column: usize| all[column].to_string();
        let estimated = all.iter().take(solution.x.len());
        let from_display: Vec<f64> =
            estimated.map(|column| column.id.unit().display_factor().recip()).collect();
        let strongest = solution.covariance.strongest_correlations(NAMED_ABOVE);
        let strongest = strongest.into_iter().take(NAMED_MAX);
        let is_by_prior = |(column, prior): &(usize, &Option<f64>)| {
            prior
                .zip(solution.covariance.sigma_before_contradictions(*column))
                .is_some_and(|(prior, sigma)| sigma > BY_PRIOR * prior)
        };
        let by_prior = identifiability.prior_sigmas.iter().enumerate().filter(is_by_prior);
        self.knowledge = Some(Knowledge {
            rank: identifiability.rank,
            rank_of_samples: identifiability.rank_of_samples,
            singular_values: identifiability.singular_values.clone(),
            observability: identifiability.observability(&from_display),
            sigmas_from: solution.covariance.sigmas_from,
            by_prior: by_prior.map(|(column, _)| name(column)).collect(),
            correlations: strongest
                .map(|(a, b, correlation)| CorrelationEntry { first: name(a), second: name(b), correlation })
                .collect(),
        });
        let columns = solution.covariance.stated();
        let row =
            |a: usize| columns[..=a].iter().map(|b| solution.covariance.between(columns[a], *b)).collect();
        self.covariance = Some(CovarianceEntry {
            names: columns.iter().map(|column| name(*column)).collect(),
            rows: (0..columns.len()).map(row).collect(),
        });
        self
    }
}

impl Knowledge {
    /// Text for the terminal; `free` is the number of free parameters.
    pub(in crate::report) fn describe(&self, free: usize) -> String {
        use std::fmt::Write;
        let mut text = String::new();
        let weakest = self.singular_values.last().copied().unwrap_or(0.0);
        let strongest = self.singular_values.first().copied().unwrap_or(0.0);
        let _ = writeln!(
            text,
            "rank {} of {free} ({} by the samples alone), weakest direction {:.1e} of the strongest",
            self.rank,
            self.rank_of_samples,
            weakest / strongest,
        );
        if !self.by_prior.is_empty() {
            let _ = writeln!(
                text,
                "not determined by this data, so as uncertain as expected beforehand: {}",
                named(&self.by_prior, NAMED_BY_PRIOR)
            );
        }
        let (from, of_95) = (self.sigmas_from, self.sigmas_from.sigmas_of_95());
        let _ = writeln!(text, "sigmas from {from}; 95 % lie within {of_95:.2} of them");
        // All five indices are zero if the samples alone do not determine all parameters.
        if self.observability.o3 > 0.0 {
            let _ = writeln!(text, "observability (mm, mrad): {}", self.observability);
        }
        if !self.correlations.is_empty() {
            let pair = |c: &CorrelationEntry| format!("{}|{} {:+.3}", c.first, c.second, c.correlation);
            let pairs: Vec<String> = self.correlations.iter().take(8).map(pair).collect();
            let _ = writeln!(text, "largest correlations: {}", pairs.join("  "));
        }
        text
    }
}

/// Expected position errors over the workspace, before and after calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExpectedEntry {
    /// Error with the nominal geometry.
    pub nominal: Expected,
    /// Error with the calibrated geometry: links and joint errors.
    pub calibrated: Expected,
    /// Error with each deployment applied.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub deployed: BTreeMap<Deployment, Expected>,
    /// Errors at the five poses of ISO 9283. Absent if the robot reaches no such cube.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cube: Option<CubeError>,
}

impl ExpectedEntry {
    /// Entry with the expected errors over the workspace.
    pub fn from_workspace(workspace: &WorkspaceError) -> Self {
        let WorkspaceError { before, after, cube, .. } = *workspace;
        Self { nominal: before, calibrated: after, deployed: workspace.deployed.clone(), cube }
    }
}
