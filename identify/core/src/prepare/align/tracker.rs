//! Aligns a tracker's log with the robot's log. Each log has its own clock.
//!
//! The positions of the target are *observed* in the tracker's frame. They are *predicted* from the robot's log with
//! the nominal robot. The speeds of the target are compared first, because they do not depend on the poses of
//! tracker and probe. Then the positions are compared. The poses of tracker and probe are estimated at each
//! candidate for the clock (`placement`).
//!
//! There are two types of tracker logs:
//!
//! - In the first type, the robot moved while the tracker measured. The alignment estimates the shift and rate of the
//!   clocks. They are the start values of a solve, which estimates them again.
//! - In the second type, a *stop-and-go* log, the rows are more than half a second apart, and the robot stood still at
//!   each row. The alignment finds the standstill of each row (`standstills`). The joints of the robot in this
//!   standstill are assigned to the row.

mod standstills;

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use nalgebra::Vector3;
use shared::time::UtcNs;

use super::clock::{EDGE_S, SHIFT_SIGMA_S, SKEW_SIGMA};
use super::placement::{PROBE_SIGMA_M, placements};
use super::reference::ReferenceTime;
use super::speeds::{REACH, grid_step_s, speeds};
use super::window::{Best, CANDIDATES, best, extended, liveliest, no_match, overlap_min_s};
use crate::cost::{LoopProblem, MeasuredPosition, PoseNoise};
use crate::kinematics::{Chain, Joints, Pose};
use crate::logs::{CubicSpline, PoseRow, RobotLog, SPEED_M_S_MAX, Stream, TimedPoses, travel};
use crate::model::{
    Axis, ClockRelation, Coordinate, JointState, Model, ModelError, Observation, Owner, ParameterId,
    Placement, RobotMotion, Role, SetUp,
};
use crate::prepare::samples::select::select;
use crate::prepare::steps::{check_length, require_motion};
use crate::prepare::{
    AlignedLog, Alignment, Channels, ComparedLog, Match, PrepareError, PrepareOptions, candidates,
    unwrapped_log,
};
use crate::solver::{GoodShare, LossName, Options, minimise_robust};
use crate::statistics::mean;
use standstills::REST_S;

/// Rows farther apart than this are assumed to be measured at standstills \[s\]. A tracker that follows a moving target
/// measures more often than this. A tracker that waits until the target is at rest measures less often.
const STANDING_S: f64 = 0.5;
/// If the positions extend over less than this distance, the target counts as not moving \[m\].
const EXTENT_M_MIN: f64 = 0.02;
/// Largest number of rows of a fit.
const FIT_MAX: usize = 500;
/// Standard deviation of a position of the nominal robot \[m\]. Residuals are divided by it.
const NOMINAL_SIGMA_M: f64 = 1e-3;

/// Rows of a tracker's log, and the state of the robot at each of them.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedPoses {
    /// Indices of the rows that are used.
    pub rows: Vec<usize>,
    /// State of the robot at each of these rows, according to the alignment.
    pub states: Vec<JointState>,
    /// If the robot moved during the measurement: the times of these rows, and the robot's log. `None` for a stop-and-go log.
    pub moving: Option<Moving>,
    /// How the clocks were aligned. In a stop-and-go log, the accuracy of the skew is limited by the
    /// durations of the standstills.
    pub alignment: Alignment,
    /// Reference time of the alignment on the tracker's clock.
    pub t_ref: UtcNs,
    /// Number of rows that cannot be used: rows outside the robot's log and, in a stop-and-go log, rows that were measured
    /// while the robot moved. Thinned rows are not counted.
    pub left_out: usize,
}

/// Times of the rows and motion of the robot, for a log in which the robot moved during the measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct Moving {
    /// Time of each row on the tracker's clock, since the reference time \[s\].
    pub t_s: Vec<f64>,
    /// The robot's log. Its time is zero at the reference time according to the alignment.
    pub log: AlignedLog,
    /// Relative rate of the robot's clock minus one.
    pub skew: f64,
}

