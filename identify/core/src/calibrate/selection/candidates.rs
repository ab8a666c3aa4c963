//! The groups of optional error terms that a calibration tries. If there is a ball-bar, the configuration
//! defines them. If there are only files of rows, in which the robot stands still at each row, this file
//! defines them. `choose` tries the groups.

use super::terms::CandidateGroup;
use crate::calibrate::rows::WAVES_PER_TURN_MAX;
use crate::calibrate::{CalibrateError, DataSets, IdentifyConfig, SelectionName};
use crate::instrument::Run;
use crate::model::{Model, ParameterId, Phase, Role, TermGroup, Waves};

/// Groups of terms to try. Without a ball-bar, waves of the robot's axes are added to the models. The number of
/// rows limits their order.
pub(in crate::calibrate) fn candidate_groups(
    data: &DataSets<'_>,
    runs: &mut [Run],
    config: &IdentifyConfig,
) -> Result<Vec<CandidateGroup>, CalibrateError> {
    let Some(Run { instrument, model }) = runs.first() else { return Ok(Vec::new()) };
    if !data.bars.is_empty() {
        return Ok(config.groups(model, |id| instrument.identifies(id, model.robot())));
    }
    let axes = model.axes();
    let values_of_run =
        |run: &Run| Ok(run.instrument.samples() * run.instrument.data_set(&run.model, 1.0)?.rows());
    let values = runs.iter().map(values_of_run).sum::<Result<_, CalibrateError>>()?;
    let stated_order_max = data.rows.iter().filter_map(|file| file.joint_waves).min();
    let order_max = stated_order_max.unwrap_or_else(|| waves_per_turn(values, axes));
    for run in &mut *runs {
        run.model = run.model.clone().with(ParameterId::joint_waves(order_max));
    }
    let in_a_model = |id: &ParameterId| runs.iter().any(|run| run.model.parameter(*id).is_some());
    let is_wanted = |id: &ParameterId| {
        id.term().is_some_and(|term| config.joint_terms.candidates.contains(&term))
            && !config.named().any(|named| named == *id)
    };
    Ok(groups(order_max, |id| in_a_model(id) && is_wanted(id)))
}

/// Highest order of joint waves to try. There are at least four measured values for each amplitude of each axis. More
/// amplitudes could not be confirmed by left-out groups.
fn waves_per_turn(measured: usize, axes: usize) -> u8 {
    const MEASURED_PER_WAVE: usize = 4;
    let orders = measured / (MEASURED_PER_WAVE * Phase::ALL.len() * axes.max(1));
    u8::try_from(orders).unwrap_or(u8::MAX).min(WAVES_PER_TURN_MAX)
}

impl IdentifyConfig {
    /// Groups of terms to try in addition to the parameters of the selection.
    pub fn candidates(&self) -> Vec<TermGroup> {
        if self.selection == SelectionName::Thesis {
            return Vec::new();
        }
        let mut groups = self.joint_terms.candidates.clone();
        if self.bar_length_um > 0.0 {
            groups.push(TermGroup::BarLength);
        }
        groups
    }

    /// [`Self::candidates`] with their parameters in the model. A parameter is omitted if the samples do not determine it,
    /// or if the configuration frees or fixes it by name.
    pub fn groups(&self, model: &Model, identifies: impl Fn(ParameterId) -> bool) -> Vec<CandidateGroup> {
        let group = |group: TermGroup| {
            let open = model
                .parameters()
                .iter()
                .filter(|one| one.id.term() == Some(group) && one.role == Role::Fixed && identifies(one.id));
            let ids = open.map(|one| one.id).filter(|id| !self.fix.contains(id)).collect();
            let scales = group.scales().to_vec();
            CandidateGroup { group, name: group.name().into(), ids, sigma: self.sigma(group), scales }
        };
        self.candidates()
            .into_iter()
            .map(group)
            .filter(|group| group.group == TermGroup::LineSpectrum || !group.ids.is_empty())
            .collect()
    }
}

fn joint_terms(wanted: &[TermGroup]) -> Vec<ParameterId> {
    ParameterId::all().filter(|id| id.term().is_some_and(|group| wanted.contains(&group))).collect()
}

/// Groups of joint error terms for files of rows. They contain only parameters for which `offered` returns true, and waves
/// up to the order `waves_last`. Each group is tried with several standard deviations of its prior.
pub(crate) fn groups(waves_last: u8, offered: impl Fn(&ParameterId) -> bool) -> Vec<CandidateGroup> {
    const ANGLES_RAD: &[f64] = &[20e-6, 100e-6, 500e-6];
    const RATIOS: &[f64] = &[20e-6, 100e-6, 500e-6];
    use TermGroup::{Backlash, Compliance, GearOnce, GearTwice, Joint, Ratio};
    let group = |groups: &[TermGroup], name: &str, sigmas: &[f64]| {
        candidate_group(groups[0], name.into(), joint_terms(groups), sigmas)
    };
    let mut groups = vec![
        group(&[GearOnce, GearTwice], "waves once and twice per turn", ANGLES_RAD),
        group(&[Joint], "waves of joints beside their drives", ANGLES_RAD),
        group(&[Backlash], "backlash by direction of approach", ANGLES_RAD),
        group(&[Ratio], "transmission ratio", RATIOS),
        group(&[Compliance], "compliance under gravity", &[100e-6, 1e-3, 1e-2]),
    ];
    groups.extend(BANDS.iter().filter_map(|band| waves_of_band(band, waves_last)));
    groups.iter_mut().for_each(|group| group.ids.retain(&offered));
    groups.retain(|group| !group.ids.is_empty());
    groups
}

/// Bands of waves per turn. The waves of a band are tried together. Typical causes of the three bands: eccentric gears;
/// encoders and flexsplines; fine teeth.
const BANDS: [std::ops::RangeInclusive<u8>; 3] =
    [*Waves::OF_AXIS.start()..=10, 11..=30, 31..=*Waves::OF_AXIS.end()];

/// The waves of a band up to the order `last`. `None` if the band begins above `last`.
fn waves_of_band(band: &std::ops::RangeInclusive<u8>, last: u8) -> Option<CandidateGroup> {
    const SIGMAS_RAD: &[f64] = &[10e-6, 20e-6, 50e-6, 100e-6];
    let (first, last) = (*band.start(), last.min(*band.end()));
    let within = |id: &ParameterId| matches!(id, ParameterId::JointWave { order, .. } if *order >= first);
    let ids: Vec<ParameterId> = ParameterId::joint_waves(last).filter(within).collect();
    let name = format!("{first} to {last} waves per turn");
    (!ids.is_empty()).then(|| candidate_group(TermGroup::LineSpectrum, name, ids, SIGMAS_RAD))
}

fn candidate_group(group: TermGroup, name: String, ids: Vec<ParameterId>, sigmas: &[f64]) -> CandidateGroup {
    let first = sigmas.first().copied().unwrap_or(1.0);
    CandidateGroup {
        group,
        name,
        ids,
        sigma: first,
        scales: sigmas.iter().map(|sigma| sigma / first).collect(),
    }
}
