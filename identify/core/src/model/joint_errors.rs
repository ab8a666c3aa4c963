//! Conversion from reported joint angles to true joint angles.
//!
//! Gear errors are periodic in the angle of the gear's output. This angle is not always a joint angle of the model: rods or
//! bevel gears may couple drives. The drive angles are then `g = q C^-1` (row vector times matrix); row `i` of `C` is the
//! motion of each joint per radian of drive `i`. With amplitudes `a` and shapes `s`
//!
//! `q' = q + e(g, dg/dt) C`, `e_i = sum_t a_it s_t(g_i)`.
//!
//! Where drives are coupled, a joint may also have errors of its own, `s_t(q_i)` on joint `i` only: errors of its bearing or of
//! an encoder on the joint.
//!
//! Shapes are functions of the reported state, so errors are linear in their amplitudes: `dq'/da_it = s_t(g_i) C_i`. The
//! exception is a delay `d_i`. It reads the drive's angle at another instant of the log: `e_i = g_i(t + d_i - d) - g_i(t)`. A
//! delay modelled as a shape (a rate) would amplify the noise of the log. The mean `d` of all delays belongs to the clock.

use nalgebra::{DMatrix, Vector3};
use shared::config::{JointKind, RobotConfig};

use super::{JointState, JointTerm, Load, Period, RobotMotion};
use crate::kinematics::{AXES_MAX, Chain, Joints, Trace, Tracer, Turn, Twist};

/// Drive speed scale of the backlash shape `tanh(rate / speed)` \[rad/s\]; at this speed the shape is about 0.76. It is lower
/// than the speeds of calibration motions and higher than the residual speed of a noisy log at standstill. At standstill the
/// shape is zero, although a real joint stays on the side from which it came.
pub const BACKLASH_SPEED_RAD_S: f64 = 0.01;

/// Log columns that turn faster than the joint by this factor are taken as motor angles.
const GEAR_RATIO_MIN: f64 = 2.0;

fn rows(matrix: &DMatrix<f64>) -> Vec<Joints> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// Couplings between drives and joints, and the data that determine which error terms an axis can have.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveTrain {
    /// Row i: motion of each joint per radian of drive i's output.
    pub joint_from_drive: Vec<Joints>,
    /// Row i: motion of each drive per radian of joint i; the inverse of `joint_from_drive`.
    pub drive_from_joint: Vec<Joints>,
    /// Number of lobes of each drive's cycloid gear; `None` without such a gear or if the number is unknown.
    pub cycloid_lobes: Vec<Option<f64>>,
    /// Motor turns per turn of each drive's output; `None` if unknown.
    pub motor_turns: Vec<Option<f64>>,
    /// Unit vector of gravity in the robot's base.
    pub gravity: Vector3<f64>,
    joints: Vec<JointKind>,
    arm: Tracer,
}

impl DriveTrain {
    /// One drive per joint, robot upright. `arm` is the nominal chain. It gives the lever arms of weights, for which errors of
    /// a few millimetres do not matter.
    pub fn direct(arm: &Chain) -> Self {
        let axes = arm.links.len();
        let identity = rows(&DMatrix::identity(axes, axes));
        Self {
            joint_from_drive: identity.clone(),
            drive_from_joint: identity,
            cycloid_lobes: vec![None; axes],
            motor_turns: vec![None; axes],
            joints: arm.links.iter().map(|link| link.joint).collect(),
            gravity: -Vector3::z(),
            arm: Tracer::new(arm),
        }
    }

    /// Drive train from the robot's file. Couplings are those of its log (`raw_to_joint`, each row divided by its diagonal
    /// entry). If the log contains motor angles, the gear ratios come from it as well.
    pub fn of(robot: &RobotConfig, arm: &Chain) -> Self {
        let table = &robot.log.raw_to_joint;
        let axes = table.len();
        let coupled = DMatrix::from_fn(axes, axes, |i, j| table[i][j] / table[i][i]);
        let known = |numbers: &[f64], axis: usize| numbers.get(axis).copied().filter(|number| *number > 0.0);
        let turns = |axis: usize| {
            let of_log = table[axis][axis].abs().recip();
            known(&robot.drives.motor_turns, axis).or(Some(of_log).filter(|turns| *turns > GEAR_RATIO_MIN))
        };
        let mut drives = Self {
            cycloid_lobes: (0..axes).map(|axis| known(&robot.drives.cycloid_lobes, axis)).collect(),
            motor_turns: (0..axes).map(turns).collect(),
            ..Self::direct(arm)
        };
        if let Some(gravity) = robot.drives.gravity {
            drives.gravity = Vector3::from(gravity).normalize();
        }
        // If the columns are permuted, the matrix does not describe couplings.
        if let Some(inverse) =
            coupled.clone().try_inverse().filter(|m| m.iter().all(|entry| entry.is_finite()))
        {
            drives.joint_from_drive = rows(&coupled);
            drives.drive_from_joint = rows(&inverse);
        }
        drives
    }

