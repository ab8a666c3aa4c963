//! `config/identify.toml`: what to minimise, what is free, and the limits of the preparation.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use shared::config::{BallBarConfig, Validate, Violation};

use super::error::CalibrateError;
use super::selection::links::link_ids;
use super::selection::terms::CandidateGroup;
use crate::instrument::{CostName, NoiseConfig};
use crate::kinematics::{BAR_JOINTS, LinkParameter};
use crate::model::{Group, Model, ModelError, Owner, ParameterId, Role, Selection, THESIS_FIXED, TermGroup};
use crate::prepare::PrepareOptions;
use crate::solver::LossName;

/// Zeros after a loss of a counter's origin start where the preparation found them, on nominal geometry. Far more than it
/// errs, so that samples decide; a segment that is held out with all samples of an origin leaves them there \[rad\].
const ZERO_SIGMA_RAD: f64 = 0.01;
/// How far the bar's base may lean where that is not estimated: one that is set up by eye \[rad\].
const BASE_TILT_SIGMA_RAD: f64 = 5e-3;

/// Named sets of free parameters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SelectionName {
    /// The thesis' 38 and the clocks.
    Thesis,
    /// Every number of the links, each expected at its nominal value within the tolerance, which is widened where held-out
    /// samples are predicted better; and where the instrument stands and how it is mounted.
    #[default]
    #[serde(alias = "automatic")]
    Cell,
    /// All that the poses determine, without priors: of each dependent group the parameter that is best fixed is left out.
    AllIdentifiable,
}

impl SelectionName {
    /// As configurations write it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Thesis => "thesis",
            Self::Cell => "cell",
            Self::AllIdentifiable => "all_identifiable",
        }
    }

    /// The set, where it does not depend on the poses.
    pub const fn fixed(self) -> Option<Selection> {
        match self {
            Self::Thesis => Some(Selection::ThesisWithClocks),
            Self::Cell => Some(Selection::CellWithClocks),
            Self::AllIdentifiable => None,
        }
    }
}

/// Errors of the robot's axes that repeat with the motion, and how large they are expected to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct JointTermsConfig {
    /// Kinds that are tried; each stays only where it predicts held-out segments of the run better.
    pub candidates: Vec<TermGroup>,
    /// Amplitude of each wave and half of each backlash: zero within this standard deviation \[urad\].
    pub amplitude_urad: f64,
    /// Error of each ratio \[ppm\].
    pub ratio_ppm: f64,
    /// By how much the log has one joint later than the others \[ms\].
    pub delay_ms: f64,
    /// How much an axis deflects for each metre of its load's lever \[urad/m\].
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

/// Starts from random subsets of the samples are no longer made; files that say `ransac = false` are still read.
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

/// How to calibrate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IdentifyConfig {
    /// Cost; absent: the best that the encoders allow.
    pub cost: Option<CostName>,
    /// Loss; absent: [`CostName::usual_loss`].
    pub loss: Option<LossName>,
    /// What earlier versions had here.
    #[serde(skip_serializing)]
    pub ransac: NoRansac,
    /// Free parameters.
    pub selection: SelectionName,
    /// Parameters freed on top of the selection.
    pub free: Vec<String>,
    /// Parameters fixed all the same.
    pub fix: Vec<String>,
    /// With any selection but `thesis`, each harmonic of an encoder is expected to be zero within this standard deviation
    /// \[urad\], or as much less as the samples say of all of them; zero leaves them out.
    pub encoder_harmonics_urad: f64,
    /// With any selection but `thesis`, how much longer or shorter the bar may be by its direction: each wave is expected
    /// to be zero within this standard deviation \[um\], and all stay only where they predict held-out segments of the
    /// run better; zero leaves them out.
    pub bar_length_um: f64,
    /// Errors of the robot's axes, with any selection but `thesis`.
    pub joint_terms: JointTermsConfig,
    /// The tolerance of the links' numbers, one standard deviation: with selection `cell` of those that are estimated, with any of
    /// those that are fixed \[mm|mrad\].
    pub tolerance_mm_mrad: f64,
    /// Position error that the calibrated robot may have at most; absent: none is required \[mm\].
    pub require_mm: Option<f64>,
    /// Parameters expected at their starting value within a standard deviation \[mm, mrad, ms or ppm\].
    pub priors: BTreeMap<String, f64>,
    /// What angles are worth.
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

/// A number of the bar's links that only says where its frames are, on its base and on the robot's flange.
const fn says_where_frames_are(id: ParameterId) -> bool {
    const LAST: usize = BAR_JOINTS - 1;
    matches!(
        id,
        ParameterId::Bar { link: 0, parameter: LinkParameter::D } | ParameterId::Bar { link: LAST, .. }
    )
}

