//! Options of a calibration, from `config/identify.toml`: cost, free parameters, and limits of the preparation. The
//! options determine the role of every parameter of a model: free, fixed, prior or considered.
//! [`IdentifyConfig::set_roles`] sets the roles of all parameters of a ball-bar model. `set_link_roles` sets the roles of
//! the robot's link parameters, for any instrument.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use shared::config::{BallBarConfig, Validate, Violation};

use super::error::CalibrateError;
use super::selection::links::link_ids;
use crate::instrument::{CostName, NoiseConfig};
use crate::kinematics::{BAR_JOINTS, Chain, LinkParameter};
use crate::model::{Group, Model, ModelError, Owner, ParameterId, Role, Selection, TermGroup, thesis_fixed};
use crate::prepare::PrepareOptions;
use crate::solver::LossName;

/// Standard deviation of the prior of encoder offsets after a counter lost its origin \[rad\]. The preparation has already
/// estimated these offsets for the nominal geometry. The parameters are the remaining corrections, so their prior expects
/// zero. The prior is much wider than the corrections, so that the samples determine them. If all samples of an origin are
/// held out, the corrections remain zero.
const LOST_ORIGIN_SIGMA_RAD: f64 = 0.01;
/// Standard deviation of the tilt of the bar's base, used if the tilt is not estimated \[rad\]. Valid
/// for a base that was levelled by eye.
const BASE_TILT_SIGMA_RAD: f64 = 5e-3;

/// Named sets of free parameters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SelectionName {
    /// The 38 parameters of the thesis and the clocks.
    Thesis,
    /// All link parameters, and the pose and mounting of the instrument. Each link parameter has a prior at
    /// its nominal value, with the tolerance as standard deviation. The tolerance is widened if held-out
    /// samples are then predicted better.
    #[default]
    #[serde(alias = "automatic")]
    Cell,
    /// All parameters that the poses determine, without priors. In each group of dependent
    /// parameters, the most suitable one is fixed.
    AllIdentifiable,
}

impl SelectionName {
    /// Name in configuration files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Thesis => "thesis",
            Self::Cell => "cell",
            Self::AllIdentifiable => "all_identifiable",
        }
    }

    /// The selection of parameters. `None` if the selection depends on the poses.
    pub const fn fixed(self) -> Option<Selection> {
        match self {
            Self::Thesis => Some(Selection::ThesisWithClocks),
            Self::Cell => Some(Selection::CellWithClocks),
            Self::AllIdentifiable => None,
        }
    }
}

/// Errors of the robot's axes that repeat with the motion, and their expected magnitudes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct JointTermsConfig {
    /// Groups of terms to try. A group is accepted only if it improves the prediction of held-out segments of the run.
    pub candidates: Vec<TermGroup>,
    /// Standard deviation of the prior at zero for amplitudes of waves and half of the backlash \[urad\].
    pub amplitude_urad: f64,
    /// Standard deviation of gear ratio errors \[ppm\].
    pub ratio_ppm: f64,
    /// Standard deviation of the delay of a joint relative to the other joints in the log \[ms\].
    pub delay_ms: f64,
    /// Standard deviation of an axis' deflection, per metre of the load's lever arm \[urad/m\].
    pub compliance_urad_per_m: f64,
}

impl Default for JointTermsConfig {
    fn default() -> Self {
        Self {
            candidates: TermGroup::OF_ROBOT.to_vec(),
            amplitude_urad: 30.0,
            ratio_ppm: 50.0,
            delay_ms: 3.0,
            compliance_urad_per_m: 200.0,
        }
    }
}

/// Obsolete option: solves no longer start from random subsets. Files that contain `ransac = false` can still be read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(try_from = "bool")]
pub struct NoRansac;

impl TryFrom<bool> for NoRansac {
    type Error = &'static str;

    fn try_from(wanted: bool) -> Result<Self, Self::Error> {
        let gone = "solves no longer start from random subsets; leave the key out, and write loss = \"geman_mcclure\" where many \
                    samples are wrong";
        if wanted { Err(gone) } else { Ok(Self) }
    }
}

