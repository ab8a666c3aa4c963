//! Converts reported joint angles to true joint angles, for [`super::Geometry`]. The errors are those of gears, bearings and
//! joint encoders, delays in the log, and compliance under gravity.
//!
//! Gear errors are periodic in the output angle of the gear, called the drive angle. A drive angle is not always a joint
//! angle of the model, because rods or bevel gears may couple drives. Row `i` of the matrix `C` is the motion of each joint
//! per radian of drive `i`. With the joint angles `q` as a row vector, the drive angles are `g = q C^-1`. The true joint
//! angles `q'` follow from amplitudes `a` and shapes `s`, summed over the terms `t`:
//!
//! `q' = q + e(g, dg/dt) C`, `e_i = sum_t a_it s_t(g_i)`.
//!
//! If drives are coupled, a joint may also have errors of its own, from its bearing or from an encoder on the joint. Such an
//! error is `a_it s_t(q_i)` and moves joint `i` only.
//!
//! Shapes are functions of the reported state, so errors are linear in their amplitudes: `dq'/da_it = s_t(g_i) C_i`. The
//! exception is a delay `d_i`, which evaluates the drive's angle at another instant of the log:
//! `e_i = g_i(t + d_i - d) - g_i(t)`. A linear shape for a delay would be the rate `dg_i/dt`, which amplifies the noise of
//! the log. The mean `d` of all delays is subtracted because the shift of the clock represents it.

use nalgebra::{DMatrix, Vector3};
use shared::config::{JointKind, RobotConfig};

use super::{JointState, JointTerm, Load, Period, Phase, RobotMotion};
use crate::kinematics::{AXES_MAX, Chain, Joints, Trace, Tracer, Turn, Twist};
use crate::statistics::mean;

/// Scale of the drive speed in the backlash shape `tanh(rate / speed)` \[rad/s\]. At this speed the shape is about 0.76. The
/// scale is lower than the speeds of calibration motions, and higher than the apparent speed of a noisy log at standstill.
///
/// At a standstill in a log the shape is zero, although a real joint stays on the side from which it arrived. For data
/// with a standstill at every pose, `instrument::rows` therefore replaces the rate of each joint by 1 rad/s in the
/// direction of its last motion.
pub const BACKLASH_SPEED_RAD_S: f64 = 0.01;

/// If a column of the log turns faster than the joint by more than this factor, the column is assumed to be a motor angle.
const GEAR_RATIO_MIN: f64 = 2.0;

fn rows_of(matrix: &DMatrix<f64>) -> Vec<Joints> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// Couplings between drives and joints, and the data that determine which error terms an axis can have.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveTrain {
    /// Row i is the motion of each joint per radian of drive i's output.
    pub joint_from_drive: Vec<Joints>,
    /// Row i is the motion of each drive per radian of joint i. Inverse of `joint_from_drive`.
    pub drive_from_joint: Vec<Joints>,
    /// Number of lobes of each drive's cycloid gear. `None` if the drive has no such gear or if the number is unknown.
    pub cycloid_lobes: Vec<Option<f64>>,
    /// Motor turns per turn of each drive's output; `None` if unknown.
    pub motor_turns: Vec<Option<f64>>,
    /// Unit vector of gravity in the robot's base.
    pub gravity: Vector3<f64>,
    joints: Vec<JointKind>,
    /// The nominal chain, from which the lever arms of weights are computed.
    arm: Tracer,
}

