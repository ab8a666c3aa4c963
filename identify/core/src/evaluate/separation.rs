//! Link parameters of the robot that the data cannot separate from each other.

use crate::calibrate::selection::links::inseparable_offsets;
use crate::model::{Group, Model, ParameterId, Role};
use crate::solver::Solution;

/// Groups of link parameters of which the data determine only a combination. There are two types of groups. The first type
/// are offsets along parallel axes, of which only the sum is observable. The second type are parameters that their
/// tolerances determine better than the data do; a single such parameter forms a group of its own. Lengths that were
/// measured separately are excluded. The first columns of the solution are those of `model`.
pub fn not_separated(model: &Model, solution: &Solution) -> Vec<Vec<ParameterId>> {
    let known_lengths = ParameterId::known_lengths(model.axes());
    let has_tolerance = |id: ParameterId, role: Role| {
        let is_link = matches!(id.group(), Group::Link | Group::InPlaceOfAnother);
        is_link
            && !known_lengths.contains(&id)
            && matches!((id, role), (ParameterId::Robot { .. }, Role::Prior { .. }))
    };
    let parameters = model.columns().enumerate();
    let with_tolerance = parameters.filter(|(_, parameter)| has_tolerance(parameter.id, parameter.role));
    let (columns, ids): (Vec<usize>, Vec<ParameterId>) =
        with_tolerance.map(|(column, parameter)| (column, parameter.id)).unzip();
    let id_of = |column: usize| columns.iter().position(|other| *other == column).map(|index| ids[index]);
    let by_priors = solution.identifiability.by_priors(&columns).into_iter();
    let by_priors = by_priors.map(|group| group.into_iter().filter_map(id_of).collect());
    // The last parameter of a group of parallel axes represents the sum.
    let has_free_sum = |group: &Vec<ParameterId>| group.last().is_some_and(|sum| ids.contains(sum));
    let parallel = inseparable_offsets(&model.geometry(&[]).robot).into_iter().filter(has_free_sum);
    parallel.chain(by_priors).collect()
}