/// Options of a calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IdentifyConfig {
    /// Cost; absent: the best cost for the available encoders.
    pub cost: Option<CostName>,
    /// Loss; absent: [`CostName::usual_loss`].
    pub loss: Option<LossName>,
    /// Obsolete key of earlier versions.
    #[serde(skip_serializing)]
    pub ransac: NoRansac,
    /// Named set of free parameters.
    pub selection: SelectionName,
    /// Parameters freed on top of the selection.
    pub free: Vec<ParameterId>,
    /// Parameters fixed in spite of the selection.
    pub fix: Vec<ParameterId>,
    /// Standard deviation of the prior at zero for each encoder harmonic \[urad\], with any selection except `thesis`.
    /// The calibration may multiply this value by a factor, common to all harmonics, that it estimates from the
    /// samples. Zero excludes the harmonics.
    pub encoder_harmonics_urad: f64,
    /// Standard deviation of the prior at zero for each wave of the bar's length by direction \[um\], with any
    /// selection except `thesis`. All waves are accepted together, and only if they improve the prediction of held-out
    /// segments of the run. Zero excludes the waves.
    pub bar_length_um: f64,
    /// Errors of the robot's axes, with any selection except `thesis`.
    pub joint_terms: JointTermsConfig,
    /// Tolerance of link parameters, as standard deviation \[mm|mrad\]. With selection `cell` it is the tolerance of the
    /// estimated link parameters, with any selection that of the fixed ones.
    pub tolerance_mm_mrad: f64,
    /// Required position error of the calibrated robot, an upper limit \[mm\]; absent: no requirement.
    pub require_mm: Option<f64>,
    /// Priors that the configuration gives to parameters by name: standard deviation of each \[mm, mrad, ms or ppm\]. The
    /// expected value is the start value of the parameter.
    pub priors: BTreeMap<ParameterId, f64>,
    /// Noise of encoder and robot angles.
    pub noise: NoiseConfig,
    /// Limits of the preparation.
    pub prepare: PrepareOptions,
}

impl Default for IdentifyConfig {
    fn default() -> Self {
        Self {
            cost: None,
            loss: None,
            ransac: NoRansac,
            selection: SelectionName::default(),
            free: Vec::new(),
            fix: Vec::new(),
            encoder_harmonics_urad: 30.0,
            bar_length_um: 10.0,
            joint_terms: JointTermsConfig::default(),
            tolerance_mm_mrad: 1.0,
            require_mm: None,
            priors: BTreeMap::new(),
            noise: NoiseConfig::default(),
            prepare: PrepareOptions::default(),
        }
    }
}

/// Whether a link parameter of the bar only defines where frames are on the bar's base or on the robot's flange.
const fn only_defines_frames(id: ParameterId) -> bool {
    const LAST: usize = BAR_JOINTS - 1;
    matches!(
        id,
        ParameterId::Bar { link: 0, parameter: LinkParameter::D } | ParameterId::Bar { link: LAST, .. }
    )
}

impl IdentifyConfig {
    /// Checks that the selection is [`SelectionName::Cell`], which calibrations require. All
    /// other selections are only for studies.
    ///
    /// # Errors
    /// [`CalibrateError::Selection`] with the name of the selection, if it is another one.
    pub fn require_usual_selection(&self) -> Result<(), CalibrateError> {
        match self.selection {
            SelectionName::Cell => Ok(()),
            other => Err(CalibrateError::Selection(other.name())),
        }
    }

    /// Sets the role of every parameter of a ball-bar model. `identifies` returns whether the cost identifies
    /// a parameter. `identifiable` lists the parameters to free if the selection depends on the poses.
    /// Candidate error terms are not freed here.
    ///
    /// # Errors
    /// [`ModelError`] for an invalid standard deviation.
    pub fn set_roles(
        &self,
        model: &mut Model,
        identifiable: &[ParameterId],
        identifies: impl Fn(ParameterId, &Chain) -> bool,
    ) -> Result<(), ModelError> {
        let robot = model.robot().clone();
        let identifies = |id| identifies(id, &robot);
        match self.selection.fixed() {
            Some(selection) => model.select(selection, |id, _| identifies(id)),
            None => model
                .free_only(|id| identifiable.contains(&id) || id.group() == Group::Clock && identifies(id)),
        }
        self.set_encoder_priors(model, identifies)?;
        if self.selection == SelectionName::Cell {
            // The rod is excluded: its length is either measured, or estimated without a tolerance.
            let has_tolerance = |id: &ParameterId| {
                let is_link = id.owner() == Owner::BallBar && id.group() == Group::Link;
                is_link && !only_defines_frames(*id) && *id != ParameterId::ROD && identifies(*id)
            };
            self.set_tolerances(model, model.ids().into_iter().filter(has_tolerance))?;
            self.set_link_roles(model)?;
        } else {
            self.set_named_roles(model)?;
        }
        self.consider_fixed(model)
    }