impl DriveTrain {
    /// Drive train of an upright robot with one drive per joint. The lever arms of weights are computed from `arm`, the
    /// nominal chain. Errors of a few millimetres in lever arms do not matter.
    pub fn direct(arm: &Chain) -> Self {
        let axes = arm.links.len();
        let identity = rows_of(&DMatrix::identity(axes, axes));
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

    /// Drive train from the robot's file. The couplings are the matrix `raw_to_joint` of the log, with each row
    /// divided by its diagonal entry. If the log contains motor angles, gear ratios that are missing in the file are
    /// computed from this matrix.
    pub fn from_robot(robot: &RobotConfig, arm: &Chain) -> Self {
        let raw_to_joint = &robot.log.raw_to_joint;
        let axes = raw_to_joint.len();
        let joint_from_drive = DMatrix::from_fn(axes, axes, |i, j| raw_to_joint[i][j] / raw_to_joint[i][i]);
        // A value of zero in the robot's file means unknown.
        let known = |numbers: &[f64], axis: usize| numbers.get(axis).copied().filter(|number| *number > 0.0);
        let motor_turns = |axis: usize| {
            let turns_in_log = raw_to_joint[axis][axis].abs().recip();
            let of_log = Some(turns_in_log).filter(|turns| *turns > GEAR_RATIO_MIN);
            known(&robot.drives.motor_turns, axis).or(of_log)
        };
        let mut drives = Self {
            cycloid_lobes: (0..axes).map(|axis| known(&robot.drives.cycloid_lobes, axis)).collect(),
            motor_turns: (0..axes).map(motor_turns).collect(),
            ..Self::direct(arm)
        };
        if let Some(gravity) = robot.drives.gravity {
            drives.gravity = Vector3::from(gravity).normalize();
        }
        // If the columns are permuted, the matrix does not describe couplings, and its inverse is not finite.
        let inverse = joint_from_drive.clone().try_inverse();
        if let Some(inverse) = inverse.filter(|inverse| inverse.iter().all(|entry| entry.is_finite())) {
            drives.joint_from_drive = rows_of(&joint_from_drive);
            drives.drive_from_joint = rows_of(&inverse);
        }
        drives
    }

    /// Drive states for a reported joint state.
    pub fn state(&self, reported: &JointState) -> DriveState {
        let mut state = DriveState::default();
        for axis in 0..self.axes() {
            state.angle[axis] = self.of_drive(axis, &reported.q);
            state.rate[axis] = self.of_drive(axis, &reported.qd);
            state.turn[axis] = Turn::from_angle(state.angle[axis]);
        }
        state
    }

    /// Number of waves per turn. `None` if the number is unknown, or if the axis cannot have such waves.
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

    /// Motion of each joint per radian of an error term.
    fn joint_motion(&self, axis: usize, term: JointTerm) -> Joints {
        if term.is_of_joint() {
            return Joints::from_fn(self.axes(), |joint| f64::from(u8::from(joint == axis)));
        }
        self.joint_from_drive.get(axis).copied().unwrap_or_default()
    }

    /// Number of axes, equal to the number of drives.
    pub fn axes(&self) -> usize {
        self.joints.len()
    }

    /// Whether this axis (from 0) can have the term. A prismatic axis can have a ratio error and a delay. A revolute
    /// axis can also have backlash, waves with a known number per turn, and compliance under a load that it raises and
    /// lowers. In an arm with six revolute axes, [`Load::acts_on`] lists the loads of each axis. In other arms, every
    /// axis except the first has the tool as its only load.
    pub fn has(&self, axis: usize, term: JointTerm) -> bool {
        if !self.turns(axis) {
            return axis < self.axes() && matches!(term, JointTerm::Ratio | JointTerm::Delay);
        }
        match term {
            JointTerm::Wave(period, _) => self.waves_per_turn(axis, period).is_some(),
            JointTerm::Compliance(load) if self.joints == [JointKind::Revolute; 6] => load.acts_on(axis),
            JointTerm::Compliance(load) => axis > 0 && load == Load::Tool,
            JointTerm::Backlash | JointTerm::Ratio | JointTerm::Delay => true,
        }
    }

    /// Whether the axis exists and is revolute.
    pub fn turns(&self, axis: usize) -> bool {
        self.joints.get(axis) == Some(&JointKind::Revolute)
    }

    /// Angle or rate of one drive, from the angles or rates of the joints.
    pub fn of_drive(&self, axis: usize, joints: &Joints) -> f64 {
        joints.iter().zip(&self.drive_from_joint).map(|(joint, row)| joint * row[axis]).sum()
    }

    /// The single joint that this drive turns. `None` if the drive turns other joints as well.
    pub fn only_joint(&self, axis: usize) -> Option<usize> {
        let mut parts = self.joint_from_drive.get(axis)?.iter().enumerate();
        parts.all(|(joint, part)| *part == f64::from(u8::from(joint == axis))).then_some(axis)
    }

    /// Value of a term for unit amplitude, and the time derivative of this value \[1/s\].
    fn shape(&self, axis: usize, term: JointTerm, reported: &JointState, state: &DriveState) -> (f64, f64) {
        let DriveState { angle, rate, turn } = state;
        let (angle, rate, turn) = (angle[axis], rate[axis], turn[axis]);
        // For a wave, the phase angle and its time derivative.
        let wave = |period| {
            let n = self.waves_per_turn(axis, period).unwrap_or_default();
            match period {
                Period::Once => (turn, rate),
                Period::Twice => (turn.and(turn), n * rate),
                Period::Cycloid | Period::Motor => (Turn::from_angle(n * angle), n * rate),
                Period::JointOnce | Period::JointTwice => {
                    (Turn::from_angle(n * reported.q[axis]), n * reported.qd[axis])
                }
            }
        };
        match term {
            JointTerm::Wave(period, phase) => {
                let (turn, rate) = wave(period);
                match phase {
                    Phase::Sine => (turn.sin, rate * turn.cos),
                    Phase::Cosine => (turn.cos, -rate * turn.sin),
                }
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

    /// Torque about an axis per newton of weight \[m\], and its time derivative \[m/s\]. The torque is
    /// `z . ((p - r) x u)`. `z` is the direction of the axis, `r` a point on the axis, `p` the position of the load, and
    /// `u` the direction of gravity.
    fn lever(&self, axis: usize, load: Load, reported: &JointState) -> (f64, f64) {
        let mut trace = Trace::default();
        self.arm.trace(&reported.q, &mut trace);
        let axes: Vec<(Vector3<f64>, Vector3<f64>)> = trace.joint_axes().collect();
        let point_of_axis = |axis: usize| axes.get(axis).map(|(point, _)| *point);
        let Some(&(r, z)) = axes.get(axis) else { return (0.0, 0.0) };
        let (p, joints_before_p) = match load {
            Load::Elbow => (point_of_axis(2), 2),
            Load::Wrist => (point_of_axis(4), 4),
            Load::Tool => (Some(trace.position_m()), axes.len()),
        };
        let Some(p) = p else { return (0.0, 0.0) };
        // Velocity of a point that moves with the first `joints` joints. Depending on `component`, the result
        // is linear or angular.
        let velocity = |point: Vector3<f64>, joints: usize, component: fn(&Twist) -> Vector3<f64>| {
            let twists = trace.point_twists(point, joints).zip(reported.qd);
            twists.map(|(twist, rate)| component(&twist) * rate).sum::<Vector3<f64>>()
        };
        let angular_velocity = velocity(r, axis, |twist| twist.angular);
        let p_rate = velocity(p, joints_before_p, |twist| twist.linear);
        let r_rate = velocity(r, axis, |twist| twist.linear);
        let torque = (p - r).cross(&self.gravity);
        let z_rate = angular_velocity.cross(&z);
        (z.dot(&torque), z_rate.dot(&torque) + z.dot(&(p_rate - r_rate).cross(&self.gravity)))
    }
}

/// Output angles of all drives at one instant. Gear errors are functions of these angles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveState {
    /// Output angle of each drive \[rad\], or position of a prismatic drive \[m\].
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
    /// Axis, term and amplitude of each entry, sorted by axis and term. Missing entries are zero.
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

    /// Mutable amplitude of a term. `None` if the robot cannot have the term.
    pub fn amplitude_mut(&mut self, axis: usize, term: JointTerm) -> Option<&mut f64> {
        if !self.drives.has(axis, term) {
            return None;
        }
        let found = self.amplitudes.binary_search_by_key(&(axis, term), |&(axis, term, _)| (axis, term));
        let index = found.unwrap_or_else(|index| {
            self.amplitudes.insert(index, (axis, term, 0.0));
            index
        });
        Some(&mut self.amplitudes[index].2)
    }

    /// Removes zero amplitudes, because they would take time in each sample.
    pub(super) fn drop_zeros(&mut self) {
        self.amplitudes.retain(|(_, _, amplitude)| *amplitude != 0.0);
    }

    /// Motion of each joint per unit amplitude of a term. `state` are the drives at this instant. For a delay, `reported`
    /// must be the delayed joint state.
    pub fn by_amplitude(
        &self,
        axis: usize,
        term: JointTerm,
        reported: &JointState,
        state: &DriveState,
    ) -> Joints {
        let shape = self.drives.shape(axis, term, reported, state).0;
        let joint_motion = self.drives.joint_motion(axis, term);
        // The mean of all `n` delays is subtracted, and the delay of one drive changes this mean by 1/n.
        let mean_share = if term == JointTerm::Delay { (self.drives.axes() as f64).recip() } else { 0.0 };
        Joints::from_fn(joint_motion.len(), |joint| {
            joint_motion[joint] * shape - mean_share * reported.qd[joint]
        })
    }

    /// Joints with the delay of each drive applied. Where the log does not cover the delayed time, the state
    /// is extrapolated from `reported`.
    pub(super) fn delayed(&self, reported: &JointState, motion: &impl RobotMotion, tau_s: f64) -> JointState {
        let mut delayed = *reported;
        let delays = || self.amplitudes.iter().filter(|(_, term, _)| *term == JointTerm::Delay);
        if delays().next().is_none() {
            return delayed;
        }
        let axes = self.drives.axes();
        let delay_of_axis_s = |axis: usize| {
            let delay = delays().find(|(delayed_axis, _, _)| *delayed_axis == axis);
            delay.map_or(0.0, |(_, _, delay_s)| *delay_s)
        };
        let mean_delay_s = mean((0..axes).map(delay_of_axis_s));
        for axis in 0..axes {
            let delay_s = delay_of_axis_s(axis) - mean_delay_s;
            if delay_s == 0.0 {
                continue;
            }
            let later = motion.at(tau_s + delay_s).unwrap_or_else(|| reported.after(delay_s));
            // Change of the drive angle, `g_i(t + d_i - d) - g_i(t)`, and the corresponding change of its derivatives.
            let drive_change = |joints_of: fn(&JointState) -> &Joints| {
                self.drives.of_drive(axis, joints_of(&later))
                    - self.drives.of_drive(axis, joints_of(reported))
            };
            let q = drive_change(|state| &state.q);
            let qd = drive_change(|state| &state.qd);
            let qdd = drive_change(|state| &state.qdd);
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
        for axis_amplitudes in self.amplitudes.chunk_by(|(axis, _, _), (next, _, _)| axis == next) {
            let axis = axis_amplitudes[0].0;
            // Each entry is an error and its time derivative. The first entry sums the errors of the drive, the second
            // those of the joint.
            let mut errors = [(0.0, 0.0); 2];
            let terms = axis_amplitudes.iter().map(|(_, term, amplitude)| (*term, *amplitude));
            for (term, amplitude) in terms.filter(|(term, _)| *term != JointTerm::Delay) {
                let (shape, shape_rate) = self.drives.shape(axis, term, reported, state);
                let (error, error_rate) = &mut errors[usize::from(term.is_of_joint())];
                *error += amplitude * shape;
                *error_rate += amplitude * shape_rate;
            }
            let [(drive_error, drive_error_rate), (joint_error, joint_error_rate)] = errors;
            if (joint_error, joint_error_rate) != (0.0, 0.0) {
                corrected.q[axis] += joint_error;
                corrected.qd[axis] += joint_error_rate;
            }
            if (drive_error, drive_error_rate) == (0.0, 0.0) {
                continue;
            }
            for (joint, part) in self.drives.joint_from_drive[axis].iter().enumerate() {
                corrected.q[joint] += part * drive_error;
                corrected.qd[joint] += part * drive_error_rate;
            }
        }
    }
}
