//! Start values for the places of a tracker and its probe, for a robot whose poses are known.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, SVector, Vector3};

use crate::kinematics::Pose;
use crate::model::{Placement, SetUp};

/// Standard deviation of the probe's distance from the flange \[m\]: it matters only if the poses do not determine the probe.
pub const PROBE_SIGMA_M: f64 = 1.0;
/// Rounds of the alternation; each at least halves the error.
const ROUNDS: usize = 60;
/// Positions that spread less than this part of their largest spread along the second axis lie on a line.
const FLATNESS: f64 = 1e-6;

/// Places of tracker and probe for a robot at the poses `flanges`, without a first guess; `seen_m` is the probe in the tracker's
/// frame at each, `turns` its `tracker_from_probe`, where that was measured. `None` if the positions lie on a line.
///
/// `T s_k = p_k + R_k y`, alternating: for a known probe `y` the tracker's place `T` is the rigid motion between two
/// clouds of points (Umeyama 1991), for a known `T` the probe is linear. It needs no turns between the poses, where
/// closed forms for `A X = Z B` need turns about two axes; the probe's rotation is the mean over all poses.
pub fn placements(
    flanges: &[Pose],
    seen_m: &[Vector3<f64>],
    turns: impl Iterator<Item = Option<Rotation3<f64>>>,
) -> Option<[Placement; 2]> {
    let mut place = Pose::identity();
    let mut probe_m = Vector3::zeros();
    for _ in 0..ROUNDS {
        let held: Vec<Vector3<f64>> =
            flanges.iter().map(|flange| flange.translation.vector + flange.rotation * probe_m).collect();
        place.rotation = rotation_between(seen_m, &held)?;
        let (position_m, offset_m) = positions(flanges, seen_m, &place.rotation);
        place.translation = position_m.into();
        probe_m = offset_m;
    }
    let turns = turns.zip(flanges).filter_map(|(turn, flange)| Some((flange, &place, turn?)));
    let probe = Pose::from_parts(probe_m.into(), mean_turn(turns));
    Some([Placement::of(&place), Placement::of(&probe)])
}

/// Rotation of the probe on the flange: the mean over poses of the robot, places of the tracker and `tracker_from_probe`.
fn mean_turn<'a>(seen: impl Iterator<Item = (&'a Pose, &'a Pose, Rotation3<f64>)>) -> Rotation3<f64> {
    let turns =
        seen.map(|(flange, place, turn)| *(flange.rotation.inverse() * place.rotation * turn).matrix());
    nearest_rotation(&turns.sum())
}

/// A target measured by a tracker at a pose of the robot.
#[derive(Debug, Clone, Copy)]
pub struct Sighted {
    /// Pose of the flange, from the robot's assumed geometry.
    pub flange: Pose,
    /// Position of the target in the tracker's frame \[m\].
    pub seen_m: Vector3<f64>,
    /// `tracker_from_probe`, where that was measured.
    pub turn: Option<Rotation3<f64>>,
    /// Station of the tracker and target.
    pub set_up: SetUp,
}

/// Places of the stations and targets that have rows, by their numbers.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Placements {
    /// `root_from_tracker` of each station.
    pub places: BTreeMap<usize, Placement>,
    /// `flange_from_probe` of each target.
    pub probes: BTreeMap<usize, Placement>,
}

/// [`placements`] of all stations and targets. Rows of one set-up begin; each target then follows from the stations that are
/// known, each station from the targets. `None` if the rows of a station lie on a line.
pub fn all_placements(rows: &[Sighted]) -> Option<Placements> {
    let mut open: BTreeMap<SetUp, Vec<Sighted>> = BTreeMap::new();
    rows.iter().for_each(|row| open.entry(row.set_up).or_default().push(*row));
    let mut open: Vec<Vec<Sighted>> = open.into_values().collect();
    open.sort_by_key(|rows| std::cmp::Reverse(rows.len()));
    let (mut places, mut probes) = (BTreeMap::<usize, Pose>::new(), BTreeMap::<usize, Pose>::new());
    loop {
        let seen = |row: &Sighted| Some((*row, *places.get(&row.set_up.station)?));
        let target = rows.iter().find(|row| !probes.contains_key(&row.set_up.target) && seen(row).is_some());
        if let Some(Sighted { set_up: SetUp { target, .. }, .. }) = target {
            let own = rows.iter().filter(|row| row.set_up.target == *target).filter_map(seen);
            probes.insert(*target, probe(&own.collect::<Vec<_>>()));
            continue;
        }
        let held = |row: &Sighted| Some((*row, row.flange * probes.get(&row.set_up.target)?));
        let station =
            rows.iter().find(|row| !places.contains_key(&row.set_up.station) && held(row).is_some());
        if let Some(Sighted { set_up: SetUp { station, .. }, .. }) = station {
            let own = rows.iter().filter(|row| row.set_up.station == *station).filter_map(held);
            places.insert(*station, place(&own.collect::<Vec<_>>())?);
            continue;
        }
        let is_open = |rows: &&Vec<Sighted>| !places.contains_key(&rows[0].set_up.station);
        let Some(own) = open.iter().find(is_open) else { break };
        let flanges: Vec<Pose> = own.iter().map(|row| row.flange).collect();
        let seen_m: Vec<Vector3<f64>> = own.iter().map(|row| row.seen_m).collect();
        let [place, probe] = placements(&flanges, &seen_m, own.iter().map(|row| row.turn))?;
        places.insert(own[0].set_up.station, place.pose());
        probes.insert(own[0].set_up.target, probe.pose());
    }
    let all =
        |of: BTreeMap<usize, Pose>| of.iter().map(|(number, at)| (*number, Placement::of(at))).collect();
    Some(Placements { places: all(places), probes: all(probes) })
}

