//! Finds the sphere on which the robot's positions lie, from the robot's log alone. Its centre `o` is the base of the bar,
//! and its radius is the bar's length `L`.
//!
//! Random sample consensus finds a first sphere. A least-squares fit to the positions near this sphere follows. In this fit,
//! the configured length of the bar is the prior of the radius. If the positions do not lie on a sphere of the bar's length,
//! the run is refused. To find the cause, likely mistakes in the joints of the log are corrected one after the other. If the
//! corrected positions lie on a sphere of the bar's length, the message names this mistake.

use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use shared::config::RobotConfig;

use super::{PrepareError, PrepareOptions};
use crate::kinematics::{Chain, Joints, Trace, Tracer};
use crate::logs::{JointConversion, JointMistake, RobotLog, ranges};
use crate::statistics::{median, rms};

/// A sphere through robot positions.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct SphereFit {
    /// Centre \[m\].
    pub centre_m: Vector3<f64>,
    /// Radius \[m\].
    pub radius_m: f64,
    /// Root mean square distance of the inliers from the sphere \[m\].
    pub rms_m: f64,
    /// Fraction of the positions that are inliers: their distance from the sphere is within the tolerance.
    pub inliers: f64,
}

/// Largest number of rows of the log that are used: six minutes at 250 Hz.
const ROWS_MAX: usize = 100_000;
/// A robot position is used only if it is farther than this from the last used position \[m\].
const POSITIONS_APART_M: f64 = 0.005;
/// Number of draws of four positions for a first sphere. If half of the positions are outliers, one draw in
/// sixteen contains no outlier.
const DRAWS: usize = 200;
/// Number of rounds; each selects the inliers and fits a sphere to them.
const ROUNDS: usize = 5;
/// Number of Gauss-Newton steps in each fit.
const STEPS: usize = 8;
/// Standard deviation of the bar's configured length \[m\].
const LENGTH_SIGMA_M: f64 = 0.002;
/// The weight of the prior assumes this number of independent positions, whatever the real number is. Distances from the
/// sphere are mostly errors of the nominal robot, which are similar in neighbouring postures.
const POSITIONS_INDEPENDENT: f64 = 50.0;

/// Finds the sphere of the bar on which the robot's positions lie.
///
/// # Errors
/// [`PrepareError`] if the positions lie on no sphere, or on the sphere of another bar. The error contains the probable cause.
pub(super) fn sphere_of_log(
    log: &RobotLog,
    robot: &Chain,
    config: &RobotConfig,
    length_m: f64,
    options: &PrepareOptions,
) -> Result<SphereFit, PrepareError> {
    let positions = distinct_positions(log, robot);
    let tolerance_mm = options.sphere_tolerance_mm;
    if is_flat(&positions) {
        return Err(PrepareError::LittleMotion);
    }
    let sphere = fit_sphere(&positions, tolerance_mm * 1e-3).ok_or(PrepareError::LittleMotion)?;
    let likely = || likely_mistake(log, robot, config, length_m, options);
    if sphere.inliers < 0.5 {
        let inliers_percent = 100.0 * sphere.inliers;
        return Err(PrepareError::NotASphere { inliers_percent, tolerance_mm, likely: likely() });
    }
    if (sphere.radius_m - length_m).abs() * 1e3 > options.length_tolerance_mm {
        return Err(PrepareError::OtherLength {
            found_mm: sphere.radius_m * 1e3,
            configured_mm: length_m * 1e3,
            likely: likely(),
        });
    }
    Ok(sphere.with_length_prior(&positions, tolerance_mm * 1e-3, length_m))
}

/// Positions of the robot's end in the log, each farther than [`POSITIONS_APART_M`] from the one before \[m\].
fn distinct_positions(log: &RobotLog, robot: &Chain) -> Vec<Vector3<f64>> {
    let mut positions: Vec<Vector3<f64>> = Vec::new();
    // A row is skipped without forward kinematics if its joints have moved so little that the end cannot have moved far enough.
    // A joint moves the end by at most its own travel, times the reach if the joint is revolute. Most rows are skipped.
    let reach_m = (robot.reach_m() + robot.last_from_end.translation.vector.norm()).max(1.0);
    let (tracer, mut trace, mut last_q) = (Tracer::new(robot), Trace::default(), None::<&Joints>);
    let is_near = |last: &Joints, q: &Joints| {
        let travel_rad: f64 = last.iter().zip(q.iter()).map(|(last, q)| (last - q).abs()).sum();
        travel_rad * reach_m < POSITIONS_APART_M
    };
    for q in log.q_rad.iter().step_by(log.q_rad.len().div_ceil(ROWS_MAX).max(1)) {
        if last_q.is_some_and(|last| is_near(last, q)) {
            continue;
        }
        tracer.trace(q, &mut trace);
        let position = trace.end().translation.vector;
        if positions.last().is_none_or(|last| (last - position).norm() > POSITIONS_APART_M) {
            positions.push(position);
            last_q = Some(q);
        }
    }
    positions
}

