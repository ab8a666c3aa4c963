//! Chooses the error terms that a calibration contains, and the widths of its priors. `pipeline::estimate` calls
//! these functions. Input: models near their solution. Output: the roles of the terms and the sigmas of the
//! priors, which are set in the models.
//!
//! To offer a group of terms means to give its terms priors and to compute the normal equations. `terms`
//! then tests on left-out data which offers improve the prediction. Each offer is accepted or rejected
//! as a whole. Steps of `choose_terms`:
//!
//! 1. Detects the waves of a line spectrum in the residuals (`add_detected_waves`).
//! 2. Offers all groups, and sets the priors of accepted terms (`offer`, `apply`).
//! 3. Offers the terms of rejected groups again, separately for each axis (`choose_axes`).
//! 4. Widens the priors of the tolerances (`widen_tolerances`).

use std::collections::BTreeMap;

use super::line_spectrum::LineSpectrum;
use super::terms::{Candidate, CandidateGroup, Offer, OfferResult, prior_scale, select, select_axes};
use crate::calibrate::error::CalibrateError;
use crate::calibrate::pipeline::{HELD_OUT, LEFT_OUT, Plan, Solver, problem};
use crate::instrument::Run;
use crate::model::{ModelError, ParameterId, Role, TermGroup};
use crate::solver::{Loss, Normals, Prior, Solution};
use crate::statistics::mean;

/// Parameters whose prior standard deviations have a common factor, which is estimated from the samples.
#[derive(Debug, Clone)]
pub(in crate::calibrate) struct CommonPrior {
    /// Configured standard deviation of the prior of each parameter.
    pub sigmas: BTreeMap<ParameterId, f64>,
    /// Values of the common factor to try.
    pub scales: &'static [f64],
}

impl CommonPrior {
    /// Factors to try for the harmonics of the bar's encoders.
    pub const HARMONICS: &'static [f64] = &[2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02];
    /// Factors to try for the offsets of joints. Some robots have offsets within the tolerance of links. On others, such as
    /// cobots, the offsets were set by hand, with errors of up to a degree.
    pub const ZEROS: &'static [f64] = &[1.0, 2.0, 5.0, 10.0, 20.0];
    /// Factors to try for the assumed sizes of rejected terms. They are equally spaced, so the factor has a uniform prior
    /// (Gelman 2006).
    const REJECTED: &'static [f64] = &[0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0];

    /// Creates the common prior of the parameters `ids`. A parameter that has a prior in none of the models is omitted.
    pub fn new(runs: &[Run], ids: impl Iterator<Item = ParameterId>, scales: &'static [f64]) -> Self {
        let sigma = |id: ParameterId| {
            runs.iter().find_map(|run| match run.model.role(id)? {
                Role::Prior { sigma, .. } => Some((id, sigma)),
                _ => None,
            })
        };
        Self { sigmas: ids.filter_map(sigma).collect(), scales }
    }

    /// The normal equations with this value of the common factor in their priors.
    fn scaled(&self, scale: f64, normals: Normals, ids: &[ParameterId]) -> Normals {
        let priors = self.priors_at(scale, normals.priors(), ids);
        normals.with_priors(priors)
    }

    /// Priors with this value of the common factor. `ids` are the parameters of the columns.
    fn priors_at(&self, scale: f64, priors: &[Prior], ids: &[ParameterId]) -> Vec<Prior> {
        let scaled = |prior: &Prior| {
            let sigma = self.sigmas.get(&ids[prior.column]).map_or(prior.sigma, |sigma| sigma * scale);
            Prior { sigma, ..*prior }
        };
        priors.iter().map(scaled).collect()
    }

    /// Each factor with the logarithm of its evidence, see [`Normals::evidence`]. Accounts for correlated errors.
    fn evidence(&self, normals: &Normals, ids: &[ParameterId]) -> Vec<(f64, f64)> {
        let dispersion = normals.overdispersion().unwrap_or(1.0).max(1.0);
        let evidence = |&scale: &f64| {
            Some((scale, normals.evidence(&self.priors_at(scale, normals.priors(), ids), dispersion)?))
        };
        self.scales.iter().filter_map(evidence).collect()
    }