    /// Drive states for a reported joint state.
    pub fn state(&self, reported: &JointState) -> DriveState {
        let mut state = DriveState::default();
        for axis in 0..self.axes() {
            state.angle[axis] = self.of_drive(axis, &reported.q);
            state.rate[axis] = self.of_drive(axis, &reported.qd);
            state.turn[axis] = Turn::of(state.angle[axis]);
        }
        state
    }

    fn waves_per_turn(&self, axis: usize, period: Period) -> Option<f64> {
        match period {
            Period::Once => Some(1.0),
            Period::Twice => Some(2.0),
            Period::Cycloid => *self.cycloid_lobes.get(axis)?,
            Period::Motor => *self.motor_turns.get(axis)?,
            Period::JointOnce => self.is_coupled(axis).then_some(1.0),
            Period::JointTwice => self.is_coupled(axis).then_some(2.0),
        }
    }

    /// Whether other drives turn this joint, or this drive turns other joints.
    fn is_coupled(&self, axis: usize) -> bool {
        let mut rows = self.joint_from_drive.iter().enumerate();
        self.only_joint(axis).is_none()
            || rows.any(|(drive, row)| drive != axis && row.get(axis).is_some_and(|part| *part != 0.0))
    }

    /// Motion of each joint per radian of this error term.
    fn moved_by(&self, axis: usize, term: JointTerm) -> Joints {
        if term.is_of_joint() {
            return Joints::from_fn(self.axes(), |joint| f64::from(u8::from(joint == axis)));
        }
        self.joint_from_drive.get(axis).copied().unwrap_or_default()
    }

    /// Number of axes, equal to the number of drives.
    pub fn axes(&self) -> usize {
        self.joints.len()
    }

    /// Whether this axis (from 0) can have the term. A prismatic axis can have a ratio error and a delay. A revolute axis can
    /// also have backlash, waves with a known number per turn, and compliance under a load that it raises and lowers. The loads
    /// are known for arms with six revolute axes ([`Load::acts_on`]). Other arms have the tool as load of every axis but the
    /// first.
    pub fn has(&self, axis: usize, term: JointTerm) -> bool {
        if !self.turns(axis) {
            return axis < self.axes() && matches!(term, JointTerm::Ratio | JointTerm::Delay);
        }
        match term {
            JointTerm::Sine(period) | JointTerm::Cosine(period) => {
                self.waves_per_turn(axis, period).is_some()
            }
            JointTerm::Compliance(load) if self.joints == [JointKind::Revolute; 6] => load.acts_on(axis),
            JointTerm::Compliance(load) => axis > 0 && load == Load::Tool,
            JointTerm::Backlash | JointTerm::Ratio | JointTerm::Delay => true,
        }
    }

    /// Whether the axis exists and is revolute.
    pub fn turns(&self, axis: usize) -> bool {
        self.joints.get(axis) == Some(&JointKind::Revolute)
    }

    /// Angle or rate of one drive, from those of the joints.
    pub fn of_drive(&self, axis: usize, joints: &Joints) -> f64 {
        joints.iter().zip(&self.drive_from_joint).map(|(joint, row)| joint * row[axis]).sum()
    }

    /// The only joint that this drive turns; `None` if it turns others as well.
    pub fn only_joint(&self, axis: usize) -> Option<usize> {
        let mut parts = self.joint_from_drive.get(axis)?.iter().enumerate();
        parts.all(|(joint, part)| *part == f64::from(u8::from(joint == axis))).then_some(axis)
    }