    /// Sets the priors of encoder offsets after a counter lost its origin, and the priors of encoder harmonics.
    fn set_encoder_priors(
        &self,
        model: &mut Model,
        identifies: impl Fn(ParameterId) -> bool,
    ) -> Result<(), ModelError> {
        let is_offset = |id: &ParameterId| matches!(id, ParameterId::EncoderOffset { .. }) && identifies(*id);
        let prior_of_offset = Role::Prior { value: 0.0, sigma: LOST_ORIGIN_SIGMA_RAD };
        model.set_roles(model.ids().into_iter().filter(is_offset), prior_of_offset)?;
        if self.selection != SelectionName::Thesis && self.encoder_harmonics_urad > 0.0 {
            let group = TermGroup::EncoderHarmonics;
            let harmonics = ParameterId::of_term(group).filter(|id| identifies(*id));
            model.set_roles(harmonics, Role::Prior { value: 0.0, sigma: self.sigma(group) })?;
        }
        Ok(())
    }

    /// Gives the role [`Role::Considered`] to fixed parameters whose uncertainty is known.
    fn consider_fixed(&self, model: &mut Model) -> Result<(), ModelError> {
        let axes = model.axes();
        for id in model.ids() {
            if model.role(id) == Some(Role::Fixed)
                && let Some(sigma) = self.uncertainty(id, axes)
            {
                model.set_role(id, Role::Considered { sigma })?;
            }
        }
        Ok(())
    }

    /// Sets the roles of the robot's link parameters, which do not depend on the instrument. Each link parameter gets a
    /// prior at its nominal value, with the tolerance as standard deviation. Link parameters that only define frames stay
    /// fixed. Those of the last link are not changed, because they belong to the mounted instrument. Roles that the
    /// configuration sets by name are applied last.
    ///
    /// # Errors
    /// [`ModelError`] for an invalid standard deviation.
    pub(crate) fn set_link_roles(&self, model: &mut Model) -> Result<(), ModelError> {
        let last = model.axes().saturating_sub(1);
        let of_links = |id: &ParameterId| matches!(id, ParameterId::Robot { link, .. } if *link < last);
        model.set_roles(model.ids().into_iter().filter(of_links), Role::Fixed)?;
        let free = link_ids(&model.geometry(&[]).robot);
        self.set_tolerances(model, free.iter().copied())?;
        self.set_named_roles(model)?;
        for id in free {
            // The configuration fixes this link parameter by name.
            if model.role(id) == Some(Role::Fixed) {
                self.consider(model, id)?;
            }
        }
        Ok(())
    }

    /// Fixes a link parameter at its value and considers its uncertainty. The uncertainty is the one that the configuration
    /// states for the parameter by name, otherwise the tolerance.
    pub(crate) fn consider(&self, model: &mut Model, id: ParameterId) -> Result<(), ModelError> {
        let sigma = self.stated(id).unwrap_or_else(|| self.tolerance());
        model.set_role(id, Role::Considered { sigma })
    }

    /// Standard deviation that the configuration states for this parameter by name, SI.
    fn stated(&self, id: ParameterId) -> Option<f64> {
        Some(self.priors.get(&id)? / id.unit().display_factor())
    }

    /// Tolerance of link parameters, as standard deviation \[m, rad\].
    fn tolerance(&self) -> f64 {
        self.tolerance_mm_mrad * 1e-3
    }

    /// Sets priors at the nominal values, with the tolerance as standard deviation.
    fn set_tolerances(
        &self,
        model: &mut Model,
        ids: impl Iterator<Item = ParameterId>,
    ) -> Result<(), ModelError> {
        for id in ids {
            let Some(value) = model.parameter(id).map(|parameter| parameter.nominal) else { continue };
            model.set_role(id, Role::Prior { value, sigma: self.tolerance() })?;
        }
        Ok(())
    }

    /// Sets the roles that the configuration sets by name.
    fn set_named_roles(&self, model: &mut Model) -> Result<(), ModelError> {
        for (&id, sigma) in &self.priors {
            let Some(value) = model.parameter(id).map(|parameter| parameter.value) else { continue };
            model.set_role(id, Role::Prior { value, sigma: sigma / id.unit().display_factor() })?;
        }
        for (ids, role) in [(&self.free, Role::Free), (&self.fix, Role::Fixed)] {
            model.set_roles(model.ids().into_iter().filter(|id| ids.contains(id)), role)?;
        }
        Ok(())
    }

