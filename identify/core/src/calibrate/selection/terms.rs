//! Selects optional error terms. A group of terms is accepted only if it improves the prediction of left-out folds. Input:
//! the normal equations of the folds, and the columns of each group ([`Offer`]). Output: a result for each group
//! ([`OfferResult`]). No further solve is needed, because predictions are computed from the normal equations. `choose`
//! sets the accepted terms in the models.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};

use crate::model::{ParameterId, TermGroup};
use crate::solver::{Normals, Prior, Scores};
use crate::statistics::mean;

/// Terms that are tried together, for all axes or for a single axis.
#[derive(Debug, Clone, PartialEq)]
pub struct CandidateGroup {
    /// Group of error terms.
    pub group: TermGroup,
    /// Name of the group in reports.
    pub name: String,
    /// Parameters of the group.
    pub ids: Vec<ParameterId>,
    /// Standard deviation of the prior of each parameter, SI. Its expected value is zero.
    pub sigma: f64,
    /// Factors of `sigma` to try.
    pub scales: Vec<f64>,
}

impl CandidateGroup {
    /// Splits the group into one group for each axis. Empty if all terms belong to one axis, because nothing can be split.
    pub(super) fn by_axis(&self) -> Vec<Self> {
        let axes: BTreeSet<usize> = self.ids.iter().filter_map(|id| id.axis()).collect();
        let of_axis = |axis: usize| Self {
            name: format!("{}, axis {}", self.name, axis + 1),
            ids: self.ids.iter().copied().filter(|id| id.axis() == Some(axis)).collect(),
            ..self.clone()
        };
        if axes.len() > 1 { axes.into_iter().map(of_axis).collect() } else { Vec::new() }
    }
}

/// Result for one group of terms, for reports.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Group of error terms.
    pub group: TermGroup,
    /// Name of the group in reports.
    #[serde(default)]
    pub name: String,
    /// Standard deviation of the prior at zero, in the SI unit of the parameters. Absent if the group was rejected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma: Option<f64>,
    /// Number of parameters in the group.
    pub parameters: usize,
    /// Root mean square of the weighted residuals of held-out segments, predicted without the group.
    pub held_out_before: f64,
    /// Root mean square of the weighted residuals of held-out segments, predicted with the group.
    pub held_out_after: f64,
    /// Whether the group improves the prediction of held-out segments significantly.
    pub accepted: bool,
}

impl Candidate {
    /// Name of the group in reports.
    pub fn name(&self) -> &str {
        if self.name.is_empty() { self.group.name() } else { &self.name }
    }
}

/// Terms that are accepted or rejected together, as columns of the normal equations.
#[derive(Debug, Clone, PartialEq)]
pub struct Offer {
    /// Columns of the terms.
    pub columns: Vec<usize>,
    /// For each fold, the columns that were detected when this fold was left out. Empty if all folds have the same columns.
    pub without: Vec<Vec<usize>>,
    /// Factors to try for the standard deviations of the priors of these columns.
    pub scales: Vec<f64>,
}

impl Offer {
    /// Columns that are used to predict this fold.
    fn columns(&self, fold: usize) -> &[usize] {
        self.without.get(fold).unwrap_or(&self.columns)
    }

    /// Whether the column is used to predict any fold, or in the fit to all samples.
    pub(in crate::calibrate) fn has(&self, column: usize) -> bool {
        self.without.iter().chain([&self.columns]).any(|columns| columns.contains(&column))
    }
}

/// Result for one offer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OfferResult {
    /// Index of the offer.
    pub offer: usize,
    /// Factor of the standard deviations of the priors at which left-out folds are predicted best.
    pub scale: f64,
    /// Mean squared residual of left-out folds, predicted with all offers that were accepted before, but without this offer.
    pub before: f64,
    /// Mean squared residual of left-out folds, predicted with this offer in addition.
    pub after: f64,
    /// Whether the offer is accepted.
    pub accepted: bool,
}

/// One-sided significance level of the test whether left-out folds are predicted better. Terms without a real effect
/// are accepted less often than this level, because terms that only fit noise make predictions worse. In
/// simulations, 3 to 4 % of the groups of one parameter were accepted, and 1 to 4 % of the groups of twelve. The
/// noise was white, or correlated over ten samples.
const SIGNIFICANCE_LEVEL: f64 = 0.15;
/// Minimum relative decrease of the mean squared residual. A smaller decrease does not change any reported value.
const DECREASE_MIN: f64 = 1e-3;
/// Probability that at least one axis of the rejected groups is accepted by chance in a calibration.
const AXIS_BY_CHANCE: f64 = 0.02;