    /// Value of a term for unit amplitude, and its time derivative \[1/s\].
    fn shape(&self, axis: usize, term: JointTerm, reported: &JointState, state: &DriveState) -> (f64, f64) {
        let DriveState { angle, rate, turn } = state;
        let (angle, rate, turn) = (angle[axis], rate[axis], turn[axis]);
        // Phase angle of the wave and its time derivative.
        let wave = |period| {
            let n = self.waves_per_turn(axis, period).unwrap_or_default();
            match period {
                Period::Once => (turn, rate),
                Period::Twice => (turn.and(turn), n * rate),
                Period::Cycloid | Period::Motor => (Turn::of(n * angle), n * rate),
                Period::JointOnce | Period::JointTwice => {
                    (Turn::of(n * reported.q[axis]), n * reported.qd[axis])
                }
            }
        };
        match term {
            JointTerm::Sine(period) => {
                let (turn, rate) = wave(period);
                (turn.sin, rate * turn.cos)
            }
            JointTerm::Cosine(period) => {
                let (turn, rate) = wave(period);
                (turn.cos, -rate * turn.sin)
            }
            JointTerm::Backlash => {
                let side = (rate / BACKLASH_SPEED_RAD_S).tanh();
                let acceleration = self.of_drive(axis, &reported.qdd);
                (side, (1.0 - side * side) * acceleration / BACKLASH_SPEED_RAD_S)
            }
            JointTerm::Ratio => (angle, rate),
            JointTerm::Delay => (self.of_drive(axis, &reported.qd), self.of_drive(axis, &reported.qdd)),
            JointTerm::Compliance(load) => self.lever(axis, load, reported),
        }
    }

    /// Torque about an axis per newton of weight \[N m\], `z . ((p - o) x g)`, and its time derivative.
    fn lever(&self, axis: usize, load: Load, reported: &JointState) -> (f64, f64) {
        let mut trace = Trace::default();
        self.arm.trace(&reported.q, &mut trace);
        let axes: Vec<(Vector3<f64>, Vector3<f64>)> = trace.joint_axes().collect();
        let Some(&(origin, z)) = axes.get(axis) else { return (0.0, 0.0) };
        // Point of the load, and the number of joints that move it.
        let (point, before) = match load {
            Load::Elbow => (axes.get(2).map(|at| at.0), 2),
            Load::Wrist => (axes.get(4).map(|at| at.0), 4),
            Load::Tool => (Some(trace.position_m()), axes.len()),
        };
        let Some(point) = point else { return (0.0, 0.0) };
        let moved = |point: Vector3<f64>, joints: usize, of: fn(&Twist) -> Vector3<f64>| {
            let twists = trace.point_twists(point, joints).zip(reported.qd);
            twists.map(|(twist, rate)| of(&twist) * rate).sum::<Vector3<f64>>()
        };
        let turn = moved(origin, axis, |twist| twist.angular);
        let arm = point - origin;
        let arm_rate = moved(point, before, |twist| twist.linear) - moved(origin, axis, |twist| twist.linear);
        let torque = arm.cross(&self.gravity);
        (z.dot(&torque), turn.cross(&z).dot(&torque) + z.dot(&arm_rate.cross(&self.gravity)))
    }
}

/// Drive outputs at one instant: the arguments of the gear errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveState {
    /// Output angle of each drive \[rad\]; position of a prismatic one \[m\].
    pub angle: [f64; AXES_MAX],
    /// Rate of change of `angle`, per second.
    pub rate: [f64; AXES_MAX],
    /// Sine and cosine of each `angle`.
    pub turn: [Turn; AXES_MAX],
}

impl Default for DriveState {
    fn default() -> Self {
        let turn = [Turn { sin: 0.0, cos: 1.0 }; AXES_MAX];
        Self { angle: [0.0; AXES_MAX], rate: [0.0; AXES_MAX], turn }
    }
}

/// Amplitudes of the error terms of all axes, with their drive train.
#[derive(Debug, Clone, PartialEq)]
pub struct JointErrors {
    /// Couplings between drives and joints.
    pub drives: DriveTrain,
    /// Axis, term, amplitude; sorted by axis and term. Missing entries are zero.
    amplitudes: Vec<(usize, JointTerm, f64)>,
}

impl JointErrors {
    /// Joint errors with all amplitudes zero.
    pub fn none(drives: DriveTrain) -> Self {
        Self { drives, amplitudes: Vec::new() }
    }

    /// Whether any amplitude is not zero.
    pub(super) fn any(&self) -> bool {
        self.amplitudes.iter().any(|(_, _, amplitude)| *amplitude != 0.0)
    }

