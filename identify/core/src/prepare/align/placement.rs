//! Start values for the pose of a tracker and the pose of its probe, from observed positions at known poses of the robot.
//! They are used by the alignment of a tracker's log (`tracker`) and as start values of its solve (`instrument::tracker`).
//!
//! Each row `k` gives the equation `T s_k = p_k + R_k y`. Known are the observed position `s_k`, and position `p_k` and
//! rotation `R_k` of the flange. Unknown are the pose `T` of the tracker and the position `y` of the probe on the flange.
//!
//! A tracker may be used at several *stations* and measure several *targets* (probes). [`placements`] solves for one pair of
//! station and target, [`all_placements`] for all of them.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, SVector, Vector3};

use crate::kinematics::{Pose, nearest_rotation};
use crate::logs::PoseRow;
use crate::model::{Placement, SetUp};

/// Standard deviation of the prior on the probe's position on the flange \[m\]. The prior has an effect only if the
/// poses do not determine this position.
pub const PROBE_SIGMA_M: f64 = 1.0;
/// Number of rounds of the alternating solution. Each round at least halves the error.
const ROUNDS: usize = 60;
/// Positions count as lying on a line if, in [`rotation_between`], the second singular value of the sum of products is at
/// most this fraction of the first singular value.
const FLATNESS: f64 = 1e-6;

/// Finds the poses of tracker and probe without start values. For each robot pose in `flanges`, `observed_m` is the position
/// of the probe in the tracker's frame. `turns` contains the rotation of `tracker_from_probe` for each robot pose, or `None`
/// if this rotation was not measured. Returns `None` if the positions lie on a line.
///
/// The solution alternates between two steps. For a known `y`, the rotation of `T` is the rotation between two clouds of
/// points (Umeyama 1991). For a known rotation, the equations are linear in the position of `T` and in `y`. Closed-form
/// solutions of `A X = Z B` need rotations of the flange about two axes. The alternating solution does not need any rotation
/// of the flange. The rotation of the probe is the mean over all poses.
pub fn placements(
    flanges: &[Pose],
    observed_m: &[Vector3<f64>],
    turns: impl Iterator<Item = Option<Rotation3<f64>>>,
) -> Option<[Placement; 2]> {
    let mut tracker = Pose::identity();
    let mut probe_m = Vector3::zeros();
    for _ in 0..ROUNDS {
        let predicted_m: Vec<Vector3<f64>> =
            flanges.iter().map(|flange| flange.translation.vector + flange.rotation * probe_m).collect();
        tracker.rotation = rotation_between(observed_m, &predicted_m)?;
        let (tracker_m, fitted_probe_m) = positions(flanges, observed_m, &tracker.rotation);
        tracker.translation = tracker_m.into();
        probe_m = fitted_probe_m;
    }
    let turns = turns.zip(flanges).filter_map(|(turn, flange)| Some((flange, &tracker, turn?)));
    let probe = Pose::from_parts(probe_m.into(), mean_turn(turns));
    Some([Placement::from_pose(&tracker), Placement::from_pose(&probe)])
}

/// Rotation of the probe on the flange: the mean over all rows. A row is the pose of the flange, the pose of the tracker,
/// and the rotation of `tracker_from_probe`.
fn mean_turn<'a>(rows: impl Iterator<Item = (&'a Pose, &'a Pose, Rotation3<f64>)>) -> Rotation3<f64> {
    let flange_from_probe =
        rows.map(|(flange, tracker, turn)| *(flange.rotation.inverse() * tracker.rotation * turn).matrix());
    nearest_rotation(&flange_from_probe.sum())
}

/// A target that a tracker measured, and the pose of the robot's flange at that time.
#[derive(Debug, Clone, Copy)]
pub struct Sighted {
    /// Pose of the flange, from the robot's assumed geometry.
    pub flange: Pose,
    /// Measurement of the tracker.
    pub seen: PoseRow,
}

/// Poses of the stations and targets that have rows. Keys are the numbers of the stations or targets.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Placements {
    /// `root_from_tracker` of each station.
    pub places: BTreeMap<usize, Placement>,
    /// `flange_from_probe` of each target.
    pub probes: BTreeMap<usize, Placement>,
}

