//! Observations of the bar and motion of the robot. Each has its own clock.

use crate::kinematics::{BAR_JOINTS, Joints};

/// Axial force on the ball-bar, with the sign that it has in the log. It is not known whether tension is
/// positive in the log.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BarForce {
    /// Force along the bar \[N\]; 0 if not measured.
    pub along_n: f64,
    /// Side of the axial play: the sign of the force, smoothed around zero, from -1 to 1.
    pub side: f64,
}

/// Measurement of the ball-bar at one instant. Other instruments use only the time, because their measurements
/// are stored in rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Time on the bar's clock, since the reference time \[s\].
    pub t_s: f64,
    /// Bar joints as read from the encoders, without offsets \[rad\]. Entries that are not `measured` are ignored.
    pub bar_rad: [f64; BAR_JOINTS],
    /// Which joints have an encoder value.
    pub measured: [bool; BAR_JOINTS],
    /// Index of the counter origin. Origin 0 uses only the offsets of the bar's links. For every other origin,
    /// [`super::ParameterId::EncoderOffset`] is added to these offsets.
    pub origin: usize,
    /// Axial force on the ball-bar.
    pub force: BarForce,
}

impl Observation {
    /// Observation of a bar with all five encoders.
    pub fn bar(t_s: f64, bar_rad: [f64; BAR_JOINTS]) -> Self {
        let force = BarForce::default();
        Self { t_s, bar_rad, measured: [true; BAR_JOINTS], origin: 0, force }
    }

    /// Observation that consists only of the time at which another instrument measured.
    pub fn time_only(t_s: f64) -> Self {
        Self { measured: [false; BAR_JOINTS], ..Self::bar(t_s, [0.0; BAR_JOINTS]) }
    }
}

/// Robot joints at one instant.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct JointState {
    /// Joint variables \[rad, m\].
    pub q: Joints,
    /// Joint rates \[rad/s, m/s\].
    pub qd: Joints,
    /// Joint accelerations \[rad/s², m/s²\].
    pub qdd: Joints,
}

impl JointState {
    /// State `by_s` seconds later, extrapolated with constant acceleration.
    pub fn after(&self, by_s: f64) -> Self {
        let Self { q, qd, qdd } = self;
        Self {
            q: Joints::from_fn(q.len(), |i| q[i] + by_s * (qd[i] + 0.5 * by_s * qdd[i])),
            qd: Joints::from_fn(q.len(), |i| qd[i] + by_s * qdd[i]),
            qdd: *qdd,
        }
    }

    /// Joint state at rest: rates and accelerations are zero.
    pub fn at_rest(q: impl Into<Joints>) -> Self {
        let q = q.into();
        let rest = Joints::zeros(q.len());
        Self { q, qd: rest, qdd: rest }
    }
}

/// The robot's motion as a differentiable function of the time on the robot's clock.
pub trait RobotMotion: Sync {
    /// Joints at robot time `tau_s` since the reference time \[s\]. `None` outside the log.
    fn at(&self, tau_s: f64) -> Option<JointState>;
}

/// One joint position for each observation, for data without clocks. Observation `i` has the time `i` seconds.
#[derive(Debug, Clone, PartialEq)]
pub struct PerObservation(pub Vec<Joints>);

impl PerObservation {
    /// Time of observation `index` \[s\].
    pub fn time_s(index: usize) -> f64 {
        index as f64
    }
}

/// Index of the observation at this time; `None` before the first one.
fn index_at(tau_s: f64) -> Option<usize> {
    // A time below -0.5 rounds to a negative index, which the cast would convert to 0.
    (tau_s > -0.5).then(|| tau_s.round() as usize)
}

impl RobotMotion for PerObservation {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        self.0.get(index_at(tau_s)?).map(|q| JointState::at_rest(*q))
    }
}

/// One joint state for each observation, with times as in [`PerObservation`].
impl RobotMotion for Vec<JointState> {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        self.get(index_at(tau_s)?).copied()
    }
}
