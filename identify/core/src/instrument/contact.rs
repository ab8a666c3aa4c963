//! A ball on the flange that is seated in one of several sockets. A row contains the robot's joints and the name of the socket.
//! Poses with the ball in the same socket close a loop: the residual is the position of the ball by the robot minus that of its
//! socket ([`SeatedBall`]), where ball and sockets are estimated too. Known distances of the sockets fix the scale.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::description::nearest;
use super::rows::{MEDIAN_OF_THREE, Screened, Standing, sigma_by_median};
use super::{
    Cause, Deviation, Doubt, Instrument, Knowns, Measures, Mistake, Noise, RejectedRow, ScaleFrom, Section,
    SocketTable, Sockets,
};
use crate::cost::{CostError, DataSet, LoopProblem, Residual, SeatedBall};
use crate::kinematics::Chain;
use crate::logs::TipRow;
use crate::model::{Clock, Geometry, JointState, Model, ModelError, Observation, Owner, ParameterId, Role};

/// Why rows of a ball in sockets cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ContactError {
    /// A joint is not finite.
    #[error("row {row} has a joint that is not finite; remove or correct it")]
    BadRow {
        /// Number of the row, from 1.
        row: usize,
    },
    /// The table does not contain the socket.
    #[error("row {row} is of a socket that the table of sockets does not have; correct one of them")]
    UnknownSocket {
        /// Number of the row, from 1.
        row: usize,
    },
    /// Only one socket was visited.
    #[error(
        "all rows are of socket `{socket}`: they do not determine the scale of the robot; seat the ball in at least two sockets whose \
         distance is known"
    )]
    OneSocket {
        /// Name of the only visited socket.
        socket: String,
    },
    /// A socket was visited only once.
    #[error(
        "socket `{socket}` has one row, which closes no loop; seat the ball in it in at least two postures, or leave the row out"
    )]
    VisitedOnce {
        /// Name of the socket with one row.
        socket: String,
    },
    /// None of the visited sockets has a known distance.
    #[error(
        "no distance is known between the sockets of these rows ({}): they do not determine the scale of the robot; give places \
         or distances of at least two of them",
        .sockets.join(", ")
    )]
    NoDistance {
        /// Names of the sockets that were visited.
        sockets: Vec<String>,
    },
    /// Too few rows for the unknowns.
    #[error(
        "{rows} rows in {sockets} sockets are too few, at least {needed} are needed; seat the ball in more postures"
    )]
    TooFewRows {
        /// Number of rows in the file.
        rows: usize,
        /// Number of visited sockets.
        sockets: usize,
        /// Least number of rows.
        needed: usize,
    },
}

/// Prior of the ball's distance from the flange \[m\]: effective only if the poses do not determine the ball.
const BALL_SIGMA_M: f64 = 1.0;

/// Rows of one set-up, and the noise of the seated ball.
#[derive(Debug, Clone)]
pub struct Contact {
    rows: Screened<TipRow>,
    sockets: Sockets,
    /// Observations of the rows in use; below, the socket of each.
    observations: Vec<Observation>,
    socket_of: Vec<usize>,
    /// Standard deviation of a coordinate of the seated ball, estimated from the residuals \[m\].
    noise_m: f64,
}

impl Contact {
    /// From rows at which the ball was seated in the sockets of the table, in the order in which the robot visited them.
    ///
    /// # Errors
    /// [`ContactError`] if rows and table cannot calibrate a robot.
    pub fn new(rows: &[TipRow], table: &SocketTable) -> Result<Self, ContactError> {
        let mut all = Standing::new(rows, |row| row.joints_rad);
        let names = table.names();
        let mut visits = vec![0; names.len()];
        for (number, row) in (1..).zip(&all.rows) {
            if !row.joints_rad.iter().all(|joint| joint.is_finite()) {
                return Err(ContactError::BadRow { row: number });
            }
            *visits.get_mut(row.part).ok_or(ContactError::UnknownSocket { row: number })? += 1;
        }
        // Sockets of the table that no row visits are left out, so the others are numbered anew.
        let visited: Vec<usize> = (0..names.len()).filter(|socket| visits[*socket] > 0).collect();
        for row in &mut all.rows {
            row.part = visited.partition_point(|socket| *socket < row.part);
        }
        let names: Vec<&str> = visited.iter().map(|&socket| names[socket]).collect();
        let sockets = Sockets::new(table, &names);
        let axes = all.states.first().map_or(0, |state| state.q.len());
        let (rows, needed) = (all.rows.len(), rows_min(names.len(), axes));
        if let [socket] = names[..] {
            return Err(ContactError::OneSocket { socket: socket.to_owned() });
        }
        if sockets.knowns() == 0 {
            return Err(ContactError::NoDistance { sockets: sockets.names().to_vec() });
        }
        if rows < needed {
            return Err(ContactError::TooFewRows { rows, sockets: names.len(), needed });
        }
        if let Some(once) = visited.iter().position(|socket| visits[*socket] == 1) {
            return Err(ContactError::VisitedOnce { socket: names[once].to_owned() });
        }
        Ok(Self::from_parts(all, sockets, BALL_SIGMA_M))
    }

