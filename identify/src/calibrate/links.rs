//! Which numbers of a robot's links are free where other instruments than the ball-bar measure its end.

use crate::kinematics::{Chain, LinkParameter};
use crate::model::{Model, ModelError, ParameterId, Role, Unit};

/// What the links are freed to do: 4 numbers of each, by the two axes that it joins.
///
/// The first link's `d` and `theta` are the tracker's place, the last link is the probe's mounting. Between nearly
/// parallel axes `d` has no value and Hayati's `beta` takes its place; a length along such axes is told once, by the `d`
/// of the link after them.
fn link_parameters(link: usize, links: usize, alpha_rad: f64) -> &'static [LinkParameter] {
    use LinkParameter::{A, Alpha, Beta, D, Theta};
    /// Less than this from parallel.
    const PARALLEL: f64 = 0.1;
    if link + 1 == links {
        return &[];
    }
    match (link, alpha_rad.sin().abs() < PARALLEL) {
        (0, false) => &[A, Alpha],
        (0, true) => &[A, Alpha, Beta],
        (_, false) => &[A, D, Alpha, Theta],
        (_, true) => &[A, Alpha, Theta, Beta],
    }
}

/// The numbers of all links that are free.
pub(super) fn link_ids(robot: &Chain) -> Vec<ParameterId> {
    let of = |(link, at): (usize, &crate::kinematics::DhLink)| {
        let free = link_parameters(link, robot.links.len(), at.alpha_rad);
        free.iter().map(move |&parameter| ParameterId::Robot { link, parameter })
    };
    robot.links.iter().enumerate().flat_map(of).collect()
}

/// The standard numbers of all links, also of those that lengths alone hardly tell apart.
pub(super) fn standard_ids(model: &Model) -> Vec<ParameterId> {
    let is_standard = |id: &ParameterId| matches!(id, ParameterId::Robot { parameter, .. } if *parameter != LinkParameter::Beta);
    model.parameters().iter().map(|parameter| parameter.id).filter(is_standard).collect()
}

/// Frees numbers of links, expected at nominal within these standard deviations \[m, rad\], but for those in `fix`.
///
/// # Errors
/// [`ModelError::BadPrior`].
pub(super) fn free_links(
    model: &mut Model,
    ids: &[ParameterId],
    fix: &[ParameterId],
    [sigma_m, sigma_rad]: [f64; 2],
) -> Result<(), ModelError> {
    for &id in ids.iter().filter(|id| !fix.contains(id)) {
        let Some(nominal) = model.parameter(id).map(|parameter| parameter.nominal) else { continue };
        let sigma = if id.unit() == Unit::Metre { sigma_m } else { sigma_rad };
        model.set_role(id, Role::Prior { value: nominal, sigma })?;
    }
    Ok(())
}