/// Describes the probable mistake in the joints of a log whose positions lie on no sphere of the bar's length. The
/// correction of each mistake is tried once in the joints of the model, and once in the columns of the robot's own log. A
/// coupling of joints 2 and 3 is tried in the joints of the model only. The mistake whose correction puts most positions on
/// a sphere of the bar's length is reported. If no correction puts enough positions on such a sphere, two other causes are
/// tried: first a turned plate, then a joint that never moves.
fn likely_mistake(
    log: &RobotLog,
    robot: &Chain,
    config: &RobotConfig,
    length_m: f64,
    options: &PrepareOptions,
) -> Option<String> {
    /// Smallest fraction of the positions on the sphere. With a wrong joint, about half of the positions lie on it by
    /// chance and at standstills.
    const ON_SPHERE_MIN: f64 = 0.8;
    /// Largest range of values in a column that counts as constant. It allows for rounding.
    const CONSTANT: f64 = 1e-9;
    let joints = tried_joints(log);
    let conversion =
        JointConversion::from_robot(config).ok().filter(|conversion| conversion.axes() == log.axes());
    let columns: Option<Vec<Joints>> =
        conversion.as_ref().map(|conversion| joints.iter().map(|q| conversion.to_raw(q)).collect());
    // The sphere of the given joints, if it has the bar's length and enough inliers.
    let sphere_of_bar = |joints: Vec<Joints>| {
        let positions: Vec<_> = joints.iter().map(|q| robot.forward(q).translation.vector).collect();
        let sphere = fit_sphere(&positions, options.sphere_tolerance_mm * 1e-3)?;
        let has_length = (sphere.radius_m - length_m).abs() * 1e3 < options.length_tolerance_mm;
        (has_length && sphere.inliers > ON_SPHERE_MIN && !is_flat(&positions)).then_some(sphere)
    };
    // The spheres after the correction of a mistake: in the joints of the model, and in the columns of the log.
    let spheres_without = |mistake: JointMistake| {
        let corrected_joints = joints.iter().map(|q| mistake.undone(q, robot.joint_kinds())).collect();
        let corrected_columns = conversion.as_ref().zip(columns.as_ref()).map(|(conversion, columns)| {
            let undone = |raw: &Joints| mistake.undone(raw, config.joint_kinds());
            columns.iter().map(|raw| conversion.to_joint(&undone(raw))).collect()
        });
        let corrected = [Some(corrected_joints), corrected_columns].into_iter().flatten();
        corrected
            .filter_map(sphere_of_bar)
            .map(move |sphere| (mistake.to_string(), sphere))
            .collect::<Vec<_>>()
    };
    // Many controllers count joint 3 from the horizontal: joint 2 is then added to it, or subtracted from it.
    let sphere_coupled = |factor: f64| {
        let coupled = |q: &Joints| {
            let mut q = *q;
            q[2] += factor * q[1];
            q
        };
        let sphere = sphere_of_bar(joints.iter().map(coupled).collect())?;
        Some((format!("joint 3 needs {factor:+} times joint 2 (coupling)"), sphere))
    };
    let coupled = [1.0, -1.0].into_iter().filter(|_| log.axes() > 2).filter_map(sphere_coupled);
    let found = JointMistake::all(log.axes()).into_iter().flat_map(spheres_without).chain(coupled);
    let best =
        found.max_by(|(_, a), (_, b)| a.inliers.total_cmp(&b.inliers).then(b.rms_m.total_cmp(&a.rms_m)));
    if let Some((mistake, sphere)) = best {
        return Some(format!(
            "{mistake}: with this corrected {:.0} % lie on a sphere of the bar's length; correct the log's columns or the robot's file",
            100.0 * sphere.inliers
        ));
    }
    if let Some(turned) = turned_plate(log, robot, length_m, options) {
        return Some(turned);
    }
    let first_constant =
        |rows: &Vec<Joints>| ranges(rows).iter().position(|[low, high]| high - low < CONSTANT);
    let in_columns = columns.as_ref().and_then(first_constant);
    let joint = first_constant(&joints).into_iter().chain(in_columns).min()?;
    Some(format!(
        "joint {} never moves in the log while others do: check what the logger reads for it",
        joint + 1
    ))
}

/// Joints in a limited number of rows, evenly spaced in the log. These rows suffice to decide whether the positions
/// lie on one sphere.
fn tried_joints(log: &RobotLog) -> Vec<Joints> {
    const ROWS: usize = 400;
    let stride = log.q_rad.len().div_ceil(ROWS).max(1);
    log.q_rad.iter().step_by(stride).copied().collect()
}

