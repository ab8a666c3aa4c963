//! Sockets that hold the ball, and their known positions or distances.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, Vector3};
use serde::{Deserialize, Serialize};
use shared::config::{Validate, Violation};

use super::Knowns;
use crate::model::{Axis, Geometry, ParameterId, Unit};
use crate::prepare::nearest_rotation;

/// A socket whose position on its plate is known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlacedSocket {
    /// Name in the rows.
    pub name: String,
    /// Centre of the seated ball in any frame of the plate \[mm\].
    pub position_mm: [f64; 3],
    /// Standard uncertainty of each coordinate \[um\]; absent: that of the table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub u_um: Option<f64>,
}

/// A known distance of two sockets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownDistance {
    /// Names of the two sockets in the rows.
    pub between: [String; 2],
    /// Distance between the centres of the seated ball \[mm\].
    pub distance_mm: f64,
    /// Standard uncertainty \[um\]; absent: that of the table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub u_um: Option<f64>,
}

/// Known geometry of the sockets: positions on their plate, distances, or both.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SocketTable {
    /// Standard uncertainty of each number without one of its own \[um\].
    pub u_um: f64,
    /// Sockets of one plate, with their positions.
    #[serde(default, rename = "socket", skip_serializing_if = "Vec::is_empty")]
    pub sockets: Vec<PlacedSocket>,
    /// Known distances of pairs of sockets.
    #[serde(default, rename = "distance", skip_serializing_if = "Vec::is_empty")]
    pub distances: Vec<KnownDistance>,
}

/// Largest distance of sockets \[mm\]: a larger one has a wrong unit.
const SPAN_MM_MAX: f64 = 20_000.0;

impl Validate for SocketTable {
    fn validate(&self) -> Result<(), Violation> {
        let bad = |key: String, problem: String, remedy: &str| Err(Violation::new(key, problem, remedy));
        let own =
            self.sockets.iter().map(|one| one.u_um).enumerate().map(|(i, u)| (format!("socket[{i}]."), u));
        let of_distances = self.distances.iter().map(|one| one.u_um).enumerate();
        let of_distances = of_distances.map(|(i, u)| (format!("distance[{i}]."), u));
        for (place, u_um) in [(String::new(), Some(self.u_um))].into_iter().chain(own).chain(of_distances) {
            if let Some(u_um) = u_um.filter(|u_um| !(u_um.is_finite() && *u_um > 0.0)) {
                let key = format!("{place}u_um");
                return bad(key, format!("{u_um} is no uncertainty"), "give micrometres above zero");
            }
        }
        let mut names = BTreeSet::new();
        for (i, socket) in self.sockets.iter().enumerate() {
            if !names.insert(&socket.name) {
                let problem = format!("`{}` is there twice", socket.name);
                return bad(format!("socket[{i}].name"), problem, "give each socket a name of its own");
            }
            if let Some(at) = socket.position_mm.iter().find(|at| !(-SPAN_MM_MAX..=SPAN_MM_MAX).contains(*at))
            {
                let problem = format!("{at} mm is no place on a plate");
                return bad(format!("socket[{i}].position_mm"), problem, "give three numbers in millimetres");
            }
        }
        for (i, socket) in self.sockets.iter().enumerate() {
            let same = self.sockets[..i].iter().find(|other| other.position_mm == socket.position_mm);
            if let Some(other) = same {
                let problem = format!("`{}` is where `{}` is", socket.name, other.name);
                return bad(format!("socket[{i}].position_mm"), problem, "give each socket its own place");
            }
        }
        for (i, KnownDistance { between: [from, to], distance_mm, .. }) in self.distances.iter().enumerate() {
            if from == to {
                let problem = format!("`{from}` is both ends");
                return bad(format!("distance[{i}].between"), problem, "name two sockets");
            }
            if !(*distance_mm > 0.0 && *distance_mm <= SPAN_MM_MAX) {
                let problem = format!("{distance_mm} mm is no distance between sockets");
                return bad(format!("distance[{i}].distance_mm"), problem, "give millimetres above zero");
            }
        }
        if self.distances.is_empty() && self.sockets.len() < 2 {
            let remedy = "write a [[socket]] block with position_mm for each of at least two sockets, or a [[distance]] block";
            return bad("socket".into(), "no distance between sockets is known".into(), remedy);
        }
        let count = self.names().len();
        if count > ParameterId::SOCKETS_MAX {
            let remedy = format!("give at most {}", ParameterId::SOCKETS_MAX);
            return bad("socket".into(), format!("there are {count} sockets"), &remedy);
        }
        Ok(())
    }
}

