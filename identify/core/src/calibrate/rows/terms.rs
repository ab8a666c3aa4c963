//! Candidate groups of joint errors for files of rows, in which the robot is at rest in each pose; without a ball-bar. Each group
//! has candidate standard deviations of its prior. `selection::choose` tries the groups.

use crate::calibrate::selection::terms::CandidateGroup;
use crate::model::{ParameterId, TermGroup, Waves};

fn joint_terms(wanted: &[TermGroup]) -> Vec<ParameterId> {
    ParameterId::all().filter(|id| id.term().is_some_and(|group| wanted.contains(&group))).collect()
}

/// Groups of joint errors, restricted to the parameters for which `offered` is true.
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

/// Bands of waves per turn that are tried together: eccentric gears, encoders and flexsplines, fine teeth.
const BANDS: [std::ops::RangeInclusive<u8>; 3] =
    [*Waves::OF_AXIS.start()..=10, 11..=30, 31..=*Waves::OF_AXIS.end()];

/// The waves of a band up to order `last`; `None` if there are none.
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