/// Describes a plate that is turned about the flange's axis against the configuration. `None` if no turn brings the
/// positions much nearer to a sphere of the bar's length.
pub(super) fn turned_plate(
    log: &RobotLog,
    robot: &Chain,
    length_m: f64,
    options: &PrepareOptions,
) -> Option<String> {
    /// Steps between the turns that are tried: `FIRST_STEP_DEG` in a coarse search, then `STEP_DEG` near its best turn
    /// \[deg\]. Half a fine step moves the positions by no more than the errors of nominal robots. Half a coarse step moves
    /// them by less than the tolerance of a sphere.
    const STEP_DEG: f64 = 1.0;
    const FIRST_STEP_DEG: f64 = 3.0;
    /// Largest ratio of the median distance from the sphere after the turn to the median distance before the turn.
    const REDUCED_TO: f64 = 0.4;
    let joints = tried_joints(log);
    let last = log.axes().checked_sub(1)?;
    let positions_after = |by_deg: f64| {
        let position = |q: &Joints| {
            let mut q = *q;
            q[last] += by_deg.to_radians();
            robot.forward(&q).translation.vector
        };
        joints.iter().map(position).collect::<Vec<_>>()
    };
    // Turns the plate by `by_deg`. Returns this angle, the sphere through the new positions, and the median distance
    // of all new positions from this sphere.
    let turned = |by_deg: f64| {
        let positions = positions_after(by_deg);
        let sphere = fit_sphere(&positions, options.sphere_tolerance_mm * 1e-3)?;
        // Outliers are included in the median. Otherwise a sphere through a few positions would be the best.
        let mut distances_m: Vec<f64> = positions.iter().map(|p| sphere.distance(p).abs()).collect();
        Some((by_deg, sphere, median(&mut distances_m)?))
    };
    let (_, _, as_configured_m) = turned(0.0)?;
    let best = |from_deg: f64, to_deg: f64, step_deg: f64| {
        let steps = ((to_deg - from_deg) / step_deg) as u32;
        let tried = (0..=steps).filter_map(|step| turned(from_deg + f64::from(step) * step_deg));
        tried.min_by(|(.., a_m), (.., b_m)| a_m.total_cmp(b_m))
    };
    let (near_deg, ..) = best(-180.0, 180.0 - FIRST_STEP_DEG, FIRST_STEP_DEG)?;
    let (by_deg, sphere, distance_m) = best(near_deg - FIRST_STEP_DEG, near_deg + FIRST_STEP_DEG, STEP_DEG)?;
    let has_length = (sphere.radius_m - length_m).abs() * 1e3 < options.length_tolerance_mm;
    (has_length && by_deg != 0.0 && distance_m < REDUCED_TO * as_configured_m).then(|| {
        format!(
            "the offset plate is rotated by about {by_deg:+.0} degrees on the flange, or the zero of joint {} is wrong by this angle: \
             with it half of the positions are within {:.1} mm of a sphere of the bar's length, without it within {:.1} mm. Add it to \
             theta_deg of the last link in the robot's file, or mount the plate as configured",
            last + 1,
            distance_m * 1e3,
            as_configured_m * 1e3
        )
    })
}

/// Whether the positions lie nearly in a plane. A sphere is then not determined, because a circle lies on many spheres.
fn is_flat(positions_m: &[Vector3<f64>]) -> bool {
    /// Smallest ratio of thickness to extent at which positions on a part of a sphere determine its radius.
    const THICKNESS_MIN: f64 = 0.02;
    let mean = positions_m.iter().sum::<Vector3<f64>>() / positions_m.len().max(1) as f64;
    let outer = |sum: Matrix3<f64>, p: &Vector3<f64>| sum + (p - mean) * (p - mean).transpose();
    let extents = positions_m.iter().fold(Matrix3::zeros(), outer).symmetric_eigenvalues();
    extents.min() < THICKNESS_MIN * THICKNESS_MIN * extents.max()
}

/// Finds the sphere on which most of `positions_m` lie within `tolerance_m`; `None` if the positions span no sphere.
///
/// A log usually also contains the motion to the bar and away from it. A first sphere through four positions is chosen so
/// that most other positions agree with it (random sample consensus, Fischler and Bolles 1981, with a fixed seed). This
/// excludes the motion to and from the bar. Linear least squares and Gauss-Newton then minimise the distances of the
/// positions near the sphere. These two fits alternate with the selection of the near positions.
pub fn fit_sphere(positions_m: &[Vector3<f64>], tolerance_m: f64) -> Option<SphereFit> {
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let mut best: Option<(usize, SphereFit)> = None;
    for _ in 0..DRAWS {
        let draw: [Vector3<f64>; 4] = [(); 4].map(|()| {
            positions_m.get(random.random_range(0..positions_m.len().max(1))).copied().unwrap_or_default()
        });
        let Some(sphere) = SphereFit::linear(&draw) else { continue };
        let agreeing = positions_m.iter().filter(|p| sphere.distance(p).abs() < tolerance_m).count();
        if best.is_none_or(|(most, _)| agreeing > most) {
            best = Some((agreeing, sphere));
        }
    }
    let (_, mut sphere) = best?;
    let mut inliers = Vec::new();
    for _ in 0..ROUNDS {
        inliers = sphere.near(positions_m, tolerance_m);
        sphere = SphereFit::linear(&inliers)?.refined(&inliers, None)?;
    }
    let share = inliers.len() as f64 / positions_m.len() as f64;
    Some(SphereFit { rms_m: sphere.rms(&inliers), inliers: share, ..sphere })
}