impl IdentifyConfig {
    /// What is free follows from tolerances and names, as calibrations have it; other selections are for the estimators of studies.
    ///
    /// # Errors
    /// [`CalibrateError::Selection`].
    pub fn require_usual_selection(&self) -> Result<(), CalibrateError> {
        match self.selection {
            SelectionName::Cell => Ok(()),
            other => Err(CalibrateError::Selection(other.name())),
        }
    }

    /// Gives every parameter of a model with a ball-bar its role for a cost that identifies what `identifies` says. `identifiable`
    /// is the set of a selection that depends on the poses. Terms that are candidates are left out.
    ///
    /// # Errors
    /// [`ModelError`] where a name or a standard deviation makes no sense.
    pub fn set_roles(
        &self,
        model: &mut Model,
        identifiable: &[ParameterId],
        identifies: impl Fn(ParameterId) -> bool,
    ) -> Result<(), ModelError> {
        match self.selection.fixed() {
            Some(selection) => model.select(selection, &identifies),
            None => model
                .free_only(|id| identifiable.contains(&id) || id.group() == Group::Clock && identifies(id)),
        }
        let zeros = model.ids().into_iter();
        let zeros: Vec<ParameterId> =
            zeros.filter(|id| matches!(id, ParameterId::EncoderOffset { .. }) && identifies(*id)).collect();
        model.set_roles(zeros, Role::Prior { value: 0.0, sigma: ZERO_SIGMA_RAD })?;
        if self.selection != SelectionName::Thesis && self.encoder_harmonics_urad > 0.0 {
            let group = TermGroup::EncoderHarmonics;
            let harmonics = ParameterId::of_term(group).filter(|id| identifies(*id));
            model.set_roles(harmonics, Role::Prior { value: 0.0, sigma: self.sigma(group) })?;
        }
        if self.selection == SelectionName::Cell {
            // The rod is measured, or found.
            let of_bar = |id: &ParameterId| {
                let is_link = id.owner() == Owner::BallBar && id.group() == Group::Link;
                is_link && !says_where_frames_are(*id) && *id != ParameterId::ROD && identifies(*id)
            };
            self.set_tolerances(model, model.ids().into_iter().filter(of_bar).collect())?;
            self.set_link_roles(model)?;
        } else {
            self.set_named_roles(model)?;
        }
        let fixed = model.parameters().iter().filter(|parameter| parameter.role == Role::Fixed);
        let fixed: Vec<ParameterId> = fixed.map(|parameter| parameter.id).collect();
        let axes = model.axes();
        for (id, sigma) in fixed.into_iter().filter_map(|id| Some((id, self.uncertainty(id, axes)?))) {
            model.set_role(id, Role::Considered { sigma })?;
        }
        Ok(())
    }

    /// Gives the numbers of the robot's links their roles, the same whatever measures its end: each is expected at its nominal
    /// value within the tolerance. Those of the last link belong to what is mounted there and stay as they are; those that only say
    /// where frames are stay fixed. Then come those parameters of the model that have a role by name.
    ///
    /// # Errors
    /// [`ModelError`] where a name or a standard deviation makes no sense.
    pub(crate) fn set_link_roles(&self, model: &mut Model) -> Result<(), ModelError> {
        let last = model.axes().saturating_sub(1);
        let of_links = |id: &ParameterId| matches!(id, ParameterId::Robot { link, .. } if *link < last);
        model.set_roles(model.ids().into_iter().filter(of_links), Role::Fixed)?;
        let free = link_ids(&model.geometry(&[]).robot);
        self.set_tolerances(model, free.clone())?;
        self.set_named_roles(model)?;
        let fixed = |id: &ParameterId| {
            free.contains(id) && model.parameter(*id).is_some_and(|one| one.role == Role::Fixed)
        };
        let fixed: Vec<ParameterId> = free.iter().copied().filter(fixed).collect();
        fixed.into_iter().try_for_each(|id| self.consider(model, id))
    }

    /// Keeps a number of a link at its value, which may be wrong by its tolerance.
    pub(crate) fn consider(&self, model: &mut Model, id: ParameterId) -> Result<(), ModelError> {
        let sigma = self.stated(id).unwrap_or_else(|| self.tolerance());
        model.set_role(id, Role::Considered { sigma })
    }

    /// Standard deviation that is stated of a parameter by name, SI.
    fn stated(&self, id: ParameterId) -> Option<f64> {
        Some(self.priors.get(&id.to_string())? / id.unit().display_factor())
    }

    /// One standard deviation \[m, rad\].
    fn tolerance(&self) -> f64 {
        self.tolerance_mm_mrad * 1e-3
    }

