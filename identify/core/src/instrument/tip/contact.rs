//! A ball on the flange that is seated in one of several sockets. If the ball is in the same socket in two poses, both must
//! give the same position. The residual is the position of the ball predicted by the robot, minus the position of its socket
//! ([`SeatedBall`]). Known distances between the sockets determine the scale.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::{
    Artefact, Knowns, SocketTable, Sockets, TIP_SIGMA_M, Tip, TouchedPoses, numbers_min, tip_weight,
};
use crate::cost::{Residual, SeatedBall};
use crate::instrument::rows::{MEDIAN_OF_THREE, Standing};
use crate::instrument::{Deviation, RowError, ScaleFrom};
use crate::logs::TipRow;
use crate::model::{Axis, Geometry, ParameterId, Role};

/// A ball in sockets.
pub type Contact = Tip<Sockets>;

impl Contact {
    /// Creates the instrument. `rows` are in the order in which the robot visited them. In each row the ball
    /// was seated in a socket of the table.
    ///
    /// # Errors
    /// [`RowError`] if rows and table are not sufficient to calibrate a robot.
    pub fn new(rows: &[TipRow], table: &SocketTable) -> Result<Self, RowError> {
        let mut all = Standing::new(rows, |row| row.joints_rad);
        let names = table.names();
        // Find the poses of each socket. Several rows of one pose determine a socket no better than one row.
        let mut poses = vec![BTreeSet::new(); names.len()];
        for ((number, row), pose) in (1..).zip(&all.rows).zip(&all.groups) {
            if !row.joints_rad.iter().all(|joint| joint.is_finite()) {
                return Err(RowError::BadRow { row: number, what: "a joint that is not finite" });
            }
            poses.get_mut(row.part).ok_or(RowError::UnknownSocket { row: number })?.insert(*pose);
        }
        // Remove the sockets that no row visits, and number the others again.
        let visited: Vec<usize> = (0..names.len()).filter(|socket| !poses[*socket].is_empty()).collect();
        for row in &mut all.rows {
            row.part = visited.partition_point(|socket| *socket < row.part);
        }
        let names: Vec<&str> = visited.iter().map(|&socket| names[socket]).collect();
        let sockets = Sockets::new(table, &names);
        let axes = all.states.first().map_or(0, |state| state.q.len());
        let (rows, needed) = (all.rows.len(), numbers_min(names.len(), axes).div_ceil(SeatedBall::ROWS));
        // Check that rows and table determine the robot and all visited sockets.
        if let [socket] = names[..] {
            return Err(RowError::OneSocket { socket: socket.to_owned() });
        }
        if sockets.knowns() == 0 {
            return Err(RowError::NoDistance { sockets: sockets.names().to_vec() });
        }
        if rows < needed {
            return Err(RowError::TooFewInSockets { rows, sockets: names.len(), needed });
        }
        if let Some(once) = visited.iter().position(|socket| poses[*socket].len() == 1) {
            return Err(RowError::VisitedOnce { socket: names[once].to_owned() });
        }
        Ok(Self::of_rows(all, sockets))
    }
}

impl Artefact for Sockets {
    type Cost<'a> = SeatedBall<'a>;
    const NAME: &'static str = "contact";
    const TIP_AND_PARTS: &'static str = "ball and sockets";
    const PART: &'static str = "socket";
    const ELSEWHERE: &'static str = "not in its socket";
    const MEDIAN: f64 = MEDIAN_OF_THREE;
    const PART_ROWS_MIN: usize = 0;
    const PART_ROWS_KEPT: usize = 1;

    fn names(&self) -> &[String] {
        &self.names
    }

    fn scale(&self) -> ScaleFrom {
        ScaleFrom::Sockets
    }

    fn cost(rows: &[TipRow]) -> SeatedBall<'_> {
        SeatedBall { rows }
    }

    fn tip_m(geometry: &Geometry) -> Vector3<f64> {
        geometry.contact.ball_m
    }

    fn deviation(geometry: &Geometry, socket: usize, ball_m: Vector3<f64>, _: f64) -> Deviation {
        let socket_m = geometry.contact.sockets_m.get(socket).copied();
        Deviation::of_place(ball_m - socket_m.unwrap_or_else(|| Vector3::repeat(f64::NAN)))
    }

    /// Estimates ball and sockets by linear least squares, because `p_k + R_k ball = socket` is linear in both.
    /// `(R_k, p_k)` is the pose of the flange at row `k`. A weak prior of the ball at zero has an effect only if
    /// the poses do not determine the ball.
    fn start(&self, touches: &TouchedPoses) -> Option<Vec<(ParameterId, f64, Role)>> {
        let sockets = self.names.len();
        let size = 3 * (1 + sockets);
        // Normal equations of `p + R ball - socket = 0`. `matrix` consists of 3 x 3 blocks, `right` of 3 x 1 blocks. A row
        // with the pose `(R, p)` adds `I` to both diagonal blocks, `-R^T` and `-R` to the two off-diagonal blocks of ball
        // and socket, and `-R^T p` and `p` to `right`.
        let (mut matrix, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        matrix.view_mut((0, 0), (3, 3)).fill_diagonal(tip_weight(touches.len()));
        for (flange, row) in touches {
            let (r, p) = (flange.rotation.matrix(), flange.translation.vector);
            // Order of the unknowns: three coordinates of the ball, then three of each socket. These are
            // the first indices of ball and socket.
            let (ball, socket) = (0, 3 * (1 + row.part));
            let mut add_to_matrix = |place: (usize, usize), block: &Matrix3<f64>| {
                let mut view = matrix.fixed_view_mut::<3, 3>(place.0, place.1);
                view += block;
            };
            add_to_matrix((ball, ball), &Matrix3::identity());
            add_to_matrix((socket, socket), &Matrix3::identity());
            add_to_matrix((ball, socket), &-r.transpose());
            add_to_matrix((socket, ball), &-r);
            let mut add_to_right = |place: usize, block: Vector3<f64>| {
                let mut view = right.fixed_rows_mut::<3>(place);
                view += block;
            };
            add_to_right(ball, -r.transpose() * p);
            add_to_right(socket, p);
        }
        let solution = matrix.cholesky()?.solve(&right);
        let prior = Role::Prior { value: 0.0, sigma: TIP_SIGMA_M };
        let ball = Axis::ALL.map(|axis| (ParameterId::Ball { axis }, prior)).into_iter();
        let sockets = (0..sockets)
            .flat_map(|socket| Axis::ALL.map(|axis| (ParameterId::Socket { socket, axis }, Role::Free)));
        let unknowns = ball.chain(sockets).zip(solution.iter());
        Some(unknowns.map(|((id, role), value)| (id, *value, role)).collect())
    }
}