    fn from_parts(all: Standing<TipRow>, sockets: Sockets, noise_m: f64) -> Self {
        let mut contact = Self {
            rows: Screened::new(all),
            sockets,
            observations: Vec::new(),
            socket_of: Vec::new(),
            noise_m,
        };
        contact.update_observations();
        contact
    }

    /// The same instrument with other rows in the same sockets.
    fn with_rows(&self, all: Standing<TipRow>) -> Self {
        Self::from_parts(all, self.sockets.clone(), self.noise_m)
    }

    /// Updates observations and their sockets from the rows in use.
    fn update_observations(&mut self) {
        self.observations = self.rows.at.observations();
        self.socket_of = self.rows.at.rows.iter().map(|row| row.part).collect();
    }

    /// Position of the ball predicted by the robot minus its socket, for every row, in use or not \[m\].
    fn errors_m(&self, geometry: &Geometry) -> Vec<Vector3<f64>> {
        let contact = &geometry.contact;
        let error_m = |(row, state): (&TipRow, &JointState)| {
            let ball_m = geometry.robot_end(state).transform_point(&contact.ball_m.into()).coords;
            let socket_m = contact.sockets_m.get(row.part);
            socket_m.map_or_else(|| Vector3::repeat(f64::NAN), |socket_m| ball_m - socket_m)
        };
        self.rows.all.rows.iter().zip(&self.rows.all.states).map(error_m).collect()
    }
}

/// Fewest rows: twice the number of unknowns of ball, sockets and links.
fn rows_min(sockets: usize, axes: usize) -> usize {
    const NUMBERS_OF_LINK: usize = 4;
    (2 * (3 * (1 + sockets) + NUMBERS_OF_LINK * axes)).div_ceil(SeatedBall::ROWS)
}