impl SocketTable {
    /// Names of all sockets: those of the plate in their order, then those that only distances have.
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

/// Sockets that rows visit, numbered as their parameters, and their known geometry \[m\].
#[derive(Debug, Clone, PartialEq)]
pub struct Sockets {
    names: Vec<String>,
    /// Socket, position on the plate, and standard uncertainty of a coordinate.
    placed: Vec<(usize, Vector3<f64>, f64)>,
    /// Two sockets, their distance and its standard uncertainty.
    distances: Vec<([usize; 2], f64, f64)>,
}

impl Sockets {
    /// The sockets of a table that are in `names`, in this order.
    pub fn new(table: &SocketTable, names: &[&str]) -> Self {
        let number = |name: &String| names.iter().position(|other| other == name);
        let sigma_m = |u_um: Option<f64>| u_um.unwrap_or(table.u_um) * 1e-6;
        let placed = table.sockets.iter().filter_map(|one| {
            Some((number(&one.name)?, Vector3::from(one.position_mm) * 1e-3, sigma_m(one.u_um)))
        });
        let placed: Vec<_> = placed.collect();
        let distances = table.distances.iter().filter_map(|one| {
            let [from, to] = one.between.each_ref().map(number);
            Some(([from?, to?], one.distance_mm * 1e-3, sigma_m(one.u_um)))
        });
        Self {
            names: names.iter().map(ToString::to_string).collect(),
            // A single position on a plate contains no information.
            placed: if placed.len() > 1 { placed } else { Vec::new() },
            distances: distances.collect(),
        }
    }

    /// Names in the rows.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// `(s_j - T c_j) / u_j` of the sockets of the plate, with the pose `T` of the plate that fits them best, and the
    /// derivatives by their positions. The pose is eliminated (variable projection, Golub and Pereyra 1973, in Kaufman's form).
    fn of_plate(&self, sockets_m: &[Vector3<f64>]) -> Option<(DVector<f64>, DMatrix<f64>)> {
        /// Singular values below this part of the largest count as zero, such as a rotation about a line through all sockets.
        const RANK: f64 = 1e-9;
        let size = 3 * self.placed.len();
        let found: Vec<Vector3<f64>> =
            self.placed.iter().map(|(socket, ..)| sockets_m.get(*socket).copied()).collect::<Option<_>>()?;
        let known: Vec<Vector3<f64>> = self.placed.iter().map(|(_, at, _)| *at).collect();
        let weights: Vec<f64> = self.placed.iter().map(|(.., sigma_m)| sigma_m.powi(-2)).collect();
        let centre = |points: &[Vector3<f64>]| {
            let sum: Vector3<f64> = points.iter().zip(&weights).map(|(point, weight)| point * *weight).sum();
            sum / weights.iter().sum::<f64>()
        };
        let (of_found, of_known) = (centre(&found), centre(&known));
        let products = found.iter().zip(&known).zip(&weights);
        let products: Matrix3<f64> =
            products.map(|((s, c), weight)| (s - of_found) * (c - of_known).transpose() * *weight).sum();
        let turn: Rotation3<f64> = nearest_rotation(&products);
        let (mut residual, mut moves) = (DVector::zeros(size), DMatrix::zeros(size, 6));
        let mut scale = DVector::zeros(size);
        for (place, ((s, c), weight)) in found.iter().zip(&known).zip(&weights).enumerate() {
            let (arm, per_sigma) = (turn * (c - of_known), weight.sqrt());
            residual.rows_mut(3 * place, 3).copy_from(&((s - of_found - arm) * per_sigma));
            moves.view_mut((3 * place, 0), (3, 3)).fill_with_identity();
            moves.view_mut((3 * place, 3), (3, 3)).copy_from(&-arm.cross_matrix());
            scale.rows_mut(3 * place, 3).fill(per_sigma);
        }
        for (row, per_sigma) in scale.iter().enumerate() {
            moves.row_mut(row).scale_mut(*per_sigma);
        }
        let svd = moves.svd(true, false);
        let largest = svd.singular_values.max();
        let mut derivative = DMatrix::from_diagonal(&scale);
        for (column, _) in
            svd.u?.column_iter().zip(&svd.singular_values).filter(|(_, s)| **s > RANK * largest)
        {
            let along = column.component_mul(&scale);
            derivative.ger(-1.0, &column, &along, 1.0);
        }
        Some((residual, derivative))
    }
}

impl Knowns for Sockets {
    /// Number of positions on the plate and distances.
    fn knowns(&self) -> usize {
        self.placed.len() + self.distances.len()
    }