/// Finds the poses of all stations and targets. First, [`placements`] solves the pair of station and target with the
/// most rows. Each solved station then determines all targets that it measured, and each solved target determines
/// all stations that measured it. Pairs without a connection to a solved pair are solved in the same way. `None` if
/// the rows of a station lie on a line.
pub fn all_placements(rows: &[Sighted]) -> Option<Placements> {
    let mut by_set_up: BTreeMap<SetUp, Vec<Sighted>> = BTreeMap::new();
    rows.iter().for_each(|row| by_set_up.entry(row.seen.set_up).or_default().push(*row));
    let mut set_ups: Vec<Vec<Sighted>> = by_set_up.into_values().collect();
    set_ups.sort_by_key(|rows| std::cmp::Reverse(rows.len()));
    let (mut places, mut probes) = (BTreeMap::<usize, Pose>::new(), BTreeMap::<usize, Pose>::new());
    loop {
        // Rows of known stations, each with the pose of the tracker at this station.
        let with_tracker = |row: &Sighted| Some((*row, *places.get(&row.seen.set_up.station)?));
        let new_target = rows
            .iter()
            .find(|row| !probes.contains_key(&row.seen.set_up.target) && with_tracker(row).is_some());
        if let Some(SetUp { target, .. }) = new_target.map(|row| row.seen.set_up) {
            let of_target =
                rows.iter().filter(|row| row.seen.set_up.target == target).filter_map(with_tracker);
            probes.insert(target, probe(&of_target.collect::<Vec<_>>()));
            continue;
        }
        // Rows of known targets, each with the pose of the probe in the robot's frame.
        let with_probe = |row: &Sighted| Some((*row, row.flange * probes.get(&row.seen.set_up.target)?));
        let new_station = rows
            .iter()
            .find(|row| !places.contains_key(&row.seen.set_up.station) && with_probe(row).is_some());
        if let Some(SetUp { station, .. }) = new_station.map(|row| row.seen.set_up) {
            let of_station =
                rows.iter().filter(|row| row.seen.set_up.station == station).filter_map(with_probe);
            places.insert(station, place(&of_station.collect::<Vec<_>>())?);
            continue;
        }
        // No solved station or target determines another one, so [`placements`] solves the next pair. This is the first pair
        // of all, or a pair without a connection to the pairs before it.
        let is_new = |rows: &&Vec<Sighted>| !places.contains_key(&rows[0].seen.set_up.station);
        let Some(largest) = set_ups.iter().find(is_new) else { break };
        let flanges: Vec<Pose> = largest.iter().map(|row| row.flange).collect();
        let observed_m: Vec<Vector3<f64>> = largest.iter().map(|row| row.seen.position_m).collect();
        let [place, probe] = placements(&flanges, &observed_m, largest.iter().map(|row| row.seen.rotation))?;
        places.insert(largest[0].seen.set_up.station, place.pose());
        probes.insert(largest[0].seen.set_up.target, probe.pose());
    }
    let as_placements = |poses: BTreeMap<usize, Pose>| {
        poses.iter().map(|(number, pose)| (*number, Placement::from_pose(pose))).collect()
    };
    Some(Placements { places: as_placements(places), probes: as_placements(probes) })
}

/// `flange_from_probe` of a target, as the mean over the rows of this target. Each row is given with the known
/// pose of the tracker.
fn probe(rows: &[(Sighted, Pose)]) -> Pose {
    let on_flange_m = |(row, tracker): &(Sighted, Pose)| {
        row.flange.inverse_transform_point(&tracker.transform_point(&row.seen.position_m.into())).coords
    };
    let on_flange_m: Vec<Vector3<f64>> = rows.iter().map(on_flange_m).collect();
    let turns = rows.iter().filter_map(|(row, tracker)| Some((&row.flange, tracker, row.seen.rotation?)));
    Pose::from_parts(mean(&on_flange_m).into(), mean_turn(turns))
}

/// `root_from_tracker` of a station. Each row is given with the pose of the probe in the robot's frame. `None` if rotations
/// were not measured in all rows and the positions lie on a line.
fn place(rows: &[(Sighted, Pose)]) -> Option<Pose> {
    let observed_m: Vec<Vector3<f64>> = rows.iter().map(|(row, _)| row.seen.position_m).collect();
    let probe_m: Vec<Vector3<f64>> = rows.iter().map(|(_, probe)| probe.translation.vector).collect();
    let root_from_tracker =
        |(row, probe): &(Sighted, Pose)| Some(*(probe.rotation * row.seen.rotation?.inverse()).matrix());
    let rotations: Option<Vec<Matrix3<f64>>> = rows.iter().map(root_from_tracker).collect();
    let rotation = match rotations {
        Some(rotations) => nearest_rotation(&rotations.iter().sum()),
        None => rotation_between(&observed_m, &probe_m)?,
    };
    Some(Pose::from_parts((mean(&probe_m) - rotation * mean(&observed_m)).into(), rotation))
}

/// Mean position \[m\]; zero without points.
fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64
}

/// The rotation that best maps the points `from` onto the points `to`, each about its mean. `None` if the points lie on a line.
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

/// Positions `t` of the tracker and `y` of the probe for a known rotation `Q` of the tracker. They are the least-squares
/// solution of `t - R_k y = p_k - Q s_k`.
fn positions(
    flanges: &[Pose],
    observed_m: &[Vector3<f64>],
    rotation: &Rotation3<f64>,
) -> (Vector3<f64>, Vector3<f64>) {
    /// Assumed error of a measured position, which determines the weight of the probe's prior \[m\].
    const ERROR_M: f64 = 1e-3;
    let mut normal = DMatrix::<f64>::zeros(6, 6);
    let mut right = DVector::<f64>::zeros(6);
    let prior_weight = flanges.len() as f64 * (ERROR_M / PROBE_SIGMA_M).powi(2);
    for axis in 3..6 {
        normal[(axis, axis)] = prior_weight;
    }
    for (flange, observed_m) in flanges.iter().zip(observed_m) {
        let difference = flange.translation.vector - rotation * observed_m;
        for axis in 0..3 {
            let rotation_row = flange.rotation.matrix().row(axis).transpose();
            let unit = Vector3::ith(axis, 1.0);
            let row = SVector::<f64, 6>::from_iterator(unit.iter().chain((-rotation_row).iter()).copied());
            normal += row * row.transpose();
            right += row * difference[axis];
        }
    }
    let solution = normal.cholesky().map(|factor| factor.solve(&right));
    let unknown = |index: usize| solution.as_ref().map_or(0.0, |solution| solution[index]);
    let tracker_m = Vector3::new(unknown(0), unknown(1), unknown(2));
    let probe_m = Vector3::new(unknown(3), unknown(4), unknown(5));
    (tracker_m, probe_m)
}
