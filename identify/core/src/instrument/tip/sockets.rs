//! Sockets that hold the ball, with their known positions or distances. [`SocketTable`] is the table of
//! the file. [`Sockets`] converts its entries to residuals with derivatives, which the fit uses in
//! addition to the rows of [`super::Contact`].

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, Vector3};
use serde::{Deserialize, Serialize};
use shared::config::{Validate, Violation};

use super::known::{Knowns, SPAN_MM_MAX, ensure_pairs_differ};
use crate::kinematics::nearest_rotation;
use crate::model::{Axis, Geometry, ParameterId, Unit};

/// A socket whose position on its plate is known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlacedSocket {
    /// Name in the rows.
    pub name: String,
    /// Centre of the seated ball \[mm\]. All sockets of a plate use the same frame, which may be any frame.
    pub position_mm: [f64; 3],
    /// Standard uncertainty of each coordinate \[um\]. If it is absent, the uncertainty in the table applies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub u_um: Option<f64>,
}

/// A known distance of two sockets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownDistance {
    /// Names of the two sockets in the rows.
    pub between: [String; 2],
    /// Distance between the centres of the ball when it is seated in one and in the other socket \[mm\].
    pub distance_mm: f64,
    /// Standard uncertainty \[um\]. If it is absent, the uncertainty in the table applies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub u_um: Option<f64>,
}

/// Known geometry of the sockets: positions on their plate, distances, or both.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SocketTable {
    /// Standard uncertainty of each position or distance that has none of its own \[um\].
    pub u_um: f64,
    /// Sockets of one plate, with their known positions.
    #[serde(default, rename = "socket", skip_serializing_if = "Vec::is_empty")]
    pub sockets: Vec<PlacedSocket>,
    /// Known distances of pairs of sockets.
    #[serde(default, rename = "distance", skip_serializing_if = "Vec::is_empty")]
    pub distances: Vec<KnownDistance>,
}

impl Validate for SocketTable {
    fn validate(&self) -> Result<(), Violation> {
        let sockets = self.sockets.iter().enumerate();
        let of_sockets = sockets.map(|(i, socket)| (format!("socket[{i}].u_um"), socket.u_um));
        let distances = self.distances.iter().enumerate();
        let of_distances = distances.map(|(i, distance)| (format!("distance[{i}].u_um"), distance.u_um));
        let of_table = [("u_um".to_owned(), Some(self.u_um))];
        let uncertainties = of_table.into_iter().chain(of_sockets).chain(of_distances);
        for (key, u_um) in uncertainties.filter_map(|(key, u_um)| Some((key, u_um?))) {
            let problem = format!("invalid uncertainty {u_um}");
            Violation::unless(u_um.is_finite() && u_um > 0.0, key, problem, "give micrometres above zero")?;
        }
        let mut names = BTreeSet::new();
        for (i, socket) in self.sockets.iter().enumerate() {
            let problem = format!("two sockets have the name `{}`", socket.name);
            let (key, remedy) = (format!("socket[{i}].name"), "give each socket a name of its own");
            Violation::unless(names.insert(&socket.name), key, problem, remedy)?;
            for at in socket.position_mm {
                let problem = format!("the coordinate {at} mm is beyond {SPAN_MM_MAX} mm");
                let (key, remedy) = (format!("socket[{i}].position_mm"), "give x, y and z in millimetres");
                Violation::unless((-SPAN_MM_MAX..=SPAN_MM_MAX).contains(&at), key, problem, remedy)?;
            }
        }
        for (i, socket) in self.sockets.iter().enumerate() {
            let same = self.sockets[..i].iter().find(|other| other.position_mm == socket.position_mm);
            if let Some(other) = same {
                let problem = format!("`{}` has the position of `{}`", socket.name, other.name);
                let key = format!("socket[{i}].position_mm");
                return Err(Violation::new(key, problem, "give each socket its own position"));
            }
        }
        for (i, KnownDistance { between: [from, to], distance_mm, .. }) in self.distances.iter().enumerate() {
            let (key, problem) = (format!("distance[{i}].between"), format!("both sockets are `{from}`"));
            Violation::unless(from != to, key, problem, "name two different sockets")?;
            let problem = format!("the distance {distance_mm} mm is not between 0 and {SPAN_MM_MAX} mm");
            let key = format!("distance[{i}].distance_mm");
            let is_possible = *distance_mm > 0.0 && *distance_mm <= SPAN_MM_MAX;
            Violation::unless(is_possible, key, problem, "give it in millimetres")?;
        }
        ensure_pairs_differ("distance", self.distances.iter().map(|distance| &distance.between))?;
        let is_known = !self.distances.is_empty() || self.sockets.len() >= 2;
        let remedy = "write a [[socket]] block with position_mm for each of at least two sockets, or a [[distance]] block";
        Violation::unless(is_known, "socket", "no distance between sockets is known", remedy)?;
        let (count, most) = (self.names().len(), ParameterId::SOCKETS_MAX);
        let (problem, remedy) = (format!("there are {count} sockets"), format!("give at most {most}"));
        Violation::unless(count <= most, "socket", problem, remedy)
    }
}