/// Aligns a tracker's rows with the robot's log. `robot` is the nominal robot, from its base to its flange.
///
/// # Errors
/// [`PrepareError`] of the step that failed, with the values that caused it.
pub fn align_poses(
    poses: &TimedPoses,
    log: &RobotLog,
    robot: &Chain,
    options: &PrepareOptions,
) -> Result<AlignedPoses, PrepareError> {
    let (rows_s, log_s) = (poses.rows.duration_s(), log.q_rad.duration_s());
    check_length(("the tracker's log", rows_s), log_s, options)?;
    let (unwrapped, _) = unwrapped_log(log);
    let log = &*unwrapped;
    require_motion("the robot log", travel(&log.q_rad))?;
    let interpolated = log.spline()?;
    // The clock is found from one pair of target and station, which is called the view here.
    let observed_m = longest_view_m(&poses.rows);
    let view_begins_s =
        (i128::from(observed_m.first_stamp_ns) - i128::from(poses.rows.first_stamp_ns)) as f64 * 1e-9;
    let search = TrackerSearch {
        period_s: observed_m.period_s(),
        observed_m,
        log: &interpolated,
        log_s,
        robot,
        step_s: grid_step_s(log_s),
        options,
    };
    let extent_m = search.extent_m();
    if extent_m < EXTENT_M_MIN {
        return Err(PrepareError::TargetStands { extent_mm: extent_m * 1e3 });
    }
    let Best { matched, ambiguous, fit } = search.run()?;
    // `fit.clock` counts from the first row of the view, `clock_of_rows` from the first row of the log, and `clock`
    // from the reference time.
    let clock_of_rows = fit.clock.counted_from(-view_begins_s);
    let reference = ReferenceTime::new(UtcNs(poses.rows.first_stamp_ns), rows_s, clock_of_rows, log_s);
    let alignment = reference.alignment(&matched, ambiguous, log);
    let ReferenceTime { t_ref_s, t_ref, clock, .. } = reference;
    let log = AlignedLog::new(interpolated.clone(), clock.shift_s);
    // Rows that the robot's log covers, with the state of the robot at each.
    let edge_s = if search.stop_and_go() { REST_S } else { EDGE_S };
    let covered_row = |index: usize| {
        let t_s = poses.rows.t_s[index] - t_ref_s;
        let tau_s = (1.0 + clock.skew) * t_s;
        let state = log.at(tau_s)?;
        log.covers(tau_s, edge_s).then_some(CoveredRow { index, t_s, state })
    };
    let covered: Vec<CoveredRow> = (0..poses.rows.len()).filter_map(covered_row).collect();
    // In a stop-and-go log, only rows at rest are usable. Otherwise the usable rows are thinned.
    let usable = if search.stop_and_go() {
        search.at_rest(covered, |row| clock_of_rows.robot_time_s(poses.rows.t_s[row.index]))
    } else {
        covered
    };
    let left_out = poses.rows.len() - usable.len();
    let kept = if search.stop_and_go() { usable } else { thinned(&usable, options) };
    let t_s: Vec<f64> = kept.iter().map(|row| row.t_s).collect();
    let moving = (!search.stop_and_go()).then_some(Moving { t_s, log, skew: clock.skew });
    let (rows, states) = kept.iter().map(|row| (row.index, row.state)).unzip();
    Ok(AlignedPoses { rows, states, moving, alignment, t_ref, left_out })
}

/// A row of the tracker's log whose time is within the robot's log.
#[derive(Clone, Copy)]
struct CoveredRow {
    /// Index in the tracker's log.
    index: usize,
    /// Time on the tracker's clock since the reference time \[s\].
    t_s: f64,
    state: JointState,
}

/// Selects rows that are spread over the motion of the robot.
fn thinned(rows: &[CoveredRow], options: &PrepareOptions) -> Vec<CoveredRow> {
    let joints: Vec<Joints> = rows.iter().map(|row| row.state.q).collect();
    let points_max = if options.points_max == 0 { usize::MAX } else { options.points_max };
    let selected = select(&joints, options.motion_min_mrad * 1e-3, points_max);
    selected.into_iter().map(|place| rows[place]).collect()
}

/// Positions of one target from one station, in the tracker's frame \[m\]. The pair of target and station with the most rows
/// is selected. The clock is found from this pair, and is valid for the rows of all pairs.
fn longest_view_m(rows: &Stream<PoseRow>) -> Stream<Vector3<f64>> {
    let mut counts: BTreeMap<SetUp, usize> = BTreeMap::new();
    for row in rows.iter() {
        *counts.entry(row.set_up).or_default() += 1;
    }
    let longest = counts.into_iter().max_by_key(|(_, count)| *count).map(|(view, _)| view);
    let position_in_longest = |_, row: &PoseRow| (Some(row.set_up) == longest).then_some(row.position_m);
    let observed_m = rows.filter_map(0..rows.len(), position_in_longest);
    // The new stream computes its limit for gaps from its own rows. Otherwise, rows of other targets between two
    // rows of this target would cause a gap.
    Stream::new(observed_m.first_stamp_ns, observed_m.t_s, observed_m.rows)
}

