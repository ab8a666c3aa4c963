//! Which numbers of a robot's links are free, whatever instrument measures its end.

use nalgebra::Vector3;
use shared::config::JointKind;

use crate::kinematics::{Chain, LinkParameter, Trace, Tracer};
use crate::model::ParameterId;

/// What the links are freed to do: 4 numbers of each, by the two axes that it joins.
///
/// The first link's `d` and `theta` are the instrument's place, the last link is its mounting. Between nearly
/// parallel axes `d` has no value and Hayati's `beta` takes its place; a length along such axes is told once, by the `d`
/// of the link after them.
///
/// A prismatic axis has a direction but no place: where it is drawn, across it, is a matter of taste, so that its link has no
/// length and the next one no offset; 2 numbers are left. An offset along axes that are all parallel, from the base on or up to
/// the flange, is the tracker's place or the probe's. That makes `4 revolute + 2 prismatic + 6` numbers with these two.
fn link_parameters(robot: &Chain, directions: &[Vector3<f64>], link: usize) -> Vec<LinkParameter> {
    use LinkParameter::{A, Alpha, Beta, D, Theta};
    /// Less than this from parallel.
    const PARALLEL: f64 = 0.1;
    let prismatic = |link: usize| robot.links.get(link).is_some_and(|at| at.joint == JointKind::Prismatic);
    let parallel = robot.links.get(link).is_some_and(|at| at.alpha_rad.sin().abs() < PARALLEL);
    if link + 1 >= robot.links.len() {
        return Vec::new();
    }
    let first: &[LinkParameter] = match (link, prismatic(link)) {
        (0, true) => &[],
        (0, false) => &[A],
        // About and along a prismatic axis the next one parallel to it turns and moves as well.
        (_, true) if parallel => &[D],
        (_, true) => &[D, Theta],
        (_, false) if parallel => &[A, Theta],
        (_, false) => &[A, D, Theta],
    };
    let mut free = [first, &[Alpha]].concat();
    free.extend(parallel.then_some(Beta));
    let turns_it =
        |axis: &usize| !prismatic(*axis) && directions[*axis].cross(&directions[link]).norm() > PARALLEL;
    let told = (0..link).any(|axis| turns_it(&axis)) && (link..directions.len()).any(|axis| turns_it(&axis));
    free.retain(|parameter| *parameter != D || (told && !prismatic(link - 1)));
    free
}

/// Directions of the joints' axes of the nominal robot.
fn directions(robot: &Chain) -> Vec<Vector3<f64>> {
    let mut trace = Trace::default();
    Tracer::new(robot).trace(&[], &mut trace);
    trace.joint_axes().map(|(_, direction)| direction).collect()
}

/// The numbers of all links that are free.
pub(in crate::calibrate) fn link_ids(robot: &Chain) -> Vec<ParameterId> {
    let directions = directions(robot);
    let of = |link: usize| {
        let free = link_parameters(robot, &directions, link).into_iter();
        free.map(move |parameter| ParameterId::Robot { link, parameter })
    };
    (0..robot.links.len()).flat_map(of).collect()
}

/// Offsets along parallel axes, of which any data determine the sum alone. The last of each group is the one that is free.
pub(crate) fn inseparable_offsets(robot: &Chain) -> Vec<Vec<ParameterId>> {
    let free = link_ids(robot);
    let offset = |link: usize| ParameterId::Robot { link, parameter: LinkParameter::D };
    let is_carried = |link: &usize| {
        let parallel = ParameterId::Robot { link: *link, parameter: LinkParameter::Beta };
        free.contains(&parallel) && !free.contains(&offset(*link))
    };
    let last = robot.links.len().saturating_sub(1);
    let sums = (0..robot.links.len()).filter(|link| *link == last || free.contains(&offset(*link)));
    let group = |link: usize| -> Vec<ParameterId> {
        let carried = (0..link).rev().take_while(is_carried).map(offset);
        let mut group: Vec<ParameterId> = std::iter::once(offset(link)).chain(carried).collect();
        group.reverse();
        group
    };
    sums.map(group).filter(|group| group.len() > 1).collect()
}