impl SocketTable {
    /// Names of all sockets. Sockets with a known position are first, in the order of the table. Sockets
    /// that occur only in distances follow.
    pub fn names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.sockets.iter().map(|one| one.name.as_str()).collect();
        for name in self.distances.iter().flat_map(|one| &one.between) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        names
    }
}

/// A socket with its known position on the plate.
#[derive(Debug, Clone, PartialEq)]
struct KnownPosition {
    socket: usize,
    position_m: Vector3<f64>,
    /// Standard uncertainty of a coordinate.
    sigma_m: f64,
}

/// Two sockets with their known distance.
#[derive(Debug, Clone, PartialEq)]
struct Spaced {
    sockets: [usize; 2],
    distance_m: f64,
    sigma_m: f64,
}

/// The sockets that the rows visit, with their known geometry. Sockets have the same numbers as their parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Sockets {
    /// Names in the rows.
    pub(super) names: Vec<String>,
    /// Known positions of sockets on the plate. They are the first known quantities. The known distances follow.
    placed: Vec<KnownPosition>,
    distances: Vec<Spaced>,
}

impl Sockets {
    /// Creates the sockets `names`, in this order, with their known geometry from the table. Entries of the
    /// table for other sockets are ignored.
    pub fn new(table: &SocketTable, names: &[&str]) -> Self {
        let number = |name: &String| names.iter().position(|other| other == name);
        let sigma_m = |u_um: Option<f64>| u_um.unwrap_or(table.u_um) * 1e-6;
        let placed = table.sockets.iter().filter_map(|PlacedSocket { name, position_mm, u_um }| {
            let position_m = Vector3::from(*position_mm) * 1e-3;
            Some(KnownPosition { socket: number(name)?, position_m, sigma_m: sigma_m(*u_um) })
        });
        let placed: Vec<KnownPosition> = placed.collect();
        let distances = table.distances.iter().filter_map(|KnownDistance { between, distance_mm, u_um }| {
            let [from, to] = between.each_ref().map(number);
            let distance_m = distance_mm * 1e-3;
            Some(Spaced { sockets: [from?, to?], distance_m, sigma_m: sigma_m(*u_um) })
        });
        Self {
            names: names.iter().map(ToString::to_string).collect(),
            // If only one socket has a known position, this position contains no information.
            placed: if placed.len() > 1 { placed } else { Vec::new() },
            distances: distances.collect(),
        }
    }

    /// A known quantity as a distance. `None` if it is not a distance.
    fn distance(&self, known: usize) -> Option<&Spaced> {
        self.distances.get(known.checked_sub(self.placed.len())?)
    }

