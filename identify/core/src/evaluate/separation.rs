//! Link parameters of the robot that the data do not separate.

use crate::calibrate::selection::links::inseparable_offsets;
use crate::model::{Group, Model, ParameterId, Role};
use crate::solver::Solution;

/// Groups of link parameters of which the data determine only a combination: offsets along parallel axes, of which only the
/// sum is observable, and parameters determined more by their tolerances than by the data. A group of one is a parameter
/// that the data do not determine. Lengths that were measured separately are excluded. The first columns of the solution are
/// those of `model`.
pub fn not_separated(model: &Model, solution: &Solution) -> Vec<Vec<ParameterId>> {
    let known = ParameterId::known_lengths(model.axes());
    let with_tolerance = model.columns().enumerate().filter(|(_, one)| {
        let is_link = matches!(one.id.group(), Group::Link | Group::InPlaceOfAnother);
        is_link
            && !known.contains(&one.id)
            && matches!((one.id, one.role), (ParameterId::Robot { .. }, Role::Prior { .. }))
    });
    let (columns, ids): (Vec<usize>, Vec<ParameterId>) =
        with_tolerance.map(|(column, one)| (column, one.id)).unzip();
    let id = |column: usize| columns.iter().position(|one| *one == column).map(|place| ids[place]);
    let of_data = solution.identifiability.by_priors(&columns).into_iter();
    let of_data = of_data.map(|group| group.into_iter().filter_map(id).collect());
    let is_free = |group: &Vec<ParameterId>| group.last().is_some_and(|sum| ids.contains(sum));
    let of_axes = inseparable_offsets(&model.geometry(&[]).robot).into_iter().filter(is_free);
    of_axes.chain(of_data).collect()
}
