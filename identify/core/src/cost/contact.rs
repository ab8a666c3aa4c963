//! A ball on the flange that is seated in sockets: nothing is measured but the robot's joints and which socket. What is known of
//! the sockets' distances comes beside, as samples of their own.

use nalgebra::Vector3;

use super::scene::unit;
use super::{CostError, DataSet, LoopProblem, Movement, Residual, Scene};
use crate::instrument::Sockets;
use crate::model::{Axis, Model, Observation, Owner, ParameterId, RobotMotion};
use crate::solver::{Linearisation, Prior, Problem};

/// `R ball - socket` \[m\], entries in the robot's base: `R` is the robot's pose. Divide by the standard deviation of a
/// coordinate.
#[derive(Debug, Clone, Copy)]
pub struct SeatedBall<'a> {
    /// Socket of each sample.
    pub sockets: &'a [usize],
}

impl Residual for SeatedBall<'_> {
    /// The socket, and from the flange to the ball in the robot's base \[m\].
    type Local = (usize, Vector3<f64>);

    const NAME: &'static str = "contact";
    const ROWS: usize = 3;
    const ENCODERS: &'static [usize] = &[];

    fn depends_on(id: ParameterId) -> bool {
        id.affects(Owner::Contact)
    }

    fn local(&self, scene: &Scene<'_>) -> Option<Self::Local> {
        let socket = *self.sockets.get(scene.sample)?;
        Some((socket, scene.robot.rotation() * scene.geometry.contact.ball_m))
    }

    fn residual(&self, scene: &Scene<'_>, (socket, ball): &Self::Local, out: &mut [f64]) {
        let socket_m = scene.geometry.contact.sockets_m.get(*socket);
        let socket_m = socket_m.copied().unwrap_or_else(|| Vector3::repeat(f64::NAN));
        out.copy_from_slice((scene.robot.position_m() + ball - socket_m).as_slice());
    }

    fn derivative(&self, scene: &Scene<'_>, (at, ball): &Self::Local, id: ParameterId, out: &mut [f64]) {
        let by = match (id, scene.movement(id)) {
            (_, Movement::Robot(twist)) => twist.linear + twist.angular.cross(ball),
            (ParameterId::Ball { axis }, _) => scene.robot.rotation() * unit(axis),
            (ParameterId::Socket { socket, axis }, _) if socket == *at => -unit(axis),
            _ => return,
        };
        out.copy_from_slice(by.as_slice());
    }
}

/// Rows of a ball in sockets, then what is known of the sockets.
#[derive(Debug)]
pub struct SeatedBalls<'a, M> {
    rows: LoopProblem<'a, SeatedBall<'a>, M>,
    known: &'a Sockets,
}

impl<'a, M: RobotMotion> SeatedBalls<'a, M> {
    /// `sigma` is the standard deviation of a coordinate of the ball \[m\]; that of what is known stands there.
    ///
    /// # Errors
    /// [`CostError`].
    pub fn new(
        model: &'a Model,
        motion: &'a M,
        observations: &'a [Observation],
        sockets: &'a [usize],
        known: &'a Sockets,
        sigma: f64,
    ) -> Result<Self, CostError> {
        Ok(Self {
            rows: LoopProblem::new(model, motion, observations, SeatedBall { sockets }, sigma)?,
            known,
        })
    }
}

impl<M: RobotMotion> DataSet for SeatedBalls<'_, M> {
    fn at_into<'a>(&'a self, x: &[f64], columns: &'a [usize]) -> Linearisation<'a> {
        let geometry = self.rows.model().geometry(x);
        let sockets_m = geometry.contact.sockets_m.clone();
        let mut rows = self.rows.linearised(geometry, columns);
        Box::new(move |sample, residual, block| {
            let Some(known) = sample.checked_sub(self.rows.samples()) else {
                return rows(sample, residual, block);
            };
            let Some((value, derivative)) = self.known.known(known, &sockets_m) else { return false };
            residual.copy_from_slice(value.as_slice());
            for (&column, id) in columns.iter().zip(self.rows.ids()) {
                let &ParameterId::Socket { socket, axis } = id else { continue };
                let by = derivative.column(Axis::ALL.len() * socket + axis.index());
                block.column_mut(column).iter_mut().zip(by.iter()).for_each(|(to, by)| *to = *by);
            }
            true
        })
    }
}

impl<M: RobotMotion> Problem for SeatedBalls<'_, M> {
    fn columns(&self) -> usize {
        self.rows.columns()
    }

    fn column_name(&self, column: usize) -> String {
        self.rows.column_name(column)
    }

    fn samples(&self) -> usize {
        self.rows.samples() + self.known.knowns()
    }

    fn rows(&self) -> usize {
        self.rows.rows()
    }

    fn rows_of(&self, sample: usize) -> usize {
        sample.checked_sub(self.rows.samples()).map_or(self.rows(), |known| self.known.rows_of(known))
    }

    fn is_known(&self, sample: usize) -> bool {
        sample >= self.rows.samples()
    }

    fn priors(&self) -> &[Prior] {
        self.rows.priors()
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        self.at_into(x, self.rows.own_columns())
    }
}