/// `flange_from_probe` of a target in rows from known places of the tracker: the mean over the rows.
fn probe(rows: &[(Sighted, Pose)]) -> Pose {
    let at_m = |(row, place): &(Sighted, Pose)| {
        row.flange.inverse_transform_point(&place.transform_point(&row.seen_m.into())).coords
    };
    let at_m: Vec<Vector3<f64>> = rows.iter().map(at_m).collect();
    let turns = rows.iter().filter_map(|(row, place)| Some((&row.flange, place, row.turn?)));
    Pose::from_parts(mean(&at_m).into(), mean_turn(turns))
}

/// `root_from_tracker` of a station, from rows with the pose of the target in the robot's frame.
fn place(rows: &[(Sighted, Pose)]) -> Option<Pose> {
    let seen_m: Vec<Vector3<f64>> = rows.iter().map(|(row, _)| row.seen_m).collect();
    let held_m: Vec<Vector3<f64>> = rows.iter().map(|(_, held)| held.translation.vector).collect();
    let turn = |(row, held): &(Sighted, Pose)| Some(*(held.rotation * row.turn?.inverse()).matrix());
    let turns: Option<Vec<Matrix3<f64>>> = rows.iter().map(turn).collect();
    let rotation = match turns {
        Some(turns) => nearest_rotation(&turns.iter().sum()),
        None => rotation_between(&seen_m, &held_m)?,
    };
    Some(Pose::from_parts((mean(&held_m) - rotation * mean(&seen_m)).into(), rotation))
}

fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64
}

/// The rotation that takes one cloud onto the other.
fn rotation_between(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Rotation3<f64>> {
    let (from_mean, to_mean) = (mean(from), mean(to));
    let products = from.iter().zip(to).map(|(a, b)| (b - to_mean) * (a - from_mean).transpose());
    let sum: Matrix3<f64> = products.sum();
    let spread = sum.singular_values();
    if spread[1] <= FLATNESS * spread[0] {
        return None;
    }
    Some(nearest_rotation(&sum))
}

/// The rotation nearest to a matrix; identity for one that points nowhere.
pub(crate) fn nearest_rotation(matrix: &Matrix3<f64>) -> Rotation3<f64> {
    let svd = matrix.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Rotation3::identity() };
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    Rotation3::from_matrix_unchecked(u * flip * v_t)
}

/// Place of the tracker and of the probe for a known rotation of the tracker: linear.
fn positions(
    flanges: &[Pose],
    seen_m: &[Vector3<f64>],
    rotation: &Rotation3<f64>,
) -> (Vector3<f64>, Vector3<f64>) {
    let mut normal = DMatrix::<f64>::zeros(6, 6);
    let mut right = DVector::<f64>::zeros(6);
    let weak = flanges.len() as f64 * (1e-3 / PROBE_SIGMA_M).powi(2);
    for axis in 3..6 {
        normal[(axis, axis)] = weak;
    }
    for (flange, seen_m) in flanges.iter().zip(seen_m) {
        let apart = flange.translation.vector - rotation * seen_m;
        for i in 0..3 {
            let turned = flange.rotation.matrix().row(i).transpose();
            let unit = Vector3::ith(i, 1.0);
            let line = SVector::<f64, 6>::from_iterator(unit.iter().chain((-turned).iter()).copied());
            normal += line * line.transpose();
            right += line * apart[i];
        }
    }
    let solved = normal.cholesky().map(|factor| factor.solve(&right));
    let at = |i: usize| solved.as_ref().map_or(0.0, |x| x[i]);
    (Vector3::new(at(0), at(1), at(2)), Vector3::new(at(3), at(4), at(5)))
}