    /// Expects parameters at their nominal values within the tolerance.
    fn set_tolerances(&self, model: &mut Model, ids: Vec<ParameterId>) -> Result<(), ModelError> {
        for id in ids {
            let Some(value) = model.parameter(id).map(|parameter| parameter.nominal) else { continue };
            model.set_role(id, Role::Prior { value, sigma: self.tolerance() })?;
        }
        Ok(())
    }

    /// Gives those parameters of a model their roles that have one by name.
    fn set_named_roles(&self, model: &mut Model) -> Result<(), ModelError> {
        for (name, sigma) in &self.priors {
            let id: ParameterId = name.parse()?;
            let Some(value) = model.parameter(id).map(|parameter| parameter.value) else { continue };
            model.set_role(id, Role::Prior { value, sigma: sigma / id.unit().display_factor() })?;
        }
        for (names, role) in [(&self.free, Role::Free), (&self.fix, Role::Fixed)] {
            for name in names {
                let id: ParameterId = name.parse()?;
                if model.parameter(id).is_some() {
                    model.set_role(id, role)?;
                }
            }
        }
        Ok(())
    }

    /// Every parameter that has a role by name is one of some of the models.
    ///
    /// # Errors
    /// [`ModelError`] names one that is not.
    pub(crate) fn require_known<'m>(
        &self,
        models: impl Iterator<Item = &'m Model> + Clone,
    ) -> Result<(), ModelError> {
        for name in self.priors.keys().chain(&self.free).chain(&self.fix) {
            let id: ParameterId = name.parse()?;
            let is_wave = matches!(id, ParameterId::JointWave { .. });
            if !is_wave && models.clone().all(|model| model.parameter(id).is_none()) {
                return Err(ModelError::NotInModel { id });
            }
        }
        Ok(())
    }

    /// Known lengths of a bar on a robot of `axes` axes, with their standard uncertainties \[m\], but for those that are
    /// free by name or have a prior.
    pub fn known_lengths_m(&self, bar: &BallBarConfig, axes: usize) -> Vec<(ParameterId, f64)> {
        let u_um = |id| if id == ParameterId::ROD { bar.length_u_um } else { Some(bar.plate_u_um) };
        let is_open = |name: String| !self.free.contains(&name) && !self.priors.contains_key(&name);
        let known = ParameterId::known_lengths(axes).into_iter().filter(|id| is_open(id.to_string()));
        known.filter_map(|id| Some((id, u_um(id).filter(|u_um| *u_um > 0.0)? * 1e-6))).collect()
    }

    /// How uncertain the value of a parameter is that stays fixed, SI; none where nothing is stated, and of those that say
    /// where frames are, whose values are a matter of choice. The plate's is in the bar's configuration.
    fn uncertainty(&self, id: ParameterId, axes: usize) -> Option<f64> {
        let name = id.to_string();
        if let Some(sigma) = self.stated(id) {
            return Some(sigma);
        }
        let is_made = match (self.selection, id) {
            // Where the robot's links have their roles they have this, too, but for the last one.
            (SelectionName::Cell, ParameterId::Robot { link, .. }) => {
                link + 1 == axes && id != ParameterId::plate(axes)
            }
            (SelectionName::Cell, _) => !says_where_frames_are(id),
            _ => !THESIS_FIXED.contains(&name.as_str()),
        };
        match id.group() {
            Group::Link if is_made => Some(self.tolerance()),
            Group::Term(group) if self.fix.contains(&name) => Some(self.sigma(group)),
            _ if matches!(id, ParameterId::BaseRotation { .. }) => Some(BASE_TILT_SIGMA_RAD),
            _ => None,
        }
    }
}

impl IdentifyConfig {
    /// Frees what a force determines, unless it is fixed or has a prior.
    ///
    /// # Errors
    /// [`ModelError::NotInModel`].
    pub fn free_for_force(&self, model: &mut Model, id: ParameterId) -> Result<(), ModelError> {
        let name = id.to_string();
        if self.fix.contains(&name) || self.priors.contains_key(&name) {
            return Ok(());
        }
        model.set_role(id, Role::Free)
    }