    /// Checks that each parameter that the configuration names exists in at least one model.
    ///
    /// # Errors
    /// [`ModelError`] with the name of a parameter that does not exist.
    pub(crate) fn require_known<'m>(
        &self,
        models: impl Iterator<Item = &'m Model> + Clone,
    ) -> Result<(), ModelError> {
        for id in self.named() {
            // Models without a ball-bar do not contain joint waves yet: they are added later.
            let is_wave = matches!(id, ParameterId::JointWave { .. });
            if !is_wave && models.clone().all(|model| model.parameter(id).is_none()) {
                return Err(ModelError::NotInModel { id });
            }
        }
        Ok(())
    }

    /// Known lengths of a bar on a robot with `axes` axes, with their standard uncertainties \[m\]. A length is omitted if
    /// the configuration frees it or gives it a prior by name.
    pub fn known_length_sigmas_m(&self, bar: &BallBarConfig, axes: usize) -> Vec<(ParameterId, f64)> {
        let u_um = |id| if id == ParameterId::ROD { bar.length_u_um } else { Some(bar.plate_u_um) };
        let is_open = |id: &ParameterId| !self.free.contains(id) && !self.priors.contains_key(id);
        let known = ParameterId::known_lengths(axes).into_iter().filter(is_open);
        known.filter_map(|id| Some((id, u_um(id).filter(|u_um| *u_um > 0.0)? * 1e-6))).collect()
    }

    /// Standard deviation of a fixed parameter, SI. `None` if no uncertainty is stated, or if the value is
    /// arbitrary because it only defines a frame. The uncertainty of the plate is not included here, because
    /// the bar's configuration states it.
    fn uncertainty(&self, id: ParameterId, axes: usize) -> Option<f64> {
        if let Some(sigma) = self.stated(id) {
            return Some(sigma);
        }
        // Whether the link parameter is a dimension of a real part. The other link parameters only define a frame.
        let is_dimension = match (self.selection, id) {
            // `set_link_roles` has set the uncertainty of the other links. Parameters that it left fixed
            // only define a frame.
            (SelectionName::Cell, ParameterId::Robot { link, .. }) => {
                link + 1 == axes && id != ParameterId::plate(axes)
            }
            (SelectionName::Cell, _) => !only_defines_frames(id),
            _ => !thesis_fixed(axes).contains(&id),
        };
        match id.group() {
            Group::Link if is_dimension => Some(self.tolerance()),
            Group::Term(group) if self.fix.contains(&id) => Some(self.sigma(group)),
            _ if matches!(id, ParameterId::BaseRotation { .. }) => Some(BASE_TILT_SIGMA_RAD),
            _ => None,
        }
    }

    /// Frees a parameter that a measured force determines, unless the configuration fixes it or gives it a prior.
    ///
    /// # Errors
    /// [`ModelError::NotInModel`] if the model does not contain the parameter.
    pub fn free_for_force(&self, model: &mut Model, id: ParameterId) -> Result<(), ModelError> {
        if self.fix.contains(&id) || self.priors.contains_key(&id) {
            return Ok(());
        }
        model.set_role(id, Role::Free)
    }

    /// Parameters that the configuration frees, fixes or gives a prior by name.
    pub fn named(&self) -> impl Iterator<Item = ParameterId> + '_ {
        self.priors.keys().chain(&self.free).chain(&self.fix).copied()
    }

    /// Harmonics of the bar's encoders, except those that the configuration names. The standard deviations of
    /// their priors have a common factor.
    pub(crate) fn harmonics(&self) -> impl Iterator<Item = ParameterId> + '_ {
        let harmonics = ParameterId::of_term(TermGroup::EncoderHarmonics);
        harmonics.filter(|id| !self.named().any(|named| named == *id))
    }

    /// Standard deviation of the prior of a group of terms, SI.
    pub(super) fn sigma(&self, group: TermGroup) -> f64 {
        let terms = &self.joint_terms;
        1e-6 * match group {
            TermGroup::Ratio => terms.ratio_ppm,
            TermGroup::Delay => 1e3 * terms.delay_ms,
            TermGroup::Compliance => terms.compliance_urad_per_m,
            TermGroup::BarLength => self.bar_length_um,
            TermGroup::EncoderHarmonics => self.encoder_harmonics_urad,
            _ => terms.amplitude_urad,
        }
    }
}

fn positive(key: String, value: f64) -> Result<(), Violation> {
    let problem = format!("invalid standard deviation {value}");
    Violation::unless(value.is_finite() && value > 0.0, key, problem, "give a number above zero")
}

