//! Samples of the bar and motion of the robot, each on its own clock.

use crate::kinematics::{BAR_JOINTS, Joints};

/// What pulls or presses on the ball-bar, counted as its log counts it: which sign is tension is not known.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BarForce {
    /// Along the bar \[N\]; 0 where it was not measured.
    pub along_n: f64,
    /// Its sign, from -1 to 1: on which side of its play the bar is.
    pub side: f64,
}

/// What the ball-bar or the wire measured at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Bar clock, since the reference time \[s\].
    pub t_s: f64,
    /// Bar joints \[rad\], encoder offsets not yet added; entries that are not measured do not count.
    pub bar_rad: [f64; BAR_JOINTS],
    /// Joints that have an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// Which zeros the encoders had: 0 those of the bar's links, others also [`super::ParameterId::EncoderOffset`] of this number.
    pub origin: usize,
    /// Length of a wire or telescoping bar \[m\].
    pub length_m: Option<f64>,
    /// On the ball-bar.
    pub force: BarForce,
}

impl Observation {
    /// A bar with all five encoders.
    pub fn bar(t_s: f64, bar_rad: [f64; BAR_JOINTS]) -> Self {
        let force = BarForce::default();
        Self { t_s, bar_rad, measured: [true; BAR_JOINTS], origin: 0, length_m: None, force }
    }

    /// A measured length alone.
    pub fn length(t_s: f64, length_m: f64) -> Self {
        let measured = [false; BAR_JOINTS];
        Self { measured, length_m: Some(length_m), ..Self::bar(t_s, [0.0; BAR_JOINTS]) }
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
    /// So much later, at the same acceleration \[s\].
    pub fn after(&self, by_s: f64) -> Self {
        let Self { q, qd, qdd } = self;
        Self {
            q: Joints::from_fn(q.len(), |i| q[i] + by_s * (qd[i] + 0.5 * by_s * qdd[i])),
            qd: Joints::from_fn(q.len(), |i| qd[i] + by_s * qdd[i]),
            qdd: *qdd,
        }
    }

    /// Standing still.
    pub fn at_rest(q: impl Into<Joints>) -> Self {
        let q = q.into();
        let rest = Joints::zeros(q.len());
        Self { q, qd: rest, qdd: rest }
    }
}

/// The robot's motion on its own clock, smooth enough to be differentiated.
pub trait RobotMotion: Sync {
    /// Joints at robot time `tau_s` since the reference \[s\]; none outside the log.
    fn at(&self, tau_s: f64) -> Option<JointState>;
}

/// Joints given per observation, for data without clocks: observation `i` has time `i`.
#[derive(Debug, Clone, PartialEq)]
pub struct PerObservation(pub Vec<Joints>);

impl PerObservation {
    /// Time of observation `index` \[s\].
    pub fn time_s(index: usize) -> f64 {
        index as f64
    }
}

impl RobotMotion for PerObservation {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        if !(tau_s > -0.5 && tau_s < self.0.len() as f64) {
            return None;
        }
        self.0.get(tau_s.round() as usize).map(|q| JointState::at_rest(*q))
    }
}