    /// Root of the mean square of the factor, weighted by the evidence. 1 if the evidence is unknown.
    fn mean_scale(&self, normals: &Normals, ids: &[ParameterId]) -> f64 {
        let evidence = self.evidence(normals, ids);
        let best = evidence.iter().map(|(_, evidence)| *evidence).fold(f64::NEG_INFINITY, f64::max);
        let (mut weights, mut squares) = (0.0, 0.0);
        for (scale, evidence) in evidence {
            let weight = (evidence - best).exp();
            weights += weight;
            squares += weight * scale * scale;
        }
        if weights > 0.0 { (squares / weights).sqrt() } else { 1.0 }
    }
}

/// Groups of terms to try, with the normal equations for a solution that contains none of these terms.
struct Offered {
    /// Parameter of each column.
    ids: Vec<ParameterId>,
    /// Columns that are included in each solution, whichever terms are accepted.
    always: Vec<usize>,
    /// The groups of terms, as columns.
    offers: Vec<Offer>,
    /// Normal equations of the held-out groups. `None` if residuals are not finite.
    normals: Option<Normals>,
}

impl Offered {
    fn columns_of(&self, wanted: &[ParameterId]) -> impl Iterator<Item = usize> {
        (0..self.ids.len()).filter(|column| wanted.contains(&self.ids[*column]))
    }

    /// Selects among the offers and returns their results. Empty if residuals are not finite.
    fn results(&self, select: fn(&Normals, &[usize], &[Offer]) -> Vec<OfferResult>) -> Vec<OfferResult> {
        let normals = self.normals.as_ref();
        normals.map_or_else(Vec::new, |normals| select(normals, &self.always, &self.offers))
    }
}