/// Whether the errors of the folds decrease significantly, and their mean by more than the fraction `DECREASE_MIN`. The test
/// is a one-sided Student's t test of the decreases of the logarithms, with one degree of freedom less than folds.
/// Logarithms are used because the errors of different folds may differ by large factors.
pub(in crate::calibrate) fn falls(before: &[f64], after: &[f64]) -> bool {
    let logarithm = |squared: f64| squared.max(f64::MIN_POSITIVE).ln();
    let decreases: Vec<f64> =
        before.iter().zip(after).map(|(before, after)| logarithm(*before) - logarithm(*after)).collect();
    let mean_decrease = mean(&decreases);
    let freedom = decreases.len() as f64 - 1.0;
    let Ok(student) = StudentsT::new(0.0, 1.0, freedom) else { return false };
    let squares = decreases.iter().map(|decrease| (decrease - mean_decrease).powi(2));
    let variance = squares.sum::<f64>() / freedom;
    let standard_error = (variance / decreases.len() as f64).sqrt();
    mean_decrease > student.inverse_cdf(1.0 - SIGNIFICANCE_LEVEL) * standard_error
        && mean(after) < (1.0 - DECREASE_MIN) * mean(before)
}

/// Forward selection. Accepts the offer with which left-out folds are predicted best. Then accepts, in
/// addition, the best of the other offers, until no other offer improves the prediction. At the end chooses the
/// scales of the accepted offers again.
///
/// The columns `always` are included in all predictions. The result contains the accepted offers in the order of
/// acceptance, followed by the rejected ones.
pub fn select(normals: &Normals, always: &[usize], offers: &[Offer]) -> Vec<OfferResult> {
    let mut selection = ForwardSelection { normals, always, offers, accepted: Vec::new() };
    let Some(mut before) = selection.predicted() else { return Vec::new() };
    loop {
        let tried = selection.open().into_iter().filter_map(|offer| {
            let (result, after) = selection.try_offer(offer, &before)?;
            Some((OfferResult { accepted: falls(&before, &after), ..result }, after))
        });
        let mut tried: Vec<(OfferResult, Vec<f64>)> = tried.collect();
        tried.sort_by(|a, b| a.0.after.total_cmp(&b.0.after));
        let Some(best) = tried.iter().position(|(result, _)| result.accepted) else {
            selection.rescale();
            selection.accepted.extend(tried.into_iter().map(|(result, _)| result));
            return selection.accepted;
        };
        let (result, after) = tried.swap_remove(best);
        selection.accepted.push(result);
        before = after;
    }
}

/// Forward selection of single axes. The error of one drive is small compared with the errors of all other drives. Adding a
/// term improves the prediction of left-out folds only if the term is larger than its uncertainty. Therefore the gradients
/// of the folds are tested instead of the predictions.
///
/// Accepts the offer whose gradients are least probable by chance, then the next one. Stops when no probability is below
/// [`AXIS_BY_CHANCE`] divided by the number of offers (Bonferroni). The result contains only the accepted offers.
pub fn select_axes(normals: &Normals, always: &[usize], offers: &[Offer]) -> Vec<OfferResult> {
    let mut selection = ForwardSelection { normals, always, offers, accepted: Vec::new() };
    let level = AXIS_BY_CHANCE / offers.len().max(1) as f64;
    while let Some(scores) = selection.scores() {
        let open = selection.open().into_iter();
        let chances = open.filter_map(|axis| Some((axis, scores.chance(&offers[axis].columns)?)));
        let least = chances.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, chance)| *chance < level);
        let Some((axis, _)) = least else { break };
        let Some((result, _)) = selection.predicted().and_then(|before| selection.try_offer(axis, &before))
        else {
            break;
        };
        selection.accepted.push(OfferResult { accepted: true, ..result });
    }
    selection.accepted
}

/// State of a forward selection. While an offer is tried, it is the last element of `accepted`.
struct ForwardSelection<'a> {
    normals: &'a Normals,
    /// Columns that are included in all predictions.
    always: &'a [usize],
    offers: &'a [Offer],
    accepted: Vec<OfferResult>,
}