/// A tracker's log, and the robot's log in which the motion of the target is searched for.
struct TrackerSearch<'a> {
    /// Positions of one target from one station, in the tracker's frame \[m\].
    observed_m: Stream<Vector3<f64>>,
    /// Usual time between two rows \[s\].
    period_s: f64,
    log: &'a Arc<CubicSpline<Joints>>,
    /// Duration of the robot's log \[s\].
    log_s: f64,
    /// The nominal robot, from its base to its flange.
    robot: &'a Chain,
    /// Step of the grid on which speeds are compared \[s\].
    step_s: f64,
    options: &'a PrepareOptions,
}

/// Clock and position of the target at which the rows fit the nominal robot.
struct TrackerFit {
    clock: ClockRelation,
    /// Position of the target in the flange frame \[m\].
    probe_m: Vector3<f64>,
    /// Robust standard deviation of a coordinate, estimated from the 90 % quantile of the rows \[m\].
    spread_m: f64,
}

impl TrackerSearch<'_> {
    /// Finds the best fit in the window and extends it to the whole log. If no fit is found, the search is repeated
    /// with a shorter required overlap. If this second search finds a clear match, the returned error reports that
    /// the overlap of the logs is too short.
    fn run(&self) -> Result<Best<TrackerFit>, PrepareError> {
        let window = if self.stop_and_go() {
            0..self.observed_m.len()
        } else {
            liveliest(&self.observed_m.t_s, |pair| {
                (self.observed_m[pair[0]] - self.observed_m[pair[1]]).norm()
            })
        };
        let overlap_min_s = overlap_min_s(self.options, self.duration_s(&window), self.log_s);
        let refused = match self.best_fit(&window, overlap_min_s) {
            Err(refused) => refused,
            Ok(best) => {
                let refit = |window: &Range<usize>, fit: &TrackerFit| self.fit(window, fit.clock);
                return Ok(Best { fit: extended(&self.observed_m.t_s, window, best.fit, refit)?, ..best });
            }
        };
        /// Fraction of the required overlap that the repeated search requires. With a shorter overlap, different motions
        /// would match by chance.
        const SHORTER: f64 = 0.25;
        /// Smallest correlation of a clear match. In a short overlap, a lower correlation could occur by chance.
        const ALIKE: f64 = 0.95;
        match self.best_fit(&window, SHORTER * overlap_min_s) {
            Ok(Best { matched, .. }) if matched.correlation > ALIKE => Err(PrepareError::ShortOverlap {
                overlap_s: matched.overlap as f64 * self.step_s,
                needed_s: overlap_min_s,
            }),
            _ => Err(refused),
        }
    }

    /// Finds the best fit of the rows in `window`.
    fn best_fit(&self, window: &Range<usize>, overlap_min_s: f64) -> Result<Best<TrackerFit>, PrepareError> {
        let overlap_min = (overlap_min_s / self.step_s) as usize;
        let observed = self.observed_speeds(window);
        // The position of the target on the flange is not known yet, so the speed of the flange is used.
        let of_flange = self.predicted_speeds(&Vector3::zeros());
        let shifts = candidates(&of_flange, &observed, overlap_min, CANDIDATES);
        let first_s = self.observed_m.t_s.get(window.start).copied().unwrap_or_default();
        // The clock for a shift between the first row of the window and the first stamp of the robot's log.
        let clock = |shift: f64| ClockRelation { shift_s: shift * self.step_s - first_s, skew: 0.0 };
        let fits: Vec<TrackerFit> = if self.stop_and_go() {
            let clocks = shifts.iter().flat_map(|near| self.clocks_at_standstills(window, clock(near.shift)));
            clocks.filter_map(|clock| self.fit_at_standstills(window, clock)).collect()
        } else {
            shifts.iter().filter_map(|coarse| self.fit(window, clock(coarse.shift))).collect()
        };
        // The match of the speeds at the clock of a fit. The predicted speeds are those of the target at the position that
        // the fit has found.
        let match_of_target = |fit: &TrackerFit| {
            if self.stop_and_go() {
                return self.match_of_distances(window, fit);
            }
            let of_target = self.predicted_speeds(&fit.probe_m);
            let found = candidates(&of_target, &observed, overlap_min, CANDIDATES);
            let fitted_shift = fit.clock.robot_time_s(first_s) / self.step_s;
            /// Shifts that differ by less than this number of grid steps count as the same.
            const SAME: f64 = 10.0;
            found.into_iter().find(|matched| (matched.shift - fitted_shift).abs() < SAME)
        };
        let with_match = |fit: TrackerFit| Some((match_of_target(&fit)?, fit));
        let mut matching: Vec<(Match, TrackerFit)> = fits.into_iter().filter_map(with_match).collect();
        let highest = matching.iter().map(|(matched, _)| matched.correlation).fold(0.0, f64::max);
        matching.retain(|(matched, _)| matched.correlation >= self.options.correlation_min);
        let are_apart = |fit: &TrackerFit, other: &TrackerFit| {
            (fit.clock.shift_s - other.clock.shift_s).abs() > STANDING_S
        };
        best(matching, |fit| fit.spread_m, are_apart).ok_or_else(|| {
            let highest = shifts.first().map(|best| (highest, best.overlap as f64 * self.step_s));
            no_match(ComparedLog::Tracker, highest, overlap_min_s, self.options)
        })
    }

    fn duration_s(&self, window: &Range<usize>) -> f64 {
        let times_s = self.observed_m.t_s.get(window.clone()).unwrap_or_default();
        times_s.last().zip(times_s.first()).map_or(0.0, |(last, first)| last - first)
    }

    /// Whether the log is a stop-and-go log: each row was measured at a standstill of the robot.
    fn stop_and_go(&self) -> bool {
        self.period_s > STANDING_S
    }

    /// Selects the rows at which the robot is at rest, and sets the robot's speeds there to zero. `log_time_s` returns the
    /// time of a row in the robot's log.
    fn at_rest(&self, rows: Vec<CoveredRow>, log_time_s: impl Fn(&CoveredRow) -> f64) -> Vec<CoveredRow> {
        let resting = self.resting();
        let rests = |row: &CoveredRow| self.rests_at(&resting, log_time_s(row)) == Some(true);
        let at_rest = |row: CoveredRow| CoveredRow { state: JointState::at_rest(row.state.q), ..row };
        rows.into_iter().filter(rests).map(at_rest).collect()
    }

    /// Diagonal of the smallest box that contains all positions \[m\].
    fn extent_m(&self) -> f64 {
        let Some(first) = self.observed_m.first() else { return 0.0 };
        let low = self.observed_m.iter().fold(*first, |low, p| low.inf(p));
        let high = self.observed_m.iter().fold(*first, |high, p| high.sup(p));
        (high - low).norm()
    }

    /// Measured speed of the target, from the first row of the window on. In a stop-and-go log, it is the mean
    /// speed between two rows.
    fn observed_speeds(&self, window: &Range<usize>) -> Channels {
        let observed_m = self.observed_m.slice(window.clone());
        let steps =
            if observed_m.len() < 2 { 0 } else { (observed_m.duration_s() / self.step_s) as usize + 1 };
        // The positions are interpolated linearly. If the stamps jitter, a smoother curve through the rows would oscillate.
        if !self.stop_and_go() {
            let position = |step: usize| observed_m.at(step as f64 * self.step_s);
            return self.speeds(&(0..steps).map(position).collect::<Vec<_>>(), REACH);
        }
        let mean_speed = |step: usize| {
            let after = observed_m.t_s.partition_point(|row_s| *row_s <= step as f64 * self.step_s);
            let after = after.clamp(1, observed_m.len() - 1);
            (observed_m[after] - observed_m[after - 1]).norm()
                / (observed_m.t_s[after] - observed_m.t_s[after - 1])
        };
        Channels { known: vec![true; steps], values: vec![(0..steps).map(mean_speed).collect()] }
    }

    /// Predicted speed of a target at `probe_m` on the flange of the nominal robot, from the first stamp of the robot's log on.
    fn predicted_speeds(&self, probe_m: &Vector3<f64>) -> Channels {
        let steps = (self.log_s / self.step_s) as usize + 1;
        let points: Vec<Option<Vector3<f64>>> =
            (0..steps).map(|step| self.predicted_m(step as f64 * self.step_s, probe_m)).collect();
        // In a stop-and-go log, the speed is the mean over the usual time between two rows, like the observed speed.
        let reach = if self.stop_and_go() { (0.5 * self.period_s / self.step_s) as usize } else { REACH };
        self.speeds(&points, reach)
    }

    /// Speeds from positions on the grid \[m\], in one channel.
    fn speeds(&self, points_m: &[Option<Vector3<f64>>], reach: usize) -> Channels {
        let distance_m = |before: &Vector3<f64>, after: &Vector3<f64>, _| (after - before).norm();
        speeds(points_m, 1, reach, self.step_s, SPEED_M_S_MAX, distance_m)
    }

    /// Predicted position of the target in the robot's frame \[m\]; `None` outside the robot's log.
    fn predicted_m(&self, tau_s: f64, probe_m: &Vector3<f64>) -> Option<Vector3<f64>> {
        Some(self.flange(tau_s)?.transform_point(&(*probe_m).into()).coords)
    }

    /// Pose of the nominal robot's flange at a time of the robot's log; `None` outside the log.
    fn flange(&self, tau_s: f64) -> Option<Pose> {
        Some(self.robot.forward(&self.log.at(tau_s)?.value))
    }

    /// Rows of a window that are within the robot's log, with a margin, selected so that they are spread over the motion.
    fn rows_to_fit(&self, window: &Range<usize>, clock: ClockRelation) -> Vec<usize> {
        let log = AlignedLog::new(self.log.clone(), 0.0);
        let stays = |row: &usize| log.covers(clock.robot_time_s(self.observed_m.t_s[*row]), EDGE_S);
        let stride = window.len().div_ceil(20 * FIT_MAX).max(1);
        let rows: Vec<usize> = window.clone().step_by(stride).filter(stays).collect();
        let points: Vec<[f64; 3]> = rows.iter().map(|row| self.observed_m[*row].into()).collect();
        select(&points, 0.0, FIT_MAX).into_iter().map(|place| rows[place]).collect()
    }

    /// Fits the clock, the pose of the tracker and the position of the target, starting from the clock `coarse`. `None` if
    /// the rows do not determine them.
    fn fit(&self, window: &Range<usize>, coarse: ClockRelation) -> Option<TrackerFit> {
        let rows = self.rows_to_fit(window, coarse);
        // Times are counted from the mean of the rows' times, because shift and skew are then nearly independent.
        let middle_s = mean(rows.iter().map(|row| self.observed_m.t_s[*row]));
        let motion = AlignedLog::new(self.log.clone(), coarse.robot_time_s(middle_s));
        let observed_m: Vec<Vector3<f64>> = rows.iter().map(|row| self.observed_m[*row]).collect();
        let observation = |row: &usize| Observation::time_only(self.observed_m.t_s[*row] - middle_s);
        let observations: Vec<Observation> = rows.iter().map(observation).collect();
        let flange = |row: &usize| self.flange(coarse.robot_time_s(self.observed_m.t_s[*row]));
        let flanges = rows.iter().map(flange).collect::<Option<Vec<Pose>>>()?;
        let [tracker, probe] = placements(&flanges, &observed_m, std::iter::empty())?;
        let model = self.prior_model(&tracker, &probe, coarse.skew).ok()?;
        let sigma = PoseNoise { position_m: NOMINAL_SIGMA_M, rotation_rad: 1.0 };
        let pose_row = |position_m: &Vector3<f64>| PoseRow { position_m: *position_m, ..PoseRow::default() };
        let pose_rows: Vec<PoseRow> = observed_m.iter().map(pose_row).collect();
        let residual = MeasuredPosition { rows: &pose_rows, noise: &vec![sigma; rows.len()] };
        let problem = LoopProblem::new(&model, &motion, &observations, residual, 1.0).ok()?;
        let start = model.start();
        let (x, _) = minimise_robust(&problem, &start, LossName::Huber, &Options::default()).ok()?;
        let geometry = model.geometry(&x);
        Some(TrackerFit {
            clock: motion.solved(geometry.clock).counted_from(-middle_s),
            probe_m: geometry.tracker.probes.first()?.position_m,
            spread_m: NOMINAL_SIGMA_M * GoodShare::NINE_TENTHS.spread_at(&problem, &x),
        })
    }

    /// Model of the nominal robot with one station and one target, and priors of the clocks. The poses `tracker` and
    /// `probe` are start values.
    fn prior_model(&self, tracker: &Placement, probe: &Placement, skew: f64) -> Result<Model, ModelError> {
        let mut model = Model::alone(self.robot).with_set_ups(Owner::Tracker, [1, 1]);
        for coordinate in Coordinate::ALL {
            let id = ParameterId::Tracker { station: 0, coordinate };
            model.set_value(id, tracker.coordinate(coordinate))?;
            model.set_role(id, Role::Free)?;
        }
        for coordinate in Axis::ALL.map(Coordinate::Position) {
            let id = ParameterId::Probe { target: 0, coordinate };
            model.set_value(id, probe.coordinate(coordinate))?;
            model.set_role(id, Role::Prior { value: 0.0, sigma: PROBE_SIGMA_M })?;
        }
        model.set_value(ParameterId::ClockSkew, skew)?;
        model.set_role(ParameterId::ClockShift, Role::Prior { value: 0.0, sigma: SHIFT_SIGMA_S })?;
        model.set_role(ParameterId::ClockSkew, Role::Prior { value: skew, sigma: SKEW_SIGMA })?;
        Ok(model)
    }
}
