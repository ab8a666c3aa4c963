//! From the joint angles that a robot reports to those that it has.
//!
//! Errors of gears repeat with the angle of the gear's output, which is not always a joint of the model: where a rod or
//! bevel gears couple drives, `g = q C^-1` are the drives' angles (row vector times matrix) and `C` says what a drive's
//! turn does to each joint. With amplitudes `a` and shapes `s`
//!
//! `q' = q + e(g, dg/dt) C`, `e_i = sum_t a_it s_t(g_i)`.
//!
//! Where drives are coupled a joint may have errors of its own beside, `s_t(q_i)` on joint `i` alone: of a bearing, or of an encoder
//! on the joint.
//!
//! Shapes are functions of what was reported, so that errors enter linearly: `dq'/da_it = s_t(g_i) C_i`. But for a delay `d_i`,
//! which takes the drive's angle from another instant of the log: `e_i = g_i(t + d_i - d) - g_i(t)`. As a shape, a rate, it would
//! multiply the noise of the log. What all have in common, their mean `d`, is the clock's.

use nalgebra::{DMatrix, Vector3};
use shared::config::{JointKind, RobotConfig};

use super::{JointState, JointTerm, Load, Period, RobotMotion};
use crate::kinematics::{AXES_MAX, Chain, Joints, Trace, Tracer, Turn, Twist};

/// Speed at which backlash has changed sides by three quarters \[rad/s\]: the shape is `tanh(rate / speed)`. Slower than
/// any motion that is calibrated on, faster than what is left of a standstill in a noisy log. At a standstill the shape
/// is zero, although a real joint stays on the side from which it came.
pub const BACKLASH_SPEED_RAD_S: f64 = 0.01;

/// Logs whose columns turn faster than the joint by this factor are of motors.
const GEAR_RATIO_MIN: f64 = 2.0;

fn rows(matrix: &DMatrix<f64>) -> Vec<Joints> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// How drives move joints, and what errors they can have.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveTrain {
    /// Row i: what one radian of drive i's output does to each joint.
    pub joint_from_drive: Vec<Joints>,
    /// Row i: how much each drive turns for one radian of joint i; the inverse.
    pub drive_from_joint: Vec<Joints>,
    /// Lobes of each drive's cycloid gear; none where there is no such gear or its number is not known.
    pub cycloid_lobes: Vec<Option<f64>>,
    /// Turns of each motor for one turn of its drive's output; none where not known.
    pub motor_turns: Vec<Option<f64>>,
    /// Direction of gravity in the robot's base.
    pub gravity: Vector3<f64>,
    joints: Vec<JointKind>,
    arm: Tracer,
}

impl DriveTrain {
    /// One drive for each joint, the robot standing upright. `arm` is the nominal chain, from which levers of weights are
    /// computed: millimetres make no difference to them.
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

