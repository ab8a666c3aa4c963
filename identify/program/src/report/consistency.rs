//! Tests whether several calibrations of one robot agree within their uncertainties, for `identify compare`.
//!
//! The thesis compared the results of different paths, speeds and days by eye only (figures 5.12 to 5.17). Here, every
//! parameter of the robot gets a chi-square test of homogeneity. If `n` calibrations identified the values `x_i` with the
//! standard deviations `sigma_i`, the test statistic is `sum ((x_i - mean) / sigma_i)^2`, with `n - 1` degrees of freedom.
//! The smallest p-value of all parameters is multiplied by the number of tests (Holm 1979).

use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::result::file::{CalibrationFile, ParameterStatus};
use crate::evaluate::random_postures;
use crate::kinematics::{Chain, Joints, nearest_turn};
use crate::model::{ParameterId, Unit};
use crate::statistics::{Sizes, extremes};

/// The calibrations are inconsistent if the corrected p-value is below this limit.
pub const P_MIN: f64 = 0.01;
/// Nominal values count as equal if their difference is at most this \[m, rad\]. Such a difference results from rounding.
const SAME_NOMINAL: f64 = 1e-9;

/// One parameter in several calibrations.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterEstimates {
    /// Identifier of the compared parameter.
    pub id: ParameterId,
    /// Identified value and sigma in each calibration, in SI units; `None` for a calibration that did not identify the
    /// parameter. Whole turns are added to angles, so that each angle lies within half a turn of the first.
    pub values: Vec<Option<(f64, f64)>>,
    /// Mean of the values, weighted by the inverse variances.
    pub mean: f64,
    /// p-value: probability of differences at least this large if all calibrations measured the same robot. `None` if only
    /// one calibration identified the parameter.
    pub p: Option<f64>,
}

/// Result of the comparison of several calibrations of one robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Consistency {
    /// Parameters of the robot that at least one calibration identified. If nominal lengths of the last link differ, these
    /// lengths are not included.
    pub parameters: Vec<ParameterEstimates>,
    /// Half-width of a 95 % confidence interval in each calibration, in sigmas.
    pub sigmas_of_95: Vec<f64>,
    /// Names of the robot's parameters whose nominal value differs between the calibrations.
    pub other_nominals: Vec<String>,
    /// Corrected p-value: smallest p-value times the number of tests, at most one. `None` if
    /// no parameter was identified twice.
    pub p_corrected: Option<f64>,
    /// Comparison of each calibration after the first with the first one: statistics of the distance between the corrections
    /// of the robot's end by the two calibrations. A correction is the calibrated minus the nominal position. Postures are
    /// random, in the joint ranges that both calibrations measured. `None` if these ranges do not overlap or are unknown.
    pub apart: Vec<Option<Sizes>>,
}

/// Reasons why calibrations cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConsistencyError {
    /// Fewer than two files were given.
    #[error("there is one calibration only; give at least two")]
    One,
    /// The files are of different robots.
    #[error(
        "these are calibrations of different robots, `{first}` and `{other}`; compare those of one robot"
    )]
    OtherRobot {
        /// Robot of the first file.
        first: String,
        /// Robot of the other file.
        other: String,
    },
}

impl Consistency {
    /// True if the test does not reject the hypothesis that all calibrations measured the same robot.
    pub fn is_consistent(&self) -> bool {
        self.p_corrected.is_none_or(|p| p >= P_MIN)
    }