impl Solver<'_> {
    /// Tries each group of terms on held-out groups of samples. Then tries the rejected groups again, separately
    /// for each axis. Sets the priors of accepted terms. Also chooses the factor of the tolerances. Returns the
    /// results of all groups and this factor.
    pub(in crate::calibrate) fn choose_terms(
        &mut self,
        solution: &Solution,
    ) -> Result<(Vec<Candidate>, f64), CalibrateError> {
        self.begins("errors of joints");
        let mut groups = self.plan.groups.clone();
        self.add_detected_waves(&mut groups, &solution.sample_weights)?;
        let offered = self.offer(&mut groups, solution.loss, HELD_OUT)?;
        let results = offered.results(select);
        self.leave_out(&self.waves.only_without_a_fold())?;
        let mut report = Vec::new();
        let mut accepted = self.apply(&groups, &offered, &results, &mut report)?;
        // A rejected line spectrum is not tried again for each axis. Its orders were detected in these samples, so a test
        // with the same samples cannot confirm them.
        let rejected: Vec<&CandidateGroup> = results
            .iter()
            .filter(|result| !result.accepted)
            .map(|result| &groups[result.offer])
            .filter(|group| group.group != TermGroup::LineSpectrum)
            .collect();
        accepted.extend(self.choose_axes(&rejected, solution.loss, &mut report)?);
        self.consider_rejected(&rejected, &accepted, solution.loss)?;
        let scale = self.widen_tolerances(&offered, &accepted)?;
        Ok((report, scale))
    }

    /// If the group of the line spectrum has no parameters, detects its waves and adds them to the group.
    fn add_detected_waves(
        &mut self,
        groups: &mut [CandidateGroup],
        weights: &[f64],
    ) -> Result<(), CalibrateError> {
        let is_undetected =
            |group: &&mut CandidateGroup| group.group == TermGroup::LineSpectrum && group.ids.is_empty();
        let Some(spectrum) = groups.iter_mut().find(is_undetected) else { return Ok(()) };
        self.detect_line_spectrum(weights)?;
        spectrum.ids.clone_from(&self.waves.in_all);
        if !spectrum.ids.is_empty() {
            // Waves that are in `without_fold` of a fold but not in `in_all` are only used to predict this fold.
            self.set_roles(
                &self.waves.only_without_a_fold(),
                Role::Prior { value: 0.0, sigma: spectrum.sigma },
            )?;
        }
        Ok(())
    }

    /// Tries the terms of rejected groups separately for each axis. Returns the terms that are accepted.
    fn choose_axes(
        &mut self,
        rejected: &[&CandidateGroup],
        loss: Loss,
        report: &mut Vec<Candidate>,
    ) -> Result<Vec<ParameterId>, CalibrateError> {
        let mut axes: Vec<CandidateGroup> = rejected.iter().flat_map(|group| group.by_axis()).collect();
        if axes.is_empty() {
            return Ok(Vec::new());
        }
        let offered = self.offer(&mut axes, loss, LEFT_OUT)?;
        self.apply(&axes, &offered, &offered.results(select_axes), report)
    }

    /// Gives rejected terms the role [`Role::Considered`], so that they are a source of uncertainty,
    /// unless all data sets are ball-bar runs.
    ///
    /// Rejected terms resemble errors of links, except waves of high order. Their assumed size is at most the smallest one
    /// that was tried, because left-out groups did not require a larger one. If the samples are more probable with
    /// smaller errors, the assumed size is smaller. With a ball-bar, the encoders separate error terms from
    /// links. The stated uncertainty is then correct without rejected terms (for 95 % of 185 simulated runs).
    fn consider_rejected(
        &mut self,
        rejected: &[&CandidateGroup],
        accepted: &[ParameterId],
        loss: Loss,
    ) -> Result<(), CalibrateError> {
        if rejected.is_empty() || self.residual_unit_of().is_some() {
            return Ok(());
        }
        let mut groups = Vec::new();
        for group in rejected {
            let is_excluded = |id: &ParameterId| !accepted.contains(id);
            let excluded: Vec<ParameterId> = group.ids.iter().copied().filter(is_excluded).collect();
            self.set_roles(&excluded, Role::Prior { value: 0.0, sigma: group.sigma })?;
            groups.push(CommonPrior::new(self.runs, excluded.into_iter(), CommonPrior::REJECTED));
        }
        let (_, ids, mut normals) = self.normals_here(loss, LEFT_OUT)?;
        for group in groups {
            let scale = normals.as_ref().map_or(1.0, |normals| group.mean_scale(normals, &ids));
            normals = normals.map(|normals| group.scaled(scale, normals, &ids));
            for (id, sigma) in group.sigmas {
                self.set_roles(&[id], Role::Considered { sigma: sigma * scale })?;
            }
        }
        Ok(())
    }

    /// Multiplies the standard deviations of the tolerances by the factor that predicts left-out groups best. Returns the
    /// factor. The scales of the terms have been chosen before. Priors stated by the user are not changed.
    fn widen_tolerances(&mut self, offered: &Offered, accepted: &[ParameterId]) -> Result<f64, ModelError> {
        let Plan { tolerances, .. } = self.plan;
        let Some(normals) = offered.normals.as_ref().filter(|_| !tolerances.is_empty()) else {
            return Ok(1.0);
        };
        let kept: Vec<usize> = offered.always.iter().copied().chain(offered.columns_of(accepted)).collect();
        let scale = prior_scale(normals, &kept, |column| tolerances.contains(&offered.ids[column]));
        self.set_sigmas(|id, sigma| tolerances.contains(&id).then_some(sigma * scale))?;
        Ok(scale)
    }

    /// Chooses between play and compliance of the bar. An axial force either takes up the play or elongates
    /// the bar as a spring. If play predicts left-out groups better, play becomes free and compliance
    /// fixed. Returns whether play is better.
    pub(in crate::calibrate) fn replaces_compliance_by_play(
        &mut self,
        loss: Loss,
    ) -> Result<bool, CalibrateError> {
        const PLAY_OR_COMPLIANCE: [ParameterId; 2] = [ParameterId::BarPlay, ParameterId::BarCompliance];
        let estimates_compliance = |run: &Run| {
            PLAY_OR_COMPLIANCE.map(|id| run.model.role(id)) == [Some(Role::Fixed), Some(Role::Free)]
        };
        if !self.runs.iter().any(estimates_compliance) || self.plan.fix.contains(&ParameterId::BarPlay) {
            return Ok(false);
        }
        self.set_roles(&PLAY_OR_COMPLIANCE, Role::Free)?;
        let (columns, ids, normals) = self.normals_here(loss, HELD_OUT)?;
        let error_without = |excluded: ParameterId| {
            let kept: Vec<usize> = (0..ids.len()).filter(|column| ids[*column] != excluded).collect();
            // The linearisation is about the current estimates, but the excluded parameter is zero.
            let mut about = self.start(&columns);
            about.iter_mut().zip(&ids).filter(|(_, id)| **id == excluded).for_each(|(value, _)| *value = 0.0);
            let normals = normals.as_ref()?.about(&about);
            normals.held_out(&kept, normals.priors()).map(|errors| mean(&errors))
        };
        let [with_compliance, with_play] = PLAY_OR_COMPLIANCE.map(error_without);
        let play_is_better =
            with_compliance.zip(with_play).is_some_and(|(compliance, play)| play < compliance);
        let excluded = PLAY_OR_COMPLIANCE[usize::from(play_is_better)];
        self.set_roles(&[excluded], Role::Fixed)?;
        self.set_to_zero(&[excluded])?;
        Ok(play_is_better)
    }

    /// Offers all groups: sets the priors of their terms and computes the normal equations, about the models with all these
    /// terms set to zero. Groups without columns are removed. `count` is the number of folds.
    fn offer(
        &mut self,
        groups: &mut Vec<CandidateGroup>,
        loss: Loss,
        count: usize,
    ) -> Result<Offered, CalibrateError> {
        for group in &*groups {
            self.set_roles(&group.ids, Role::Prior { value: 0.0, sigma: group.sigma })?;
        }
        // Normal equations with all terms, and the columns of each group in them.
        let (columns, ids, normals) = self.normals_here(loss, count)?;
        let mut offered = Offered { ids, always: Vec::new(), offers: Vec::new(), normals: None };
        groups.retain(|group| offered.columns_of(&group.ids).next().is_some());
        let offer_of = |group: &CandidateGroup| {
            // Only a line spectrum has different waves for each fold: those that were detected without the fold.
            let without = self.waves.without_fold.iter().filter(|_| group.group == TermGroup::LineSpectrum);
            Offer {
                columns: offered.columns_of(&group.ids).collect(),
                without: without.map(|ids| offered.columns_of(ids).collect()).collect(),
                scales: group.scales.clone(),
            }
        };
        let offers: Vec<Offer> = groups.iter().map(offer_of).collect();
        // Separate the offered columns from those that each solution contains. Then move the linearisation to zero terms.
        let is_offered = |column: &usize| offers.iter().any(|offer| offer.has(*column));
        let (optional, always): (Vec<usize>, Vec<usize>) = (0..offered.ids.len()).partition(is_offered);
        let mut x_without_terms = self.start(&columns);
        optional.iter().for_each(|&column| x_without_terms[column] = 0.0);
        let normals = normals.map(|normals| normals.about(&x_without_terms));
        (offered.always, offered.offers, offered.normals) = (always, offers, normals);
        Ok(offered)
    }

    /// Sets the priors of accepted terms and fixes all other offered terms at zero. Adds a line for each result to
    /// `report`. Returns the accepted terms.
    fn apply(
        &mut self,
        groups: &[CandidateGroup],
        offered: &Offered,
        results: &[OfferResult],
        report: &mut Vec<Candidate>,
    ) -> Result<Vec<ParameterId>, CalibrateError> {
        // Set the roles of the terms of each group.
        let mut accepted = Vec::new();
        for (number, group) in groups.iter().enumerate() {
            let result = results.iter().find(|result| result.offer == number && result.accepted);
            let Some(OfferResult { scale, .. }) = result else {
                self.leave_out(&group.ids)?;
                continue;
            };
            self.set_roles(&group.ids, Role::Prior { value: 0.0, sigma: group.sigma * scale })?;
            accepted.extend(&group.ids);
        }
        // Report the results.
        report.extend(results.iter().map(|result| {
            let group = &groups[result.offer];
            Candidate {
                group: group.group,
                name: group.name.clone(),
                parameters: offered.offers[result.offer].columns.len(),
                sigma: result.accepted.then_some(group.sigma * result.scale),
                held_out_before: result.before.sqrt(),
                held_out_after: result.after.sqrt(),
                accepted: result.accepted,
            }
        }));
        Ok(accepted)
    }

    fn leave_out(&mut self, ids: &[ParameterId]) -> Result<(), CalibrateError> {
        self.set_roles(ids, Role::Fixed)?;
        Ok(self.set_to_zero(ids)?)
    }

    /// Adds the waves that are detected in the residuals to all models.
    fn detect_line_spectrum(&mut self, weights: &[f64]) -> Result<(), CalibrateError> {
        let mut spectrum = LineSpectrum::default();
        let columns = self.columns();
        let starts = problem(self.runs, &columns, &self.sigmas)?.starts().to_vec();
        for ((run, sigma), samples) in self.runs.iter().zip(&self.sigmas).zip(starts.windows(2)) {
            let weights = weights.get(samples[0]..samples[1]).unwrap_or_default();
            spectrum.add(run, *sigma, weights, &run.instrument.independent(HELD_OUT))?;
        }
        let mut waves = spectrum.detect();
        let has_role = |id: &ParameterId| {
            self.runs.iter().any(|run| run.model.role(*id).is_some_and(|role| role != Role::Fixed))
        };
        waves.retain(|id| !self.plan.fix.contains(id) && !has_role(id));
        for run in &mut *self.runs {
            run.model = run.model.clone().with(waves.ids());
        }
        self.waves.extend(waves);
        Ok(())
    }

    /// Sets the common factor of each group of priors to the value for which the samples are most probable (empirical Bayes:
    /// type-II maximum likelihood, Berger 1985).
    ///
    /// For example, if encoders have no eccentricity, the priors of their harmonics become narrow, and the
    /// harmonics do not increase the uncertainty. If the configured standard deviation is too small, it is
    /// increased and does not bias the harmonics.
    pub(in crate::calibrate) fn fit_common_priors(&mut self, loss: Loss) -> Result<(), CalibrateError> {
        let plan = self.plan;
        if plan.common.is_empty() {
            return Ok(());
        }
        let (_, ids, normals) = self.normals_here(loss, LEFT_OUT)?;
        let Some(mut normals) = normals else { return Ok(()) };
        for common in &plan.common {
            let evidence = common.evidence(&normals, &ids);
            let Some((scale, _)) = evidence.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
            normals = common.scaled(scale, normals, &ids);
            self.set_sigmas(|id, _| common.sigmas.get(&id).map(|sigma| sigma * scale))?;
        }
        Ok(())
    }

    /// Changes the standard deviations of priors. `sigma` receives the present standard deviation and returns the new one,
    /// or `None` for no change.
    fn set_sigmas(&mut self, sigma: impl Fn(ParameterId, f64) -> Option<f64>) -> Result<(), ModelError> {
        for Run { model, .. } in &mut *self.runs {
            let priors: Vec<(ParameterId, Role)> =
                model.columns().map(|parameter| (parameter.id, parameter.role)).collect();
            for (id, role) in priors {
                if let Role::Prior { value, sigma: present } = role
                    && let Some(sigma) = sigma(id, present)
                {
                    model.set_role(id, Role::Prior { value, sigma })?;
                }
            }
        }
        Ok(())
    }
}