impl SphereFit {
    /// Fits the sphere again with a prior on its radius. If the positions cover only a part of a sphere, centre and radius
    /// are hard to separate. Returns `self` if the fit fails.
    fn with_length_prior(self, positions_m: &[Vector3<f64>], tolerance_m: f64, length_m: f64) -> Self {
        let inliers = self.near(positions_m, tolerance_m);
        // The prior has the weight of `weight` positions. This is the variance of the distances over the variance of the
        // prior, scaled from [`POSITIONS_INDEPENDENT`] to the real number of positions.
        let weight = inliers.len() as f64 / POSITIONS_INDEPENDENT * (self.rms_m / LENGTH_SIGMA_M).powi(2);
        let Some(sphere) = self.refined(&inliers, Some((length_m, weight))) else { return self };
        Self { rms_m: sphere.rms(&inliers), ..sphere }
    }

    /// Signed distance of a position from the sphere, positive outside \[m\].
    fn distance(&self, position_m: &Vector3<f64>) -> f64 {
        (position_m - self.centre_m).norm() - self.radius_m
    }

    /// The positions whose distance from the sphere is less than `distance_m`.
    fn near(&self, positions_m: &[Vector3<f64>], distance_m: f64) -> Vec<Vector3<f64>> {
        positions_m.iter().filter(|p| self.distance(p).abs() < distance_m).copied().collect()
    }

    /// Linear fit of `|p|^2 = 2 p o + (L^2 - |o|^2)`; `None` if the points lie in a plane.
    fn linear(positions_m: &[Vector3<f64>]) -> Option<Self> {
        /// Smallest ratio of singular values of points that span a sphere.
        const RATIO_MIN: f64 = 1e-3;
        let mean = positions_m.iter().sum::<Vector3<f64>>() / positions_m.len().max(1) as f64;
        let size = positions_m.iter().map(|p| (p - mean).norm()).fold(0.0, f64::max);
        if positions_m.len() < 4 || size.partial_cmp(&1e-6).is_none_or(std::cmp::Ordering::is_le) {
            return None;
        }
        let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for position in positions_m {
            // Scaled to unit size about the mean, so that the columns are comparable.
            let scaled = (position - mean) / size;
            let row = (2.0 * scaled).push(1.0);
            normal += row * row.transpose();
            right += row * scaled.norm_squared();
        }
        let eigen = normal.symmetric_eigenvalues();
        if eigen.min() < RATIO_MIN * RATIO_MIN * eigen.max() {
            return None;
        }
        let solution = normal.cholesky()?.solve(&right);
        let centre = Vector3::new(solution[0], solution[1], solution[2]);
        let radius = (solution[3] + centre.norm_squared()).sqrt();
        Some(Self { centre_m: mean + centre * size, radius_m: radius * size, ..Self::default() })
            .filter(|sphere| sphere.radius_m.is_finite())
    }

    fn rms(&self, positions_m: &[Vector3<f64>]) -> f64 {
        rms(positions_m.iter().map(|p| self.distance(p)))
    }

    /// Minimises the distances by Gauss-Newton. `expected` is the expected radius \[m\] and its weight, where one
    /// position has weight 1.
    fn refined(mut self, positions_m: &[Vector3<f64>], expected: Option<(f64, f64)>) -> Option<Self> {
        let (length_m, weight) = expected.unwrap_or_default();
        for _ in 0..STEPS {
            let mut normal = Matrix4::zeros();
            let mut right = Vector4::zeros();
            normal[(3, 3)] = weight;
            right[3] = weight * (length_m - self.radius_m);
            for position in positions_m {
                let from_centre = position - self.centre_m;
                let outward = from_centre / from_centre.norm().max(f64::MIN_POSITIVE);
                let row = Vector4::new(-outward.x, -outward.y, -outward.z, -1.0);
                normal += row * row.transpose();
                right -= row * self.distance(position);
            }
            let step = normal.cholesky()?.solve(&right);
            self.centre_m += step.fixed_rows::<3>(0);
            self.radius_m += step[3];
        }
        Some(self).filter(|sphere| sphere.radius_m.is_finite())
    }
}
