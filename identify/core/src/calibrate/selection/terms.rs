//! Selection of optional terms: a group is accepted only if it improves the prediction of left-out folds.

use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};

use crate::model::{ParameterId, TermGroup};
use crate::solver::{Normals, Prior};

/// Terms that are tried together, the same for all axes.
#[derive(Debug, Clone, PartialEq)]
pub struct CandidateGroup {
    /// Group of error terms.
    pub group: TermGroup,
    /// Name of the group in reports.
    pub name: String,
    /// Parameters of the group.
    pub ids: Vec<ParameterId>,
    /// Standard deviation of their prior at zero, SI.
    pub sigma: f64,
    /// Candidate factors of `sigma`.
    pub scales: Vec<f64>,
}

/// Result for one group of terms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Group of error terms.
    pub group: TermGroup,
    /// Name of the group in reports.
    #[serde(default)]
    pub name: String,
    /// Standard deviation of its prior at zero, in the parameters' SI unit; absent if the group was rejected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma: Option<f64>,
    /// Number of parameters in the group.
    pub parameters: usize,
    /// Root mean square residual of held-out segments without the group, in standard deviations of the cost.
    pub held_out_before: f64,
    /// Root mean square residual of held-out segments with the group, in standard deviations of the cost.
    pub held_out_after: f64,
    /// Whether the group improves the prediction of held-out segments significantly.
    pub accepted: bool,
}

impl Candidate {
    /// Name of the group for the report.
    pub fn name(&self) -> &str {
        if self.name.is_empty() { self.group.name() } else { &self.name }
    }
}

/// Terms that are accepted or rejected together.
#[derive(Debug, Clone, PartialEq)]
pub struct Offer {
    /// Columns of the terms.
    pub columns: Vec<usize>,
    /// For each fold, the columns detected in the other folds; empty if they are the same for all folds.
    pub without: Vec<Vec<usize>>,
    /// Candidate factors of the standard deviations of their priors.
    pub scales: Vec<f64>,
}

impl Offer {
    /// Columns that are used to predict a fold.
    fn columns(&self, fold: usize) -> &[usize] {
        self.without.get(fold).unwrap_or(&self.columns)
    }

    /// Whether the column is used for any fold or for all samples.
    pub(in crate::calibrate) fn has(&self, column: usize) -> bool {
        self.without.iter().chain([&self.columns]).any(|columns| columns.contains(&column))
    }
}

/// Result for one offer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Verdict {
    /// Index of the offer.
    pub offer: usize,
    /// Scale of the priors at which left-out folds are predicted best.
    pub scale: f64,
    /// Mean squared residual of left-out folds without the offer, with all offers accepted before.
    pub before: f64,
    /// Mean squared residual of left-out folds with the offer.
    pub after: f64,
    /// Whether the offer is accepted.
    pub accepted: bool,
}

/// One-sided level of the test whether left-out folds are predicted better. Terms that fit only noise make predictions worse,
/// so far fewer terms without real effect are accepted: in simulations 3 to 4 of 100 groups of one parameter and 1 to 4 of
/// groups of twelve, for white noise and for noise correlated over ten samples.
const LEVEL: f64 = 0.15;
/// A smaller relative decrease of the mean squared residual does not change any reported value.
const TRIFLE: f64 = 1e-3;

/// Arithmetic mean; zero for an empty slice.
pub(in crate::calibrate) fn mean(values: &[f64]) -> f64 {
    if values.is_empty() { 0.0 } else { values.iter().sum::<f64>() / values.len() as f64 }
}

/// Whether the errors of the folds decrease significantly (one-sided Student's t of the logarithms, since errors may differ
/// much between folds), and their mean by more than `TRIFLE`.
pub(in crate::calibrate) fn falls(before: &[f64], after: &[f64]) -> bool {
    let logarithm = |squared: f64| squared.max(f64::MIN_POSITIVE).ln();
    let fall: Vec<f64> =
        before.iter().zip(after).map(|(before, after)| logarithm(*before) - logarithm(*after)).collect();
    let by = mean(&fall);
    let freedom = fall.len() as f64 - 1.0;
    let Ok(student) = StudentsT::new(0.0, 1.0, freedom) else { return false };
    let variance = fall.iter().map(|one| (one - by).powi(2)).sum::<f64>() / freedom;
    let standard_error = (variance / fall.len() as f64).sqrt();
    by > student.inverse_cdf(1.0 - LEVEL) * standard_error && mean(after) < (1.0 - TRIFLE) * mean(before)
}

/// Forward selection: accept the offer with which left-out folds are predicted best, then the best of the others in addition,
/// until none improves the prediction. Then choose the scales of the accepted offers once more. The columns `always` are
/// always included. The result contains accepted offers in the order of acceptance, then the rejected ones.
pub fn select(normals: &Normals, always: &[usize], offers: &[Offer]) -> Vec<Verdict> {
    let mut taken: Vec<Verdict> = Vec::new();
    let Some(mut before) = predicted(normals, always, offers, &taken) else { return taken };
    loop {
        let is_open = |offer: &usize| taken.iter().all(|one| one.offer != *offer);
        let open: Vec<usize> = (0..offers.len()).filter(is_open).collect();
        let mut tried: Vec<(Verdict, Vec<f64>)> = open
            .into_iter()
            .filter_map(|offer| {
                let start = Verdict { offer, scale: 1.0, before: mean(&before), after: 0.0, accepted: false };
                taken.push(start);
                let best = best_scale(normals, always, offers, &mut taken);
                let (verdict, after) = (taken.pop()?, best?);
                Some((Verdict { accepted: falls(&before, &after), ..verdict }, after))
            })
            .collect();
        tried.sort_by(|a, b| a.0.after.total_cmp(&b.0.after));
        let Some(best) = tried.iter().position(|(verdict, _)| verdict.accepted) else {
            rescale(normals, always, offers, &mut taken);
            taken.extend(tried.into_iter().map(|(verdict, _)| verdict));
            return taken;
        };
        let (verdict, after) = tried.swap_remove(best);
        taken.push(verdict);
        before = after;
    }
}