    /// Mutable amplitude of a term; `None` if the robot cannot have it.
    pub fn amplitude_mut(&mut self, axis: usize, term: JointTerm) -> Option<&mut f64> {
        if !self.drives.has(axis, term) {
            return None;
        }
        let sought = self.amplitudes.binary_search_by_key(&(axis, term), |&(axis, term, _)| (axis, term));
        let place = sought.unwrap_or_else(|place| {
            self.amplitudes.insert(place, (axis, term, 0.0));
            place
        });
        Some(&mut self.amplitudes[place].2)
    }

    /// Removes zero amplitudes, which would otherwise cost time in each sample.
    pub(super) fn drop_zeros(&mut self) {
        self.amplitudes.retain(|(_, _, amplitude)| *amplitude != 0.0);
    }

    /// Motion of each joint per unit amplitude of a term, at this drive state. For a delay pass the delayed joints as
    /// `reported`.
    pub fn by_amplitude(
        &self,
        axis: usize,
        term: JointTerm,
        reported: &JointState,
        state: &DriveState,
    ) -> Joints {
        let shape = self.drives.shape(axis, term, reported, state).0;
        let row = self.drives.moved_by(axis, term);
        let of_all = if term == JointTerm::Delay { (self.drives.axes() as f64).recip() } else { 0.0 };
        Joints::from_fn(row.len(), |joint| row[joint] * shape - of_all * reported.qd[joint])
    }

    /// Joints with the delay of each drive applied; near an end or a gap of the log by extrapolation from `reported`.
    pub(super) fn delayed(&self, reported: &JointState, motion: &impl RobotMotion, tau_s: f64) -> JointState {
        let mut delayed = *reported;
        let delays = || self.amplitudes.iter().filter(|(_, term, _)| *term == JointTerm::Delay);
        if delays().next().is_none() {
            return delayed;
        }
        let axes = self.drives.axes();
        let of_axis_s = |axis: usize| delays().find(|(of, _, _)| *of == axis).map_or(0.0, |(_, _, s)| *s);
        let of_all_s = (0..axes).map(of_axis_s).sum::<f64>() / axes.max(1) as f64;
        for axis in 0..axes {
            let delay_s = of_axis_s(axis) - of_all_s;
            if delay_s == 0.0 {
                continue;
            }
            let later = motion.at(tau_s + delay_s).unwrap_or_else(|| reported.after(delay_s));
            let by = |of: fn(&JointState) -> &Joints| {
                self.drives.of_drive(axis, of(&later)) - self.drives.of_drive(axis, of(reported))
            };
            let (q, qd, qdd) = (by(|state| &state.q), by(|state| &state.qd), by(|state| &state.qdd));
            for (joint, part) in self.drives.joint_from_drive[axis].iter().enumerate() {
                delayed.q[joint] += part * q;
                delayed.qd[joint] += part * qd;
                delayed.qdd[joint] += part * qdd;
            }
        }
        delayed
    }

    /// Adds all errors except delays to joint positions and rates. Accelerations are not changed.
    pub(super) fn add_to(&self, corrected: &mut JointState, reported: &JointState, state: &DriveState) {
        for of_axis in self.amplitudes.chunk_by(|one, next| one.0 == next.0) {
            let axis = of_axis[0].0;
            // Index 0: errors of the drive; index 1: errors of the joint.
            let mut errors = [(0.0, 0.0); 2];
            let terms = of_axis.iter().map(|(_, term, amplitude)| (*term, *amplitude));
            for (term, amplitude) in terms.filter(|(term, _)| *term != JointTerm::Delay) {
                let (shape, rate) = self.drives.shape(axis, term, reported, state);
                let error = &mut errors[usize::from(term.is_of_joint())];
                *error = (error.0 + amplitude * shape, error.1 + amplitude * rate);
            }
            let [of_drive, of_joint] = errors;
            if of_joint != (0.0, 0.0) {
                corrected.q[axis] += of_joint.0;
                corrected.qd[axis] += of_joint.1;
            }
            if of_drive == (0.0, 0.0) {
                continue;
            }
            for (joint, part) in self.drives.joint_from_drive[axis].iter().enumerate() {
                corrected.q[joint] += part * of_drive.0;
                corrected.qd[joint] += part * of_drive.1;
            }
        }
    }
}