impl ForwardSelection<'_> {
    /// Offers that have not been accepted.
    fn open(&self) -> Vec<usize> {
        let is_open = |offer: &usize| self.accepted.iter().all(|result| result.offer != *offer);
        (0..self.offers.len()).filter(is_open).collect()
    }

    /// Gradients of the folds at the solution with all accepted offers. `None` if the columns are linearly dependent.
    fn scores(&self) -> Option<Scores> {
        let accepted = self.accepted.iter().flat_map(|result| &self.offers[result.offer].columns);
        let kept: Vec<usize> = self.always.iter().chain(accepted).copied().collect();
        self.normals.scores(&kept, &self.priors())
    }

    /// Tries an offer in addition to the accepted ones. Returns its result at the scale that predicts best, and the mean
    /// squared residual of each left-out fold. `before` contains the mean squared residuals without the offer. `None` if the
    /// folds do not determine the columns.
    fn try_offer(&mut self, offer: usize, before: &[f64]) -> Option<(OfferResult, Vec<f64>)> {
        self.accepted.push(OfferResult {
            offer,
            scale: 1.0,
            before: mean(before),
            after: 0.0,
            accepted: false,
        });
        let errors = self.choose_scale();
        Some((self.accepted.pop()?, errors?))
    }

    /// Chooses the scale of each accepted offer again, while all other offers stay accepted.
    fn rescale(&mut self) {
        if self.accepted.iter().any(|result| self.offers[result.offer].scales.len() > 1) {
            for _ in 0..self.accepted.len() {
                // `choose_scale` acts on the last offer, so move the first one to the end.
                // After the loop the order is as before.
                let first = self.accepted.remove(0);
                self.accepted.push(first);
                self.choose_scale();
            }
        }
    }

    /// Sets the scale of the last offer to the one that predicts best. Returns the mean squared residual of each left-out
    /// fold at this scale. `None` if the folds do not determine the columns.
    fn choose_scale(&mut self) -> Option<Vec<f64>> {
        let (last, offers) = (self.accepted.len().checked_sub(1)?, self.offers);
        let scales = &offers[self.accepted[last].offer].scales;
        let tried = scales.iter().filter_map(|&scale| {
            self.accepted[last].scale = scale;
            Some((scale, self.predicted()?))
        });
        let (scale, errors) = tried.min_by(|a, b| mean(&a.1).total_cmp(&mean(&b.1)))?;
        (self.accepted[last].scale, self.accepted[last].after) = (scale, mean(&errors));
        Some(errors)
    }

    /// Mean squared residual of each left-out fold, predicted with the accepted offers.
    fn predicted(&self) -> Option<Vec<f64>> {
        let columns = |fold: usize| -> Vec<usize> {
            let of_offer = |result: &OfferResult| self.offers[result.offer].columns(fold).iter().copied();
            self.always.iter().copied().chain(self.accepted.iter().flat_map(of_offer)).collect()
        };
        self.normals.held_out_each(columns, &self.priors())
    }

    /// Priors of all columns, with the scales of the accepted offers.
    fn priors(&self) -> Vec<Prior> {
        let result_on =
            |column: usize| self.accepted.iter().find(|result| self.offers[result.offer].has(column));
        scaled(self.normals.priors(), |column| result_on(column).map_or(1.0, |result| result.scale))
    }
}

fn scaled(priors: &[Prior], scale: impl Fn(usize) -> f64) -> Vec<Prior> {
    priors.iter().map(|prior| Prior { sigma: prior.sigma * scale(prior.column), ..*prior }).collect()
}

/// Factor by which the prior standard deviations of some columns are widened. It is the factor on a grid that predicts
/// left-out folds best, if the improvement is significant. Otherwise it is one.
///
/// The factor is never less than one. If the samples hardly determine the parameters, narrow priors predict best, but this
/// does not show that the true values of the parameters are near nominal.
pub fn prior_scale(normals: &Normals, columns: &[usize], of_scale: impl Fn(usize) -> bool) -> f64 {
    const GRID: [f64; 5] = [2.0, 5.0, 10.0, 30.0, 100.0];
    let errors_at = |scale: f64| {
        let priors = scaled(normals.priors(), |column| if of_scale(column) { scale } else { 1.0 });
        normals.held_out(columns, &priors)
    };
    let Some(unscaled) = errors_at(1.0) else { return 1.0 };
    let better = GRID.into_iter().filter_map(|scale| {
        let errors = errors_at(scale).filter(|errors| falls(&unscaled, errors))?;
        Some((scale, mean(&errors)))
    });
    better.min_by(|a, b| a.1.total_cmp(&b.1)).map_or(1.0, |(scale, _)| scale)
}

