//! Checks a path that is given by the robot's joints, from `identify plan` or from other programs. At steps of 1 ms, the
//! module computes the bar's joints and checks all constraints. The result contains the first violation and the total
//! duration of each violated constraint, the extremes of the motion, and the information of the path.

use crate::kinematics::{BAR_JOINTS, Joints, ball_bar_inverse_refined, singularity_margin_rad};
use crate::logs::{CubicSpline, RobotLog, SplinePoint};
use crate::model::JointState;
use crate::solver::Normal;
use crate::statistics::largest_size;

use super::{Constraints, Information, Obstacle, Visited};

/// Time between two checked poses \[s\].
const CHECK_S: f64 = 1e-3;
/// Largest rotation of an encoder cable since the start of the path \[rad\].
const WINDING_RAD_MAX: f64 = std::f64::consts::TAU;
/// Largest gap between the end of the nominal robot and the end of the bar \[m\]. It is smaller than the errors of
/// robots before a calibration.
const OFF_SPHERE_M_MAX: f64 = 0.5e-3;
/// One of this number of checked poses contributes to the information of the path.
const CHECKS_PER_POSE: usize = 100;
/// Largest time between two rows of a path \[s\]. With a longer gap, the motion between the rows would be unknown.
const GAP_S_MAX: f64 = 1.0;

/// Why a path cannot be checked.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CheckError {
    /// The time between two rows is too long.
    #[error(
        "the path has rows more than {GAP_S_MAX} s apart, at {t_s:.3} s; give its joints at least every {GAP_S_MAX} s"
    )]
    Gap {
        /// Start of the gap \[s\].
        t_s: f64,
    },
    /// The bar cannot reach the robot's end.
    #[error("the bar does not reach the robot's end at {t_s:.3} s; check --base and the lengths of the bar")]
    NoBar {
        /// Time on the path \[s\].
        t_s: f64,
    },
}

/// A constraint that a path violates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathViolation {
    /// The violated constraint.
    pub obstacle: Obstacle,
    /// Start of the first violation \[s\].
    pub first_s: f64,
    /// Total duration of all violations of this constraint \[s\].
    pub duration_s: f64,
}

/// Result of the check of a path: violations, extremes, and information.
#[derive(Debug, Clone, PartialEq)]
pub struct Checked {
    /// Duration from the first row to the last \[s\].
    pub duration_s: f64,
    /// Violated constraints, in the order of their first violation.
    pub violations: Vec<PathViolation>,
    /// Highest speed of each robot joint \[rad/s, m/s\].
    pub speed_rad_s: Joints,
    /// Highest acceleration of each robot joint \[rad/s², m/s²\].
    pub acceleration_rad_s2: Joints,
    /// Highest jerk of each robot joint \[rad/s³, m/s³\].
    pub jerk_rad_s3: Joints,
    /// Lowest and highest value of each robot joint \[rad, m\].
    pub joint_range_rad: Vec<[f64; 2]>,
    /// Lowest and highest angle of each bar joint, relative to the start of the path \[rad\].
    pub winding_rad: [[f64; 2]; BAR_JOINTS],
    /// Smallest distance to a singular pose of the bar \[rad\].
    pub bar_margin_rad: f64,
    /// Smallest singular value of the robot's Jacobian. Metres and radians have equal weight.
    pub dexterity: f64,
    /// Smallest distance between robot, bar and cell \[m\]; `None` if no bodies are known.
    pub clearance_m: Option<f64>,
    /// Largest gap between the ends of robot and bar \[m\].
    pub off_sphere_m: f64,
    /// Poses along the path, a tenth of a second apart.
    pub visited: Visited,
    /// Normal equations of a calibration on the path.
    pub normal: Normal,
}

/// Interpolates the rows of a path.
///
/// # Errors
/// [`CheckError::Gap`].
pub(super) fn curve(path: &RobotLog) -> Result<CubicSpline<Joints>, CheckError> {
    let gap = path.q_rad.t_s.windows(2).find(|pair| pair[1] - pair[0] > GAP_S_MAX);
    let curve = (*path.q_rad).clone().with_gap_limit(GAP_S_MAX).spline();
    curve.filter(|_| gap.is_none()).ok_or(CheckError::Gap { t_s: gap.map_or(0.0, |pair| pair[0]) })
}