impl Measures for Contact {
    fn name(&self) -> &'static str {
        "contact"
    }

    fn cost(&self) -> &'static str {
        SeatedBall::NAME
    }

    fn doubts(&self, geometry: &Geometry) -> Vec<Doubt> {
        let contradicted = self.sockets.contradicted(geometry);
        if contradicted.is_empty() { Vec::new() } else { vec![Doubt::OtherTable(contradicted)] }
    }

    fn scale(&self) -> ScaleFrom {
        ScaleFrom::Sockets
    }

    fn noise(&self) -> Noise {
        Noise::Length(self.noise_m)
    }

    fn samples(&self) -> usize {
        self.rows.at.rows.len()
    }

    fn parts(&self) -> &'static str {
        "ball and sockets"
    }

    /// A section for each socket.
    fn sections(&self) -> Vec<Section> {
        Section::each(self.sockets.names(), "socket", self.rows.all.rows.iter().map(|row| row.part))
    }

    /// Names the socket that is nearest to the ball.
    fn remarks(&self, geometry: &Geometry) -> Vec<(usize, String)> {
        let (names, sockets_m) = (self.sockets.names(), &geometry.contact.sockets_m);
        let errors_m = self.errors_m(geometry);
        let remark = |rejected: &RejectedRow| {
            let row = rejected.row;
            let stated = self.rows.all.rows.get(row)?.part;
            let ball_m = sockets_m.get(stated)? + errors_m.get(row)?;
            let other = nearest(names, stated, |socket| (ball_m - sockets_m[socket]).norm());
            Some((row, format!("not in its socket `{}`{other}", names[stated])))
        };
        self.rows.rejected.iter().filter_map(remark).collect()
    }

    /// Adds the visited sockets.
    fn fitted_out(&self, robot: Model) -> Model {
        robot.with_sockets(self.sockets.names().len()).without_clocks()
    }

    /// Start values of ball and sockets by least squares: `p_k + R_k ball = socket` is linear in both, with the pose `(R_k, p_k)`
    /// of the flange at row `k`.
    fn place(&self, model: &mut Model, fix: &[ParameterId]) -> Result<bool, ModelError> {
        /// Error of a position that gives the weight of the ball's prior \[m\].
        const ERROR_M: f64 = 1e-3;
        let geometry = model.geometry(&[]);
        let size = 3 * (1 + self.sockets.names().len());
        let (mut matrix, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        let prior_weight = self.samples() as f64 * (ERROR_M / BALL_SIGMA_M).powi(2);
        matrix.view_mut((0, 0), (3, 3)).fill_diagonal(prior_weight);
        for (row, state) in self.rows.at.rows.iter().zip(&self.rows.at.states) {
            let flange = geometry.robot_end(state);
            let (r, p) = (flange.rotation.matrix(), flange.translation.vector);
            // First entries of ball and socket among the unknowns.
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
        let Some(solution) = matrix.cholesky().map(|factor| factor.solve(&right)) else { return Ok(false) };
        // The model has the ball and the sockets in the order of the unknowns.
        let ids = model.ids().into_iter().filter(|id| id.owner() == Owner::Contact);
        let values: Vec<(ParameterId, &f64)> = ids.zip(solution.iter()).collect();
        for (id, value) in values.into_iter().filter(|(id, _)| !fix.contains(id)) {
            let role = match id {
                ParameterId::Ball { .. } => Role::Prior { value: 0.0, sigma: BALL_SIGMA_M },
                _ => Role::Free,
            };
            model.set_value(id, *value)?;
            model.set_role(id, role)?;
        }
        Ok(true)
    }

    fn data_set<'a>(&'a self, model: &'a Model, sigma: f64) -> Result<Box<dyn DataSet + 'a>, CostError> {
        let Self { rows, observations, socket_of, sockets, noise_m } = self;
        let residual = SeatedBall { sockets: socket_of };
        let problem = LoopProblem::new(model, &rows.at, observations, residual, sigma * noise_m)?;
        Ok(Box::new(problem.with_knowns(sockets)))
    }

    fn reported(&self, sample: usize, _: &Clock) -> Option<JointState> {
        self.rows.at.states.get(sample).copied()
    }

    /// None: all sockets are on one rigid body.
    fn causes(&self, _: &Geometry) -> Vec<Cause> {
        Vec::new()
    }

    fn identifies(&self, id: ParameterId, robot: &Chain) -> bool {
        SeatedBall::depends_on(id, robot) && id.owner() != Owner::Clocks
    }

    /// Standard deviation of a coordinate, from the median of mostly normal errors.
    fn adapt(&mut self, model: &Model) -> Option<f64> {
        let errors_m = self.errors_m(&model.geometry(&[]));
        self.noise_m = sigma_by_median(errors_m.iter().map(|error| error.norm()), MEDIAN_OF_THREE);
        Some(self.noise_m)
    }

    /// Leaves rows out if most rows agree with each other and each socket keeps a row.
    fn screen(&mut self, model: &Model) -> bool {
        let residuals_m: Vec<f64> =
            self.errors_m(&model.geometry(&[])).iter().map(|error| error.norm()).collect();
        let sockets = self.sockets.names().len();
        let visit_all_sockets =
            |rows: &[TipRow]| (0..sockets).all(|socket| rows.iter().any(|row| row.part == socket));
        let changed = self.rows.screen(&residuals_m, &vec![1.0; residuals_m.len()], visit_all_sockets);
        self.update_observations();
        changed
    }

    fn independent(&self, count: usize) -> Vec<Vec<usize>> {
        self.rows.at.independent(count, |row| row.part)
    }

    fn part(&self, samples: &[usize]) -> Instrument {
        self.with_rows(self.rows.at.chosen(samples)).into()
    }

    fn group(&mut self, groups: &[usize], seed: u64) {
        self.rows.group(groups, seed);
    }

    /// Rows with the ball in another socket than stated, which no model can predict.
    fn misplaced(&self, model: &Model) -> Vec<RejectedRow> {
        let mut screened = self.clone();
        screened.screen(model);
        screened.rows.rejected
    }

    fn judges_gross(&self) -> bool {
        true
    }

    fn mistakes(&self, axes: usize) -> Vec<Mistake> {
        Mistake::of_joints(axes).into_iter().chain([Mistake::ModifiedTable]).collect()
    }

    fn undone(&self, mistake: Mistake) -> Vec<Instrument> {
        let Mistake::Joints(mistake) = mistake else { return Vec::new() };
        let other = self.rows.all.with_joints(|joints_rad| mistake.undone(joints_rad));
        vec![self.with_rows(other).into()]
    }

    fn deviations(&self, geometry: &Geometry) -> Vec<Deviation> {
        self.errors_m(geometry).into_iter().map(Deviation::of_place).collect()
    }

    fn rejected(&self) -> &[RejectedRow] {
        &self.rows.rejected
    }
}