#[cfg(test)]
mod tests {
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};
    use rand_distr::StandardNormal;

    use super::*;
    use crate::solver::{LeastSquares, Linearisation, Options};

    /// Rows on a straight line, plus a wave whose amplitude may be zero. A second wave is offered to the
    /// fit, but the rows never contain it.
    struct WaveRows {
        t: Vec<f64>,
        noise: Vec<f64>,
        wave: f64,
        priors: Vec<Prior>,
    }

    impl WaveRows {
        fn new(seed: u64, wave: f64) -> Self {
            let mut random = StdRng::seed_from_u64(seed);
            let t = (0..320).map(|_| random.random_range(-3.0..3.0)).collect();
            let noise = (0..320).map(|_| 0.1 * random.sample::<f64, _>(StandardNormal)).collect();
            let priors = [2, 3].map(|column| Prior { column, value: 0.0, sigma: 0.01 }).to_vec();
            Self { t, noise, wave, priors }
        }

        /// Results for the offered wave that the rows do not contain, and for the other wave.
        fn results(&self) -> Vec<OfferResult> {
            self.selected(8, select)
        }

        fn selected(
            &self,
            folds: usize,
            select: fn(&Normals, &[usize], &[Offer]) -> Vec<OfferResult>,
        ) -> Vec<OfferResult> {
            let size = self.t.len() / folds;
            let folds: Vec<Vec<usize>> =
                (0..folds).map(|fold| (size * fold..size * (fold + 1)).collect()).collect();
            let normals = Normals::new(self, &[0.0; 4], &Options::default(), &folds).ok();
            let offer =
                |column| Offer { columns: vec![column], without: Vec::new(), scales: vec![1.0, 100.0] };
            normals.map(|normals| select(&normals, &[0, 1], &[offer(3), offer(2)])).unwrap_or_default()
        }
    }

    impl LeastSquares for WaveRows {
        fn columns(&self) -> usize {
            4
        }

        fn samples(&self) -> usize {
            self.t.len()
        }

        fn rows(&self) -> usize {
            1
        }

        fn priors(&self) -> &[Prior] {
            &self.priors
        }

        fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
            let x = x.to_vec();
            Box::new(move |sample, r, block| {
                let t = self.t[sample];
                let by = [1.0, t, (5.0 * t).sin(), (11.0 * t).cos()];
                r[0] = 0.3 + 0.2 * t + self.wave * by[2] + self.noise[sample];
                for (column, by) in by.into_iter().enumerate() {
                    r[0] += by * x[column];
                    block.column_mut(column)[0] = by;
                }
                true
            })
        }
    }

    #[test]
    fn a_term_that_is_in_the_data_is_taken_with_the_scale_that_fits_and_one_that_is_not_is_left() {
        let results = WaveRows::new(3, -0.5).results();
        let [present, absent] = &results[..] else { panic!("{results:?}") };
        assert_eq!((present.offer, present.scale, present.accepted), (1, 100.0, true));
        assert!(present.before.sqrt() > 0.3 && (present.after.sqrt() - 0.1).abs() < 0.02, "{present:?}");
        assert!(!absent.accepted);
    }

    #[test]
    fn of_a_hundred_terms_that_are_not_there_fewer_than_five_are_taken() {
        let trials = 400;
        let taken = |seed| WaveRows::new(seed, 0.0).results().iter().filter(|one| one.accepted).count();
        let rate = (0..trials).map(taken).sum::<usize>() as f64 / (2.0 * trials as f64);
        assert!(rate < 0.05, "{rate}");
    }

    #[test]
    fn an_axis_that_is_not_there_is_taken_as_often_as_stated_and_one_that_is_there_nearly_always() {
        let trials = 1000;
        let taken = |wave: f64, offer: Option<usize>| {
            let is_taken = |seed: &u64| {
                let results = WaveRows::new(*seed, wave).selected(32, select_axes);
                results.iter().any(|one| offer.is_none_or(|offer| one.offer == offer))
            };
            (0..trials).filter(is_taken).count() as f64 / trials as f64
        };
        // Three standard deviations of the fraction of trials in which an axis is accepted by chance.
        let within = 3.0 * (AXIS_BY_CHANCE / trials as f64).sqrt();
        let by_chance = taken(0.0, None);
        assert!((by_chance - AXIS_BY_CHANCE).abs() < within, "{by_chance}");
        // In this case the amplitude is five of its standard deviations.
        assert!(taken(0.04, Some(1)) > 0.9);
    }
}