    /// Residuals `(s_j - T c_j) / u_j` of the sockets on the plate, and their derivatives by `s_j`. `s_j` are the estimated
    /// positions in the robot's base, `c_j` the known positions, and `u_j` the uncertainties of these positions. `T` is the
    /// pose of the plate for which the residuals are smallest.
    ///
    /// The pose `T` depends on `s_j`, but it is not a parameter of the fit (variable projection, Golub and Pereyra 1973, in
    /// Kaufman's form). Let `D` be the diagonal matrix of the `1 / u_j`, and `M` the derivatives of the residuals by the
    /// pose. The derivative of the residuals is then `(I - M M^+) D`.
    fn plate_residual(&self, sockets_m: &[Vector3<f64>]) -> Option<(DVector<f64>, DMatrix<f64>)> {
        /// Singular values below this fraction of the largest one are treated as zero. For example, if all sockets are on a
        /// line, the residuals do not depend on a rotation about this line.
        const RANK_TOLERANCE: f64 = 1e-9;
        let size = 3 * self.placed.len();
        let s: Vec<Vector3<f64>> =
            self.placed.iter().map(|placed| sockets_m.get(placed.socket).copied()).collect::<Option<_>>()?;
        let c: Vec<Vector3<f64>> = self.placed.iter().map(|placed| placed.position_m).collect();
        // The pose of the plate, from weighted means of the positions and the rotation that fits best.
        let weights: Vec<f64> = self.placed.iter().map(|placed| placed.sigma_m.powi(-2)).collect();
        let centre = |points: &[Vector3<f64>]| {
            let sum: Vector3<f64> = points.iter().zip(&weights).map(|(point, weight)| point * *weight).sum();
            sum / weights.iter().sum::<f64>()
        };
        let (s_centre, c_centre) = (centre(&s), centre(&c));
        let weighted = s.iter().zip(&c).zip(&weights);
        let products: Matrix3<f64> =
            weighted.map(|((s, c), weight)| (s - s_centre) * (c - c_centre).transpose() * *weight).sum();
        let rotation: Rotation3<f64> = nearest_rotation(&products);
        // The residuals, and their derivatives `M` by translation and rotation of the plate.
        // Layout: rows `3 k` to `3 k + 2` are the coordinates of the known position `k`. Columns 0 to 2 of `M` are the
        // translation, columns 3 to 5 the rotation vector.
        let (mut residual, mut by_pose) = (DVector::zeros(size), DMatrix::zeros(size, 6));
        let mut per_sigma = DVector::zeros(size);
        for (place, ((s, c), weight)) in s.iter().zip(&c).zip(&weights).enumerate() {
            let (arm, scale) = (rotation * (c - c_centre), weight.sqrt());
            residual.rows_mut(3 * place, 3).copy_from(&((s - s_centre - arm) * scale));
            by_pose.view_mut((3 * place, 0), (3, 3)).fill_with_identity();
            by_pose.view_mut((3 * place, 3), (3, 3)).copy_from(&-arm.cross_matrix());
            per_sigma.rows_mut(3 * place, 3).fill(scale);
        }
        // `(I - M M^+) D`, from the left singular vectors of `M`.
        for (row, scale) in per_sigma.iter().enumerate() {
            by_pose.row_mut(row).scale_mut(*scale);
        }
        let svd = by_pose.svd(true, false);
        let largest = svd.singular_values.max();
        let mut derivative = DMatrix::from_diagonal(&per_sigma);
        for (direction, singular_value) in svd.u?.column_iter().zip(&svd.singular_values) {
            if *singular_value > RANK_TOLERANCE * largest {
                let scaled = direction.component_mul(&per_sigma);
                derivative.ger(-1.0, &direction, &scaled, 1.0);
            }
        }
        Some((residual, derivative))
    }
}

impl Knowns for Sockets {
    /// Number of known positions on the plate and of known distances.
    fn knowns(&self) -> usize {
        self.placed.len() + self.distances.len()
    }

    fn rows_of(&self, known: usize) -> usize {
        if known < self.placed.len() { 3 } else { 1 }
    }

    fn stated(&self, known: usize) -> Option<(String, f64, Unit)> {
        if let Some(placed) = self.placed.get(known) {
            let name = format!("the place of socket `{}`", self.names.get(placed.socket)?);
            return Some((name, placed.sigma_m, Unit::Metre));
        }
        let Spaced { sockets: [from, to], sigma_m, .. } = *self.distance(known)?;
        let (from, to) = (self.names.get(from)?, self.names.get(to)?);
        Some((format!("the distance between sockets `{from}` and `{to}`"), sigma_m, Unit::Metre))
    }

    fn known(&self, known: usize, geometry: &Geometry) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let sockets_m = &geometry.contact.sockets_m;
        let columns = 3 * sockets_m.len();
        if known < self.placed.len() {
            let (residual, of_placed) = self.plate_residual(sockets_m)?;
            let (first, mut derivative) = (3 * known, DMatrix::zeros(3, columns));
            for (place, placed) in self.placed.iter().enumerate() {
                let by_socket = of_placed.view((first, 3 * place), (3, 3));
                derivative.columns_mut(3 * placed.socket, 3).copy_from(&by_socket);
            }
            return Some((residual.rows(first, 3).into_owned(), derivative));
        }
        let Spaced { sockets: [from, to], distance_m, sigma_m } = *self.distance(known)?;
        let difference = sockets_m.get(to)? - sockets_m.get(from)?;
        let residual = DVector::from_element(1, (difference.norm() - distance_m) / sigma_m);
        let direction = difference.try_normalize(0.0).unwrap_or_default() / sigma_m;
        let mut derivative = DMatrix::zeros(1, columns);
        derivative.columns_mut(3 * to, 3).copy_from(&direction.transpose());
        derivative.columns_mut(3 * from, 3).copy_from(&-direction.transpose());
        Some((residual, derivative))
    }

    /// Each socket has three columns.
    fn column(&self, id: ParameterId) -> Option<usize> {
        let ParameterId::Socket { socket, axis } = id else { return None };
        Some(Axis::ALL.len() * socket + axis.index())
    }
}
