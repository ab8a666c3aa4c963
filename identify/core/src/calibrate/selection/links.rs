//! The link parameters of a robot that are free in a calibration, from the directions of its nominal axes, independent of the
//! instrument at its end. Also the offsets of which only a sum is observable.

use nalgebra::Vector3;
use shared::config::JointKind;

use crate::kinematics::{Chain, LinkParameter, Trace, Tracer};
use crate::model::ParameterId;

/// Free parameters of a link: four for each, depending on the two axes that it connects.
///
/// `d` and `theta` of the first link are part of the instrument's pose; the last link is part of the mounting. Between nearly
/// parallel axes `d` is not defined, and Hayati's `beta` replaces it. A length along such axes is represented once, by the `d`
/// of the link after them.
///
/// A prismatic axis has a direction but no position: its lateral position is arbitrary. Its link therefore has no length and
/// the next one no offset, which leaves two parameters. An offset along axes that are all parallel, from the base on or up to
/// the flange, is part of the tracker's pose or the probe's. The total with these two is `4 revolute + 2 prismatic + 6`.
fn link_parameters(robot: &Chain, directions: &[Vector3<f64>], link: usize) -> Vec<LinkParameter> {
    use LinkParameter::{A, Alpha, Beta, D, Theta};
    /// Limit of the sine of the angle between axes that are taken as parallel.
    const PARALLEL: f64 = 0.1;
    let prismatic = |link: usize| robot.links.get(link).is_some_and(|at| at.joint == JointKind::Prismatic);
    let parallel = robot.links.get(link).is_some_and(|at| at.alpha_rad.sin().abs() < PARALLEL);
    if link + 1 >= robot.links.len() {
        return Vec::new();
    }
    let first: &[LinkParameter] = match (link, prismatic(link)) {
        (0, true) => &[],
        (0, false) => &[A],
        // A rotation about a prismatic axis is equal to one about a parallel next axis, which has its own `theta`.
        (_, true) if parallel => &[D],
        (_, true) => &[D, Theta],
        (_, false) if parallel => &[A, Theta],
        (_, false) => &[A, D, Theta],
    };
    let mut free = [first, &[Alpha]].concat();
    free.extend(parallel.then_some(Beta));
    // `d` is observable if axes before and after it turn its direction.
    let turns_direction =
        |axis: usize| !prismatic(axis) && directions[axis].cross(&directions[link]).norm() > PARALLEL;
    let d_is_observable = (0..link).any(turns_direction) && (link..directions.len()).any(turns_direction);
    free.retain(|parameter| *parameter != D || (d_is_observable && !prismatic(link - 1)));
    free
}

/// Directions of the joint axes of the nominal robot.
fn directions(robot: &Chain) -> Vec<Vector3<f64>> {
    let mut trace = Trace::default();
    Tracer::new(robot).trace(&[], &mut trace);
    trace.joint_axes().map(|(_, direction)| direction).collect()
}

/// The free parameters of all links.
pub(in crate::calibrate) fn link_ids(robot: &Chain) -> Vec<ParameterId> {
    let directions = directions(robot);
    let ids_of = |link: usize| {
        let free = link_parameters(robot, &directions, link).into_iter();
        free.map(move |parameter| ParameterId::Robot { link, parameter })
    };
    (0..robot.links.len()).flat_map(ids_of).collect()
}

/// Offsets along parallel axes, of which only the sum is observable. The last of each group represents the sum: it is free, or
/// part of the mounting.
pub(crate) fn inseparable_offsets(robot: &Chain) -> Vec<Vec<ParameterId>> {
    let free = link_ids(robot);
    let offset = |link: usize| ParameterId::Robot { link, parameter: LinkParameter::D };
    // A link with `beta` and without `d`: its offset is part of that of a later link.
    let is_part_of_later = |link: &usize| {
        let beta = ParameterId::Robot { link: *link, parameter: LinkParameter::Beta };
        free.contains(&beta) && !free.contains(&offset(*link))
    };
    let last = robot.links.len().saturating_sub(1);
    let sums = (0..robot.links.len()).filter(|link| *link == last || free.contains(&offset(*link)));
    let group = |link: usize| -> Vec<ParameterId> {
        let earlier = (0..link).rev().take_while(is_part_of_later).map(offset);
        let mut group: Vec<ParameterId> = std::iter::once(offset(link)).chain(earlier).collect();
        group.reverse();
        group
    };
    sums.map(group).filter(|group| group.len() > 1).collect()
}