/// Checks a path of the nominal robot.
///
/// # Errors
/// [`CheckError`] if the path has gaps or the bar cannot follow it.
pub fn check(
    path: &RobotLog,
    constraints: &Constraints<'_>,
    information: &Information,
) -> Result<Checked, CheckError> {
    let curve = curve(path)?;
    let (robot, bar, design) = (constraints.robot, constraints.bar, constraints.design);
    let duration_s = path.q_rad.duration_s();
    let axes = path.axes();
    let mut checked = Checked {
        duration_s,
        violations: Vec::new(),
        speed_rad_s: Joints::zeros(axes),
        acceleration_rad_s2: Joints::zeros(axes),
        jerk_rad_s3: Joints::zeros(axes),
        joint_range_rad: vec![[f64::INFINITY, f64::NEG_INFINITY]; axes],
        winding_rad: [[0.0; 2]; BAR_JOINTS],
        bar_margin_rad: f64::INFINITY,
        dexterity: f64::INFINITY,
        clearance_m: None,
        off_sphere_m: 0.0,
        visited: Visited::default(),
        normal: Normal::zeros(information.columns()),
    };
    let mut bar_rad: [f64; BAR_JOINTS] =
        design.bar_range_deg.map(|[low, high]| (0.5 * (low + high)).to_radians());
    let mut start_rad = None;
    let mut last_acceleration: Option<Joints> = None;
    // At each time step, compute the joints of the bar by inverse kinematics, the violated constraints, and the extremes.
    for step in 0..=(duration_s / CHECK_S).floor() as usize {
        let t_s = step as f64 * CHECK_S;
        let Some(point) = curve.at(t_s) else { return Err(CheckError::Gap { t_s }) };
        let target = robot.forward(&point.value);
        bar_rad = ball_bar_inverse_refined(bar, &target, &bar_rad).map_err(|_| CheckError::NoBar { t_s })?;
        let start_rad = *start_rad.get_or_insert(bar_rad);
        let last = last_acceleration.replace(point.acceleration).unwrap_or(point.acceleration);
        let instant = Instant {
            off_sphere_m: (bar.forward(&bar_rad).translation.vector - target.translation.vector).norm(),
            bar_margin_rad: singularity_margin_rad(&bar.links, &bar_rad),
            wound_rad: std::array::from_fn(|joint| bar_rad[joint] - start_rad[joint]),
            jerk_rad_s3: Joints::from_fn(axes, |axis| (point.acceleration[axis] - last[axis]) / CHECK_S),
            point,
        };
        instant.violated(constraints).for_each(|obstacle| checked.count(obstacle, t_s));
        checked.include(&instant, constraints);
        if step % CHECKS_PER_POSE == 0 {
            checked.visited.bar_rad.push(bar_rad);
            let SplinePoint { value: q, rate: qd, acceleration: qdd } = point;
            checked.visited.robot.push(JointState { q, qd, qdd });
        }
    }
    checked.normal = information.normal(&checked.visited, CHECK_S * CHECKS_PER_POSE as f64);
    Ok(checked)
}

/// Robot and bar at an instant of a path.
struct Instant {
    point: SplinePoint<Joints>,
    jerk_rad_s3: Joints,
    /// Rotation of the bar's joints since the start of the path \[rad\].
    wound_rad: [f64; BAR_JOINTS],
    bar_margin_rad: f64,
    off_sphere_m: f64,
}

impl Instant {
    /// The constraints that are violated at this instant.
    fn violated(&self, constraints: &Constraints<'_>) -> impl Iterator<Item = Obstacle> {
        let (point, design) = (&self.point, constraints.design);
        let is_near_singular = self.bar_margin_rad < design.bar_margin_deg.to_radians();
        let is_wound_up = self.wound_rad.iter().any(|wound| wound.abs() > WINDING_RAD_MAX);
        let mut speeds = point.rate.iter().zip(design.speeds_max(constraints.robot));
        let is_too_fast = speeds.any(|(rate, speed_max)| rate.abs() > speed_max);
        let accelerates_too_much = largest_size(point.acceleration.iter()) > constraints.acceleration_rad_s2;
        let obstacles = [
            (self.off_sphere_m > OFF_SPHERE_M_MAX).then_some(Obstacle::OffSphere),
            is_near_singular.then_some(Obstacle::BarSingularity),
            constraints.robot_is_comfortable(&point.value).err(),
            is_too_fast.then_some(Obstacle::Speed),
            accelerates_too_much.then_some(Obstacle::Acceleration),
            is_wound_up.then_some(Obstacle::Cable),
        ];
        obstacles.into_iter().flatten()
    }
}

