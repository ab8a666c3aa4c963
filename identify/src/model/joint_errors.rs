//! From the joint angles that a robot reports to those that it has.
//!
//! Errors of gears repeat with the angle of the gear's output, which is not always a joint of the model: where a rod or
//! bevel gears couple drives, `g = q C^-1` are the drives' angles (row vector times matrix) and `C` says what a drive's
//! turn does to each joint. With amplitudes `a` and shapes `s`
//!
//! `q' = q + e(g, dg/dt) C`, `e_i = sum_t a_it s_t(g_i)`.
//!
//! Shapes are functions of what was reported, so that errors enter linearly: `dq'/da_it = s_t(g_i) C_i`.

use nalgebra::{Matrix6, Vector3};
use shared::config::RobotConfig;

use super::{JointState, JointTerm, Load, Period};
use crate::kinematics::{Chain, ROBOT_JOINTS, Trace, Tracer};

/// Speed at which backlash has changed sides by three quarters \[rad/s\]: the shape is `tanh(rate / speed)`. Slower than
/// any motion that is calibrated on, faster than what is left of a standstill in a noisy log. At a standstill the shape
/// is zero, although a real joint stays on the side from which it came.
pub const BACKLASH_SPEED_RAD_S: f64 = 0.01;

/// Logs whose columns turn faster than the joint by this factor are of motors.
const GEAR_RATIO_MIN: f64 = 2.0;

fn rows(matrix: &Matrix6<f64>) -> [[f64; ROBOT_JOINTS]; ROBOT_JOINTS] {
    std::array::from_fn(|i| std::array::from_fn(|j| matrix[(i, j)]))
}

/// How drives move joints, and what errors they can have.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveTrain {
    /// Row i: what one radian of drive i's output does to each joint.
    pub joint_from_drive: [[f64; ROBOT_JOINTS]; ROBOT_JOINTS],
    /// Row i: how much each drive turns for one radian of joint i; the inverse.
    pub drive_from_joint: [[f64; ROBOT_JOINTS]; ROBOT_JOINTS],
    /// Lobes of each drive's cycloid gear; none where there is no such gear or its number is not known.
    pub cycloid_lobes: [Option<f64>; ROBOT_JOINTS],
    /// Turns of each motor for one turn of its drive's output; none where not known.
    pub motor_turns: [Option<f64>; ROBOT_JOINTS],
    /// Direction of gravity in the robot's base.
    pub gravity: Vector3<f64>,
    arm: Tracer,
}

impl DriveTrain {
    /// One drive for each joint, the robot standing upright. `arm` is the nominal chain, from which levers of weights are
    /// computed: millimetres make no difference to them.
    pub fn direct(arm: &Chain) -> Self {
        let identity = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
        Self {
            joint_from_drive: identity,
            drive_from_joint: identity,
            cycloid_lobes: [None; ROBOT_JOINTS],
            motor_turns: [None; ROBOT_JOINTS],
            gravity: -Vector3::z(),
            arm: Tracer::new(arm),
        }
    }

    /// As the robot's file says: couplings are those of its log (`raw_to_joint`, each row over its diagonal entry), the
    /// motors' turns too where it is a log of motors.
    pub fn of(robot: &RobotConfig, arm: &Chain) -> Self {
        let table = &robot.log.raw_to_joint;
        let ratio: [f64; ROBOT_JOINTS] = std::array::from_fn(|i| table[i][i]);
        let coupled = Matrix6::from_fn(|i, j| table[i][j] / ratio[i]);
        let known = |number: f64| (number > 0.0).then_some(number);
        let turns = |axis: usize| {
            let of_log = ratio[axis].abs().recip();
            known(robot.drives.motor_turns[axis]).or(Some(of_log).filter(|turns| *turns > GEAR_RATIO_MIN))
        };
        let mut drives = Self {
            cycloid_lobes: robot.drives.cycloid_lobes.map(known),
            motor_turns: std::array::from_fn(turns),
            ..Self::direct(arm)
        };
        if let Some(gravity) = robot.drives.gravity {
            drives.gravity = Vector3::from(gravity).normalize();
        }
        // A log whose columns are in another order says nothing of couplings.
        if let Some(inverse) = coupled.try_inverse().filter(|m| m.iter().all(|entry| entry.is_finite())) {
            drives.joint_from_drive = rows(&coupled);
            drives.drive_from_joint = rows(&inverse);
        }
        drives
    }

    fn waves_per_turn(&self, axis: usize, period: Period) -> Option<f64> {
        match period {
            Period::Once => Some(1.0),
            Period::Twice => Some(2.0),
            Period::Cycloid => *self.cycloid_lobes.get(axis)?,
            Period::Motor => *self.motor_turns.get(axis)?,
        }
    }