    /// As the robot's file says: couplings are those of its log (`raw_to_joint`, each row over its diagonal entry), the
    /// motors' turns too where it is a log of motors.
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
        // A log whose columns are in another order says nothing of couplings.
        if let Some(inverse) =
            coupled.clone().try_inverse().filter(|m| m.iter().all(|entry| entry.is_finite()))
        {
            drives.joint_from_drive = rows(&coupled);
            drives.drive_from_joint = rows(&inverse);
        }
        drives
    }

    /// Where the drives are while the robot reports these joints.
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

    /// The joint is not turned by its drive alone, or the drive turns others.
    fn is_coupled(&self, axis: usize) -> bool {
        let mut rows = self.joint_from_drive.iter().enumerate();
        self.only_joint(axis).is_none()
            || rows.any(|(drive, row)| drive != axis && row.get(axis).is_some_and(|part| *part != 0.0))
    }

    /// How each joint moves with an error of one radian.
    fn moved_by(&self, axis: usize, term: JointTerm) -> Joints {
        if term.is_of_joint() {
            return Joints::from_fn(self.axes(), |joint| f64::from(u8::from(joint == axis)));
        }
        self.joint_from_drive.get(axis).copied().unwrap_or_default()
    }

    /// Number of drives, and of axes.
    pub fn axes(&self) -> usize {
        self.joints.len()
    }

    /// This robot's axis (from 0) can have the term: a prismatic one another ratio or a delay; a revolute one waves whose number is known,
    /// and a load that it moves up and down. Which those are is known of arms of six revolute axes ([`Load::acts_on`]); of
    /// others the tool is taken, on every axis after the first.
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

    /// The axis is there and revolute.
    pub fn turns(&self, axis: usize) -> bool {
        self.joints.get(axis) == Some(&JointKind::Revolute)
    }

    /// A drive's angle or speed from those of the joints.
    pub fn of_drive(&self, axis: usize, joints: &Joints) -> f64 {
        joints.iter().zip(&self.drive_from_joint).map(|(joint, row)| joint * row[axis]).sum()
    }

    /// The joint that a drive turns alone; none where it turns others, too.
    pub fn only_joint(&self, axis: usize) -> Option<usize> {
        let mut parts = self.joint_from_drive.get(axis)?.iter().enumerate();
        parts.all(|(joint, part)| *part == f64::from(u8::from(joint == axis))).then_some(axis)
    }

    /// A term's value for an amplitude of one, and how fast it changes \[1/s\].
    fn shape(&self, axis: usize, term: JointTerm, reported: &JointState, state: &DriveState) -> (f64, f64) {
        let DriveState { angle, rate, turn } = state;
        let (angle, rate, turn) = (angle[axis], rate[axis], turn[axis]);
        // Angle of the wave, how fast it grows.
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

    /// Torque of one newton of weight about an axis \[N m\], `z . ((p - o) x g)`, and how fast it changes.
    fn lever(&self, axis: usize, load: Load, reported: &JointState) -> (f64, f64) {
        let mut trace = Trace::default();
        self.arm.trace(&reported.q, &mut trace);
        let axes: Vec<(Vector3<f64>, Vector3<f64>)> = trace.joint_axes().collect();
        let Some(&(origin, z)) = axes.get(axis) else { return (0.0, 0.0) };
        // The point and the number of joints before it.
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

/// Where drives are, by which errors of gears go.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveState {
    /// Of each drive's output \[rad\], of a prismatic one \[m\].
    pub angle: [f64; AXES_MAX],
    /// How fast it changes, per second.
    pub rate: [f64; AXES_MAX],
    /// Sine and cosine of the angle.
    pub turn: [Turn; AXES_MAX],
}

impl Default for DriveState {
    fn default() -> Self {
        let turn = [Turn { sin: 0.0, cos: 1.0 }; AXES_MAX];
        Self { angle: [0.0; AXES_MAX], rate: [0.0; AXES_MAX], turn }
    }
}

/// Amplitudes of terms of axes, and what they belong to.
#[derive(Debug, Clone, PartialEq)]
pub struct JointErrors {
    /// How drives move joints.
    pub drives: DriveTrain,
    /// Axis, term, amplitude; in the order of axes and terms. Those that are not there are zero.
    amplitudes: Vec<(usize, JointTerm, f64)>,
}

impl JointErrors {
    /// No errors.
    pub fn none(drives: DriveTrain) -> Self {
        Self { drives, amplitudes: Vec::new() }
    }

    /// Whether any amplitude is not zero.
    pub(super) fn any(&self) -> bool {
        self.amplitudes.iter().any(|(_, _, amplitude)| *amplitude != 0.0)
    }

    /// One amplitude; none where the robot cannot have the term.
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

    /// The same errors without those of zero, which each sample would look at.
    pub(super) fn drop_zeros(&mut self) {
        self.amplitudes.retain(|(_, _, amplitude)| *amplitude != 0.0);
    }

    /// How each joint moves with one amplitude, the drives standing like this; with a delay it does as the delayed joints move,
    /// which are `reported` then.
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

    /// What the log has of each drive when it comes later than the others; near an end or a hole of the log by its rate.
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

    /// Adds the errors of joints and rates, but delays. Accelerations stay as they are.
    pub(super) fn add_to(&self, corrected: &mut JointState, reported: &JointState, state: &DriveState) {
        for of_axis in self.amplitudes.chunk_by(|one, next| one.0 == next.0) {
            let axis = of_axis[0].0;
            // Of the drive, of the joint.
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
