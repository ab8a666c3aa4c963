//! Chooses the link parameters of a robot that are free in a calibration. The choice depends on the directions of the
//! robot's nominal axes, but not on the instrument. Also finds groups of offsets of which only the sum is observable.

use nalgebra::Vector3;
use shared::config::JointKind;

use crate::kinematics::{Chain, LinkParameter, Trace, Tracer};
use crate::model::ParameterId;

/// The free parameters of one link. A link between two revolute axes has four free parameters. Their selection depends
/// on the directions of the two axes.
///
/// `d` and `theta` of the first link are part of the instrument's pose. The last link is part of the mounting. If two axes
/// are nearly parallel, `d` is not defined, and Hayati's `beta` replaces it. A length along parallel axes is represented by
/// a single `d`, that of the link after these axes.
///
/// A prismatic axis has a direction but no position, because its lateral position is arbitrary. Therefore its link has no
/// length, and the next link has no offset. Two free parameters remain.
///
/// If all axes from the base to a link are parallel, an offset along them belongs to the pose of the tracker. If all
/// axes from a link to the flange are parallel, it belongs to the pose of the probe. The free parameters and those of
/// the two poses together number `4 revolute + 2 prismatic + 6`: four for each revolute axis, two for each prismatic
/// axis, and six for the frame of the probe.
fn link_parameters(robot: &Chain, directions: &[Vector3<f64>], link: usize) -> Vec<LinkParameter> {
    use LinkParameter::{A, Alpha, Beta, D, Theta};
    /// Axes are treated as parallel if the sine of the angle between them is less than this value.
    const PARALLEL: f64 = 0.1;
    let prismatic = |link: usize| robot.links.get(link).is_some_and(|at| at.joint == JointKind::Prismatic);
    let parallel = robot.links.get(link).is_some_and(|at| at.alpha_rad.sin().abs() < PARALLEL);
    if link + 1 >= robot.links.len() {
        return Vec::new();
    }
    let first: &[LinkParameter] = match (link, prismatic(link)) {
        (0, true) => &[],
        (0, false) => &[A],
        // If the next axis is parallel, a rotation about this prismatic axis is the same as a rotation about the next axis.
        // The link of the next axis has its own `theta`, so only `d` is free here.
        (_, true) if parallel => &[D],
        (_, true) => &[D, Theta],
        (_, false) if parallel => &[A, Theta],
        (_, false) => &[A, D, Theta],
    };
    let mut free = [first, &[Alpha]].concat();
    free.extend(parallel.then_some(Beta));
    // `d` is observable if at least one axis before this axis and one after it turn its direction.
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

/// The free parameters of all links of a robot.
pub(in crate::calibrate) fn link_ids(robot: &Chain) -> Vec<ParameterId> {
    let directions = directions(robot);
    let ids_of = |link: usize| {
        let free = link_parameters(robot, &directions, link).into_iter();
        free.map(move |parameter| ParameterId::Robot { link, parameter })
    };
    (0..robot.links.len()).flat_map(ids_of).collect()
}

/// Groups of offsets along parallel axes. Only the sum of the offsets of a group is observable. The last offset of each
/// group represents the sum: it is either free or belongs to the mounting.
pub(crate) fn inseparable_offsets(robot: &Chain) -> Vec<Vec<ParameterId>> {
    let free = link_ids(robot);
    let offset = |link: usize| ParameterId::Robot { link, parameter: LinkParameter::D };
    // A link with `beta` instead of `d`. Its offset is included in the offset of a later link.
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