impl Checked {
    /// Counts one checked pose at `t_s` that violates the constraint `obstacle`.
    fn count(&mut self, obstacle: Obstacle, t_s: f64) {
        match self.violations.iter_mut().find(|known| known.obstacle == obstacle) {
            Some(known) => known.duration_s += CHECK_S,
            None => self.violations.push(PathViolation { obstacle, first_s: t_s, duration_s: CHECK_S }),
        }
    }

    /// Extends the extremes by the values at an instant.
    fn include(&mut self, instant: &Instant, constraints: &Constraints<'_>) {
        let Instant { point, jerk_rad_s3, wound_rad, bar_margin_rad, off_sphere_m } = instant;
        self.off_sphere_m = self.off_sphere_m.max(*off_sphere_m);
        self.bar_margin_rad = self.bar_margin_rad.min(*bar_margin_rad);
        self.dexterity = self.dexterity.min(constraints.dexterity(&point.value));
        if let Some(bodies) = &constraints.bodies {
            let clearance_m = bodies.clearance_m(constraints.robot, constraints.bar, &point.value);
            self.clearance_m = Some(self.clearance_m.map_or(clearance_m, |least| least.min(clearance_m)));
        }
        let ranges = self.winding_rad.iter_mut().zip(wound_rad);
        for ([low, high], value) in ranges.chain(self.joint_range_rad.iter_mut().zip(point.value.iter())) {
            (*low, *high) = (low.min(*value), high.max(*value));
        }
        raise(&mut self.speed_rad_s, &point.rate);
        raise(&mut self.acceleration_rad_s2, &point.acceleration);
        raise(&mut self.jerk_rad_s3, jerk_rad_s3);
    }
}

/// Sets each maximum to the absolute value of the same element of `values`, if this absolute value is larger.
fn raise(maxima: &mut Joints, values: &Joints) {
    for (most, value) in maxima.iter_mut().zip(values.iter()) {
        *most = most.max(value.abs());
    }
}

#[cfg(test)]
mod tests {
    use shared::config::JointKind;

    use super::*;
    use crate::kinematics::{Chain, DhLink, Pose};
    use crate::plan::Design;

    #[test]
    fn a_prismatic_axis_has_limits_in_metres() {
        let kinds = [JointKind::Prismatic, JointKind::Revolute];
        let links = kinds.map(|joint| DhLink { joint, ..DhLink::default() }).to_vec();
        let arm = Chain::new(Pose::identity(), links);
        let design = Design { robot_speed_rad_s: 1.2, robot_speed_m_s: Some(0.5), ..Design::IRB_2400 };
        assert!(Design::IRB_2400.speeds_max(&arm).eq([1.2, 1.2]));
        let constraints = Constraints::new(&arm, &arm, &[[-1.0, 1.0]; 2], &design).with(None, 5.0);
        let violates = |obstacle: Obstacle, rate: [f64; 2], acceleration: [f64; 2]| {
            let point =
                SplinePoint { value: Joints::zeros(2), rate: rate.into(), acceleration: acceleration.into() };
            let instant = Instant {
                point,
                jerk_rad_s3: Joints::zeros(2),
                wound_rad: [0.0; BAR_JOINTS],
                bar_margin_rad: 1.0,
                off_sphere_m: 0.0,
            };
            instant.violated(&constraints).any(|violated| violated == obstacle)
        };
        for (axis, [within, beyond]) in [(0, [0.4, -0.6]), (1, [-1.1, 1.3])] {
            let of_axis = |value: f64| std::array::from_fn(|i| if i == axis { value } else { 0.0 });
            assert!(!violates(Obstacle::Speed, of_axis(within), [0.0; 2]));
            assert!(violates(Obstacle::Speed, of_axis(beyond), [0.0; 2]));
            assert!(!violates(Obstacle::Acceleration, [0.0; 2], of_axis(4.0)));
            assert!(violates(Obstacle::Acceleration, [0.0; 2], of_axis(-6.0)));
        }
    }
}