    /// Parameters that are freed, fixed or given a prior by name, as far as such names exist.
    pub fn named(&self) -> impl Iterator<Item = ParameterId> + '_ {
        let names = self.priors.keys().chain(&self.free).chain(&self.fix);
        names.filter_map(|name| name.parse().ok())
    }

    /// Parameters that are fixed by name, as far as such names exist.
    pub(crate) fn fixed(&self) -> Vec<ParameterId> {
        self.fix.iter().filter_map(|name| name.parse().ok()).collect()
    }

    /// Harmonics of the bar's encoders that nobody has named.
    pub fn alike(&self) -> impl Iterator<Item = ParameterId> + '_ {
        let harmonics = ParameterId::of_term(TermGroup::EncoderHarmonics);
        harmonics.filter(|id| !self.named().any(|named| named == *id))
    }

    /// Kinds of terms that are tried on top of the selection.
    pub fn candidates(&self) -> Vec<TermGroup> {
        let mut groups = match self.selection {
            SelectionName::Thesis => Vec::new(),
            _ => self.joint_terms.candidates.clone(),
        };
        if self.selection != SelectionName::Thesis && self.bar_length_um > 0.0 {
            groups.push(TermGroup::BarLength);
        }
        groups
    }

    /// [`Self::candidates`] with those of a model's parameters that its samples determine and nobody has freed or fixed by name.
    pub fn groups(&self, model: &Model, identifies: impl Fn(ParameterId) -> bool) -> Vec<CandidateGroup> {
        let group = |group: TermGroup| {
            let open = model
                .parameters()
                .iter()
                .filter(|one| one.id.term() == Some(group) && one.role == Role::Fixed && identifies(one.id));
            let ids = open.map(|one| one.id).filter(|id| !self.fix.contains(&id.to_string())).collect();
            let scales = group.scales().to_vec();
            CandidateGroup { group, name: group.name().into(), ids, sigma: self.sigma(group), scales }
        };
        self.candidates()
            .into_iter()
            .map(group)
            .filter(|group| group.group == TermGroup::LineSpectrum || !group.ids.is_empty())
            .collect()
    }

    /// Standard deviation of the prior of a term, SI.
    fn sigma(&self, group: TermGroup) -> f64 {
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
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    Err(Violation::new(key, format!("{value} is no standard deviation"), "give a number above zero"))
}

/// What lies outside decides nothing, or leaves nothing to decide on.
fn validate_preparation(prepare: &PrepareOptions) -> Result<(), Violation> {
    /// Fewer samples than twice the parameters of robot, bar and clocks determine none of them.
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
        // A range that contains the value: NaN fails too.
        if !(low..=high).contains(&value) {
            let remedy = format!("give a number from {low} to {high}");
            return Err(Violation::new(format!("prepare.{key}"), format!("{value} is out of range"), remedy));
        }
    }
    if (1..POINTS_MIN).contains(&prepare.points_max) {
        let problem = format!("{} samples determine nothing", prepare.points_max);
        let remedy = format!("give {POINTS_MIN} or more, or 0 for all");
        return Err(Violation::new("prepare.points_max", problem, remedy));
    }
    Ok(())
}

impl Validate for IdentifyConfig {
    fn validate(&self) -> Result<(), Violation> {
        let known = |key: String, name: &String| {
            let parsed = name.parse::<ParameterId>();
            parsed.map(drop).map_err(|error| Violation::new(key, error.to_string(), "correct the name"))
        };
        for (key, names) in [("free", &self.free), ("fix", &self.fix)] {
            for (index, name) in names.iter().enumerate() {
                known(format!("{key}[{index}]"), name)?;
            }
        }
        if let Some((index, name)) = self.fix.iter().enumerate().find(|(_, name)| self.free.contains(name)) {
            let problem = format!("`{name}` is in free as well");
            return Err(Violation::new(format!("fix[{index}]"), problem, "leave it out of one"));
        }
        for (name, &sigma) in &self.priors {
            known(format!("priors.{name}"), name)?;
            positive(format!("priors.{name}"), sigma)?;
        }
        positive("tolerance_mm_mrad".into(), self.tolerance_mm_mrad)?;
        if let Some(require_mm) =
            self.require_mm.filter(|require_mm| !(require_mm.is_finite() && *require_mm > 0.0))
        {
            return Err(Violation::new(
                "require_mm",
                format!("{require_mm} is no error"),
                "give millimetres above zero",
            ));
        }
        let terms = &self.joint_terms;
        positive("joint_terms.amplitude_urad".into(), terms.amplitude_urad)?;
        positive("joint_terms.ratio_ppm".into(), terms.ratio_ppm)?;
        positive("joint_terms.delay_ms".into(), terms.delay_ms)?;
        positive("joint_terms.compliance_urad_per_m".into(), terms.compliance_urad_per_m)?;
        positive("noise.encoder_urad".into(), self.noise.encoder_urad)?;
        positive("noise.robot_urad".into(), self.noise.robot_urad)?;
        validate_preparation(&self.prepare)?;
        for (key, sigma) in
            [("encoder_harmonics_urad", self.encoder_harmonics_urad), ("bar_length_um", self.bar_length_um)]
        {
            if !(sigma.is_finite() && sigma >= 0.0) {
                let found = format!("{sigma} is no standard deviation");
                return Err(Violation::new(key, found, "give zero or a number above"));
            }
        }
        Ok(())
    }
}