    /// Compares the robot's parameters. Parameters of bar and clocks are not compared, because they may differ
    /// from run to run.
    ///
    /// # Errors
    /// [`ConsistencyError`].
    pub fn new(files: &[CalibrationFile]) -> Result<Self, ConsistencyError> {
        let [first, others @ ..] = files else { return Err(ConsistencyError::One) };
        if others.is_empty() {
            return Err(ConsistencyError::One);
        }
        if let Some(other) = others.iter().find(|other| other.robot != first.robot) {
            return Err(ConsistencyError::OtherRobot {
                first: first.robot.clone(),
                other: other.robot.clone(),
            });
        }
        let (mut ids, mut other_nominals): (Vec<ParameterId>, Vec<String>) = Default::default();
        let mut last_link = 0;
        for entry in files.iter().flat_map(|file| &file.parameters) {
            let Ok(id @ ParameterId::Robot { link, .. }) = entry.name.parse() else { continue };
            last_link = last_link.max(link);
            if entry.status != ParameterStatus::Fixed && !ids.contains(&id) {
                ids.push(id);
            }
            let first = first.parameters.iter().find(|first| first.name == entry.name);
            let differs = first.is_some_and(|first| (entry.nominal - first.nominal).abs() > SAME_NOMINAL);
            if differs && !other_nominals.contains(&entry.name) {
                other_nominals.push(entry.name.clone());
            }
        }
        // The lengths of the last link contain plate and tool, which may be others although the robot is the same.
        ids.retain(|id| {
            let is_of_last_link = matches!(id, ParameterId::Robot { link, .. } if *link == last_link);
            !(is_of_last_link && id.unit() == Unit::Metre && other_nominals.contains(&id.to_string()))
        });
        let parameters: Vec<ParameterEstimates> = ids.into_iter().map(|id| compared(id, files)).collect();
        let tested: Vec<f64> = parameters.iter().filter_map(|one| one.p).collect();
        let p_corrected =
            tested.iter().copied().min_by(f64::total_cmp).map(|p| (p * tested.len() as f64).min(1.0));
        let sigmas_of_95 = |file: &CalibrationFile| {
            let from = file.knowledge.as_ref().map(|knowledge| knowledge.sigmas_from).unwrap_or_default();
            from.sigmas_of_95()
        };
        let sigmas_of_95 = files.iter().map(sigmas_of_95).collect();
        let apart = others.iter().map(|other| ends_apart(first, other)).collect();
        Ok(Self { parameters, sigmas_of_95, other_nominals, p_corrected, apart })
    }
}

/// Compares how two calibrations correct the position of the robot's end. A correction is the calibrated minus the nominal
/// position of the end, so it does not matter if the calibrations used different plates on the flange. Returns statistics of
/// the distance between the two corrections over random postures within the joint ranges of both calibrations. Joint errors
/// are not included in the corrections.
fn ends_apart(one: &CalibrationFile, other: &CalibrationFile) -> Option<Sizes> {
    let ranges = one.validity.as_ref()?.joints.iter().zip(&other.validity.as_ref()?.joints);
    let common: Vec<[f64; 2]> = ranges
        .map(|(one, other)| {
            let [[low, high], [other_low, other_high]] =
                [one, other].map(|intervals| extremes(intervals.iter().flatten().copied()));
            let range = [low.max(other_low), high.min(other_high)];
            (range[0] < range[1]).then_some(range)
        })
        .collect::<Option<_>>()?;
    let robots =
        [one, other].map(|file| (file.links(|entry| entry.value), file.links(|entry| entry.nominal)));
    let position = |chain: &Chain, q: &Joints| chain.forward(q).translation.vector;
    let apart = random_postures(&common).map(|q| {
        let [correction, other_correction] =
            robots.each_ref().map(|(identified, nominal)| position(identified, &q) - position(nominal, &q));
        (correction - other_correction).norm()
    });
    Some(Sizes::from_values(apart))
}

fn compared(id: ParameterId, files: &[CalibrationFile]) -> ParameterEstimates {
    let name = id.to_string();
    let value_and_sigma = |file: &CalibrationFile| {
        let entry = file.parameters.iter().find(|entry| entry.name == name)?;
        let is_identified = entry.status != ParameterStatus::Fixed;
        let sigma = entry.sigma.filter(|sigma| is_identified && *sigma > 0.0 && sigma.is_finite())?;
        Some((entry.value, sigma))
    };
    let mut values: Vec<Option<(f64, f64)>> = files.iter().map(value_and_sigma).collect();
    // Angles that differ by whole turns are equal.
    if let (Unit::Radian, Some((first, _))) = (id.unit(), values.iter().copied().flatten().next()) {
        values.iter_mut().flatten().for_each(|(value, _)| *value = nearest_turn(*value, first));
    }
    let known: Vec<(f64, f64)> = values.iter().copied().flatten().collect();
    let weight: f64 = known.iter().map(|(_, sigma)| sigma.powi(-2)).sum();
    let mean = known.iter().map(|(value, sigma)| value * sigma.powi(-2)).sum::<f64>() / weight;
    let chi_squared: f64 = known.iter().map(|(value, sigma)| ((value - mean) / sigma).powi(2)).sum();
    let freedom = known.len().saturating_sub(1);
    // `ChiSquared` halves its argument. It fails if half of a positive argument rounds to zero.
    let chi_squared = if chi_squared < f64::MIN_POSITIVE { 0.0 } else { chi_squared };
    let p = ChiSquared::new(freedom as f64).ok().map(|distribution| distribution.sf(chi_squared));
    ParameterEstimates { id, values, mean, p }
}