    fn rows_of(&self, known: usize) -> usize {
        if known < self.placed.len() { 3 } else { 1 }
    }

    fn name_of(&self, known: usize) -> String {
        let name = |socket: usize| self.names.get(socket).map_or("", String::as_str);
        match (self.placed.get(known), known.checked_sub(self.placed.len())) {
            (Some((socket, ..)), _) => format!("the place of socket `{}`", name(*socket)),
            (None, at) => at.and_then(|at| self.distances.get(at)).map_or_else(String::new, |(ends, ..)| {
                format!("the distance between sockets `{}` and `{}`", name(ends[0]), name(ends[1]))
            }),
        }
    }

    fn sigma_of(&self, known: usize) -> (f64, Unit) {
        let placed = self.placed.get(known).map(|placed| placed.2);
        let distance =
            || self.distances.get(known.checked_sub(self.placed.len())?).map(|distance| distance.2);
        (placed.or_else(distance).unwrap_or_default(), Unit::Metre)
    }

    fn known(&self, known: usize, geometry: &Geometry) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let sockets_m = &geometry.contact.sockets_m;
        let columns = 3 * sockets_m.len();
        if known < self.placed.len() {
            let (residual, derivative) = self.of_plate(sockets_m)?;
            let (rows, mut by) = (3 * known..3 * known + 3, DMatrix::zeros(3, columns));
            for (place, (socket, ..)) in self.placed.iter().enumerate() {
                by.columns_mut(3 * socket, 3).copy_from(&derivative.view((rows.start, 3 * place), (3, 3)));
            }
            return Some((residual.rows(rows.start, 3).into_owned(), by));
        }
        let ([from, to], distance_m, sigma_m) = *self.distances.get(known - self.placed.len())?;
        let along = sockets_m.get(to)? - sockets_m.get(from)?;
        let residual = DVector::from_element(1, (along.norm() - distance_m) / sigma_m);
        let direction = along.try_normalize(0.0).unwrap_or_default() / sigma_m;
        let mut by = DMatrix::zeros(1, columns);
        by.columns_mut(3 * to, 3).copy_from(&direction.transpose());
        by.columns_mut(3 * from, 3).copy_from(&-direction.transpose());
        Some((residual, by))
    }

    /// Three columns for each socket.
    fn column(&self, id: ParameterId) -> Option<usize> {
        let ParameterId::Socket { socket, axis } = id else { return None };
        Some(Axis::ALL.len() * socket + axis.index())
    }
}