    /// This robot's axis (from 0) can have the term: for waves, because their number is known.
    pub fn has(&self, axis: usize, term: JointTerm) -> bool {
        match term {
            JointTerm::Sine(period) | JointTerm::Cosine(period) => {
                self.waves_per_turn(axis, period).is_some()
            }
            _ => term.acts_on(axis),
        }
    }

    /// A drive's angle or speed from those of the joints.
    pub fn of_drive(&self, axis: usize, joints: &[f64; ROBOT_JOINTS]) -> f64 {
        joints.iter().zip(&self.drive_from_joint).map(|(joint, row)| joint * row[axis]).sum()
    }

    /// The joint that a drive turns alone; none where it turns others, too.
    pub fn only_joint(&self, axis: usize) -> Option<usize> {
        let mut parts = self.joint_from_drive.get(axis)?.iter().enumerate();
        parts.all(|(joint, part)| *part == f64::from(u8::from(joint == axis))).then_some(axis)
    }

    /// A term's value for an amplitude of one, and how fast it changes \[1/s\].
    fn shape(&self, axis: usize, term: JointTerm, reported: &JointState) -> (f64, f64) {
        let (angle, rate) = (self.of_drive(axis, &reported.q), self.of_drive(axis, &reported.qd));
        let wave = |period, quarter_turns: f64| {
            let n = self.waves_per_turn(axis, period).unwrap_or_default();
            let (sin, cos) = (n * angle + quarter_turns * std::f64::consts::FRAC_PI_2).sin_cos();
            (sin, n * rate * cos)
        };
        match term {
            JointTerm::Sine(period) => wave(period, 0.0),
            JointTerm::Cosine(period) => wave(period, 1.0),
            JointTerm::Backlash => {
                let side = (rate / BACKLASH_SPEED_RAD_S).tanh();
                let acceleration = self.of_drive(axis, &reported.qdd);
                (side, (1.0 - side * side) * acceleration / BACKLASH_SPEED_RAD_S)
            }
            JointTerm::Ratio => (angle, rate),
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
            Load::Tool => (Some(trace.position_m()), ROBOT_JOINTS),
        };
        let Some(point) = point else { return (0.0, 0.0) };
        let turning = |joints: usize| axes.iter().zip(reported.qd).take(joints);
        let velocity = |of: Vector3<f64>, joints: usize| {
            turning(joints).map(|((from, z), rate)| z.cross(&(of - from)) * rate).sum::<Vector3<f64>>()
        };
        let turn: Vector3<f64> = turning(axis).map(|((_, z), rate)| z * rate).sum();
        let arm = point - origin;
        let arm_rate = velocity(point, before) - velocity(origin, axis);
        let torque = arm.cross(&self.gravity);
        (z.dot(&torque), turn.cross(&z).dot(&torque) + z.dot(&arm_rate.cross(&self.gravity)))
    }
}

/// Amplitudes of all terms on all axes, and what they belong to.
#[derive(Debug, Clone, PartialEq)]
pub struct JointErrors {
    /// How drives move joints.
    pub drives: DriveTrain,
    amplitudes: [[f64; JointTerm::ALL.len()]; ROBOT_JOINTS],
}

impl JointErrors {
    /// No errors.
    pub fn none(drives: DriveTrain) -> Self {
        Self { drives, amplitudes: Default::default() }
    }

    /// One amplitude; none where the robot cannot have the term.
    pub fn amplitude_mut(&mut self, axis: usize, term: JointTerm) -> Option<&mut f64> {
        if !self.drives.has(axis, term) {
            return None;
        }
        self.amplitudes.get_mut(axis)?.get_mut(term.index())
    }

    /// How each joint moves with one amplitude.
    pub fn by_amplitude(&self, axis: usize, term: JointTerm, reported: &JointState) -> [f64; ROBOT_JOINTS] {
        let shape = self.drives.shape(axis, term, reported).0;
        self.drives.joint_from_drive.get(axis).map_or([0.0; ROBOT_JOINTS], |row| row.map(|part| part * shape))
    }

    /// Joints and rates without their errors. Accelerations are passed on as they are.
    pub fn corrected(&self, reported: &JointState) -> JointState {
        let mut corrected = *reported;
        for (axis, amplitudes) in self.amplitudes.iter().enumerate() {
            let terms =
                JointTerm::ALL.into_iter().zip(amplitudes).filter(|(_, amplitude)| **amplitude != 0.0);
            let mut error = (0.0, 0.0);
            for (term, amplitude) in terms {
                let (shape, rate) = self.drives.shape(axis, term, reported);
                error = (error.0 + amplitude * shape, error.1 + amplitude * rate);
            }
            if error == (0.0, 0.0) {
                continue;
            }
            for (joint, part) in self.drives.joint_from_drive[axis].iter().enumerate() {
                corrected.q[joint] += part * error.0;
                corrected.qd[joint] += part * error.1;
            }
        }
        corrected
    }
}