/// Checks the ranges of the preparation's options. Values outside these ranges would disable a check or reject all data.
fn validate_preparation(prepare: &PrepareOptions) -> Result<(), Violation> {
    /// Minimum number of samples: twice the number of parameters of robot, bar and clocks.
    const POINTS_MIN: usize = 100;
    for (key, value, [low, high]) in [
        ("correlation_min", prepare.correlation_min, [0.0, 1.0]),
        ("overlap_min_s", prepare.overlap_min_s, [0.0, 86_400.0]),
        ("overlap_min_part", prepare.overlap_min_part, [0.0, 1.0]),
        ("spread_max_mrad", prepare.spread_max_mrad, [0.01, 3000.0]),
        ("sphere_tolerance_mm", prepare.sphere_tolerance_mm, [0.01, 1000.0]),
        ("length_tolerance_mm", prepare.length_tolerance_mm, [0.01, 1000.0]),
        ("singular_margin_deg", prepare.singular_margin_deg, [0.0, 60.0]),
        ("motion_min_mrad", prepare.motion_min_mrad, [0.0, 1000.0]),
        ("moving_average_ms", prepare.moving_average_ms, [0.0, 10_000.0]),
        ("fit_max_mrad", prepare.fit_max_mrad, [0.01, 3000.0]),
        ("joint_travel_min_deg", prepare.joint_travel_min_deg, [0.0, 360.0]),
        ("slip_min_mrad", prepare.slip_min_mrad, [0.001, 1000.0]),
    ] {
        let (key, problem) = (format!("prepare.{key}"), format!("{value} is out of range"));
        let remedy = format!("give a number from {low} to {high}");
        // The condition is written as a test for values inside the range, so that NaN is rejected, too.
        Violation::unless((low..=high).contains(&value), key, problem, remedy)?;
    }
    let problem = format!("{} samples are too few", prepare.points_max);
    let remedy = format!("give {POINTS_MIN} or more, or 0 for all");
    let are_enough = prepare.points_max == 0 || prepare.points_max >= POINTS_MIN;
    Violation::unless(are_enough, "prepare.points_max", problem, remedy)
}

impl Validate for IdentifyConfig {
    fn validate(&self) -> Result<(), Violation> {
        self.validate_names()?;
        self.validate_sigmas()?;
        validate_preparation(&self.prepare)?;
        for (key, sigma) in
            [("encoder_harmonics_urad", self.encoder_harmonics_urad), ("bar_length_um", self.bar_length_um)]
        {
            let problem = format!("invalid standard deviation {sigma}");
            let remedy = "give a number above zero, or zero to leave these errors out";
            Violation::unless(sigma.is_finite() && sigma >= 0.0, key, problem, remedy)?;
        }
        Ok(())
    }
}

impl IdentifyConfig {
    /// A parameter must not be both free and fixed. Each prior by name must have a standard deviation above zero.
    fn validate_names(&self) -> Result<(), Violation> {
        let unless_free = |key: &str, id: &ParameterId| {
            let problem = format!("`{id}` is also in `free`");
            Violation::unless(!self.free.contains(id), key, problem, "remove one of the two")
        };
        for (index, id) in self.fix.iter().enumerate() {
            unless_free(&format!("fix[{index}]"), id)?;
        }
        self.priors.iter().try_for_each(|(id, sigma)| {
            let key = format!("priors.{id}");
            unless_free(&key, id)?;
            positive(key, *sigma)
        })
    }

    /// The required error and all standard deviations must be above zero. Exceptions are the standard deviations for
    /// which zero excludes a group of terms.
    fn validate_sigmas(&self) -> Result<(), Violation> {
        positive("tolerance_mm_mrad".into(), self.tolerance_mm_mrad)?;
        if let Some(require_mm) = self.require_mm {
            let problem = format!("invalid position error {require_mm}");
            let remedy = "give the largest allowed error in millimetres, above zero";
            Violation::unless(require_mm.is_finite() && require_mm > 0.0, "require_mm", problem, remedy)?;
        }
        let terms = &self.joint_terms;
        positive("joint_terms.amplitude_urad".into(), terms.amplitude_urad)?;
        positive("joint_terms.ratio_ppm".into(), terms.ratio_ppm)?;
        positive("joint_terms.delay_ms".into(), terms.delay_ms)?;
        positive("joint_terms.compliance_urad_per_m".into(), terms.compliance_urad_per_m)?;
        positive("noise.encoder_urad".into(), self.noise.encoder_urad)?;
        positive("noise.robot_urad".into(), self.noise.robot_urad)
    }
}