/// Chooses the scale of each accepted offer again.
fn rescale(normals: &Normals, always: &[usize], offers: &[Offer], taken: &mut Vec<Verdict>) {
    if taken.iter().any(|one| offers[one.offer].scales.len() > 1) {
        for _ in 0..taken.len() {
            let after = taken.remove(0);
            taken.push(after);
            best_scale(normals, always, offers, taken);
        }
    }
}

/// Sets the scale of the last offer that predicts best; returns the squared residuals with it. `None` if the folds do not
/// determine the columns.
fn best_scale(
    normals: &Normals,
    always: &[usize],
    offers: &[Offer],
    taken: &mut [Verdict],
) -> Option<Vec<f64>> {
    let last = taken.len().checked_sub(1)?;
    let scales = &offers[taken[last].offer].scales;
    let tried = scales.iter().filter_map(|&scale| {
        taken[last].scale = scale;
        Some((scale, predicted(normals, always, offers, taken)?))
    });
    let best = tried.min_by(|a, b| mean(&a.1).total_cmp(&mean(&b.1)));
    let (scale, errors) = best?;
    (taken[last].scale, taken[last].after) = (scale, mean(&errors));
    Some(errors)
}

/// Mean squared residual of each left-out fold.
fn predicted(normals: &Normals, always: &[usize], offers: &[Offer], taken: &[Verdict]) -> Option<Vec<f64>> {
    let columns = |fold: usize| -> Vec<usize> {
        let own = |one: &Verdict| offers[one.offer].columns(fold).iter().copied();
        always.iter().copied().chain(taken.iter().flat_map(own)).collect()
    };
    let scale = |column: usize| {
        let of = taken.iter().find(|one| offers[one.offer].has(column));
        of.map_or(1.0, |one| one.scale)
    };
    normals.held_out_each(columns, &scaled(normals.priors(), scale))
}

fn scaled(priors: &[Prior], scale: impl Fn(usize) -> f64) -> Vec<Prior> {
    priors.iter().map(|prior| Prior { sigma: prior.sigma * scale(prior.column), ..*prior }).collect()
}

/// Factor that widens the prior standard deviations of some columns: the value on a grid that predicts left-out folds best, if
/// the improvement is significant, otherwise one. It is never less than one: parameters that the samples hardly determine are
/// predicted best with narrow priors; this does not show that they are near nominal.
pub fn prior_scale(normals: &Normals, columns: &[usize], of_scale: impl Fn(usize) -> bool) -> f64 {
    const GRID: [f64; 5] = [2.0, 5.0, 10.0, 30.0, 100.0];
    let errors = |scale: f64| {
        let priors = scaled(normals.priors(), |column| if of_scale(column) { scale } else { 1.0 });
        normals.held_out(columns, &priors)
    };
    let Some(unscaled) = errors(1.0) else { return 1.0 };
    let better = GRID.into_iter().filter_map(|scale| {
        let errors = errors(scale).filter(|errors| falls(&unscaled, errors))?;
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
    use crate::solver::{Linearisation, Options, Problem};

    /// Rows on a straight line plus a wave, which may be zero; a second wave is never present.
    struct Waves {
        t: Vec<f64>,
        noise: Vec<f64>,
        wave: f64,
        priors: Vec<Prior>,
    }

    impl Waves {
        fn new(seed: u64, wave: f64) -> Self {
            let mut random = StdRng::seed_from_u64(seed);
            let t = (0..320).map(|_| random.random_range(-3.0..3.0)).collect();
            let noise = (0..320).map(|_| 0.1 * random.sample::<f64, _>(StandardNormal)).collect();
            let priors = [2, 3].map(|column| Prior { column, value: 0.0, sigma: 0.01 }).to_vec();
            Self { t, noise, wave, priors }
        }

        fn verdicts(&self) -> Vec<Verdict> {
            let folds: Vec<Vec<usize>> = (0..8).map(|fold| (40 * fold..40 * (fold + 1)).collect()).collect();
            let normals = Normals::new(self, &[0.0; 4], &Options::default(), &folds).ok();
            let offer =
                |column| Offer { columns: vec![column], without: Vec::new(), scales: vec![1.0, 100.0] };
            normals.map(|normals| select(&normals, &[0, 1], &[offer(3), offer(2)])).unwrap_or_default()
        }
    }

    impl Problem for Waves {
        fn columns(&self) -> usize {
            4
        }

        fn column_name(&self, column: usize) -> String {
            column.to_string()
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
        let verdicts = Waves::new(3, -0.5).verdicts();
        let [present, absent] = &verdicts[..] else { panic!("{verdicts:?}") };
        assert_eq!((present.offer, present.scale, present.accepted), (1, 100.0, true));
        assert!(present.before.sqrt() > 0.3 && (present.after.sqrt() - 0.1).abs() < 0.02, "{present:?}");
        assert!(!absent.accepted);
    }

    #[test]
    fn of_a_hundred_terms_that_are_not_there_fewer_than_five_are_taken() {
        let trials = 400;
        let taken = |seed| Waves::new(seed, 0.0).verdicts().iter().filter(|one| one.accepted).count();
        let rate = (0..trials).map(taken).sum::<usize>() as f64 / (2.0 * trials as f64);
        assert!(rate < 0.05, "{rate}");
    }
}
