//! Computes the content of the web page ten times a second: angles, speeds, state and warnings.
//!
//! Input is the latest [`Status`] of the control, with one counter value for each encoder. The
//! [`Observer`] unwraps the counters, which means that counts continue beyond the range of the counter.
//! Angles are measured from the reference mark, or from the first sample if the mark is unknown. A speed
//! is the mean over half a second. Output is a [`Moment`], which all pages share.
//!
//! One stepper computes the content for all pages, so the cost does not depend on the number of pages. It only reads the
//! published status, so it disturbs neither the control nor the bus cycle. Pages receive the latest moment. A slow page
//! misses moments, because nothing is queued.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shared::config::{EncoderConfig, HomingConfig, bar_joint_name};
use shared::encoder::{EncoderScale, Unwrapper};
use shared::recording::Disk;
use shared::recording::schema::EncoderInfo;
use shared::recording::schema::required::TRAVEL_MIN_DEG;
use shared::time::{MonoNs, NS_PER_S};
use tokio::sync::watch;

use super::controller::preflight::{hours_left, space_problem};
use super::recordings::verdict::{GradeInput, Verdict};
use super::settings::Settings;
use super::status::{EncoderStatus, Headline, RunStatus, Status};
use crate::devices::el5021;
use crate::problem::{Fact, Level, Problem};
use crate::scheduler::{Pending, Scheduler};

/// Update period of pages.
const PERIOD: Duration = Duration::from_millis(100);
/// Largest age of a sample that the page shows \[ns\]. If the last valid sample of an encoder is older,
/// the encoder is stale.
const STALE_NS: i64 = NS_PER_S;
/// Time over which speeds are averaged \[ns\]. At 100 Hz it contains 50 cycles, so one cycle more or
/// less changes the time by 2 %.
const SPEED_NS: i64 = NS_PER_S / 2;
/// Beyond this angle from the reference mark or the first sample, the cable of a joint winds up \[deg\].
const WOUND_DEG: f64 = 360.0;
/// Distance to a singular pose below which a warning appears \[deg\]. At a smaller distance, errors of two joints appear as
/// errors of the pose, magnified by more than 1 / sin(10 degrees) = 5.8.
const SINGULAR_DEG: f64 = 10.0;
/// Time since the beginning of a run after which a joint that has not moved causes a warning \[s\].
const MOVE_WITHIN_S: f64 = 15.0;
/// Highest signal frequency that an EL5021 counts at 8 to 10 bits; with more bits the limit is lower \[1/s\]. If the counter
/// has changed faster, it has restarted at another origin.
const LINES_PER_S_MAX: f64 = 250_000.0;
/// Number of columns, and of rows, of the grid of rod directions.
const CELLS: usize = 36;
/// Width of a cell, in joint 1 and in joint 2 \[deg\].
const CELL_DEG: f64 = 360.0 / CELLS as f64;

/// The page's content at one moment.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Live {
    /// Time on the host's monotonic clock \[ms\].
    pub at_ms: i64,
    /// The state, for people.
    pub headline: Headline,
    /// The state, for programs.
    pub status: Status,
    /// Angle and state of each encoder, in bus order.
    pub joints: Vec<Joint>,
    /// Problems that a person should correct before they disturb the run.
    pub warnings: Vec<Problem>,
    /// Recording time until the disk is full \[h\].
    pub disk_hours: Option<f64>,
    /// The grade that the run would have if it ended now.
    pub verdict: Option<Verdict>,
    /// Duration of the run so far \[s\].
    pub run_s: Option<f64>,
    /// Directions of the rod since the run began.
    pub coverage: Coverage,
    /// Set when counters restart, so that angles count from zero again. Absent if this has not happened since the run began.
    pub restarted: Option<Restarted>,
}

/// The latest restart of the counters, after which angles count from zero again.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Restarted {
    /// Time on the host's monotonic clock \[ms\].
    pub at_ms: i64,
    /// Time since the run began \[s\].
    pub run_s: Option<f64>,
    /// Number of cells that were visited before the latest restart; the coverage does not contain them.
    pub cells_before: usize,
}

/// Angle and state of one encoder.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Joint {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Name of the joint.
    pub name: String,
    /// Angle of the joint; absent without a valid sample in the last second \[deg\].
    pub angle_deg: Option<f64>,
    /// The angle counts from the reference mark. Otherwise it counts from the position at the first sample.
    pub from_mark: bool,
    /// Speed of the joint, averaged over half a second; absent without recent valid samples \[deg/s\].
    pub speed_deg_per_s: Option<f64>,
    /// Severity of the joint's state.
    pub level: Level,
    /// Problem of the joint, in a few words; absent if there is none.
    pub problem: Option<String>,
    /// The joint has turned as far as a calibration needs since the latest run began. If there was
    /// no run, since the first sample.
    pub has_moved: bool,
    /// Difference of the largest and smallest angle in that time. If the counter restarted, the largest
    /// difference between two restarts \[deg\].
    pub range_deg: f64,
}

/// Directions of the rod that were visited, as a grid of cells: columns are joint 1, rows are joint
/// 2, both in steps of 10 degrees.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Coverage {
    /// One bit for each cell, set if it was visited: row by row from -180 degrees, four cells in a hexadecimal digit.
    pub cells: String,
    /// Number of visited cells.
    pub visited: usize,
    /// Time since a cell was visited for the first time in the run \[s\]; absent before the first cell, and without a run.
    pub newest_s: Option<f64>,
    /// Column and row of the rod's current cell; absent if an angle is unknown.
    pub here: Option<(usize, usize)>,
    /// The angles of both joints are absolute, because they are homed and `ball_bar.toml` has `mark_deg`. Otherwise rows and
    /// columns start at an arbitrary angle.
    pub absolute: bool,
}

/// The content of the page at one moment, as a value and as JSON.
#[derive(Debug, Default)]
pub struct Moment {
    /// The content as a value.
    pub live: Live,
    /// The content as JSON text.
    pub json: String,
}

/// Duration of the history that a new page receives \[ms\].
const MINUTE_MS: i64 = 60_000;

/// Angles of the last minute, for a new page.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Minute {
    /// Times on the host's monotonic clock \[ms\].
    pub at_ms: VecDeque<i64>,
    /// Angles of each encoder, in bus order, rounded to 0.01 degrees; `None` while the encoder was stale \[deg\].
    pub angles_deg: Vec<VecDeque<Option<f64>>>,
}

impl Minute {
    fn add(&mut self, live: &Live) {
        // On a busy machine two polls may have the same time. The second moment is then omitted.
        if self.at_ms.back() == Some(&live.at_ms) {
            return;
        }
        self.at_ms.push_back(live.at_ms);
        self.angles_deg.resize_with(live.joints.len(), VecDeque::new);
        for (angles, joint) in self.angles_deg.iter_mut().zip(&live.joints) {
            angles.push_back(joint.angle_deg.map(|angle_deg| (angle_deg * 100.0).round() / 100.0));
        }
        while self.at_ms.front().is_some_and(|oldest_ms| live.at_ms - oldest_ms > MINUTE_MS) {
            self.at_ms.pop_front();
            for angles in &mut self.angles_deg {
                angles.pop_front();
            }
        }
    }
}

/// The page's content and its history, shared by all pages.
#[derive(Debug, Clone)]
pub(super) struct Watched {
    /// Channel with the latest moment.
    pub latest: watch::Receiver<Arc<Moment>>,
    minute: Arc<Mutex<Minute>>,
}

impl Watched {
    /// The angles of the last minute.
    pub fn minute(&self) -> Minute {
        self.minute.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Starts the stepper that computes and publishes moments. It ends when the sender of the status is dropped.
pub(super) fn watch(
    settings: Arc<Settings>,
    disk: Arc<dyn Disk>,
    status: watch::Receiver<Status>,
    scheduler: &Arc<dyn Scheduler>,
) -> std::io::Result<Watched> {
    let (moments, latest) = watch::channel(Arc::default());
    let minute = Arc::<Mutex<Minute>>::default();
    let watched = Watched { latest, minute: Arc::clone(&minute) };
    let mut observer = Observer::new(&settings);
    // Read the reference marks in a task, because the disk may hang. A file that cannot be read is ignored here, because
    // the pre-flight check reports it.
    let task_scheduler = Arc::clone(scheduler);
    let read_marks = move || {
        let (disk, marks_file) = (Arc::clone(&disk), settings.marks_file.clone());
        Pending::start(&*task_scheduler, "marks", move || marks_file.read(&*disk).ok().flatten())
    };
    let (mut marks, mut was_homing, mut due) = (read_marks(), false, scheduler.clock().now());
    let publish = move |now: MonoNs| {
        if status.has_changed().is_err() {
            return None;
        }
        let status = status.borrow().clone();
        // Marks change only when a homing ends, so they are read again at that moment.
        let is_homing = status.homing.as_ref().is_some_and(|homing| !homing.is_over);
        if std::mem::replace(&mut was_homing, is_homing) && !is_homing {
            marks = read_marks();
        }
        if let Some(Ok(marks)) = marks.poll() {
            observer.homing = marks;
        }
        let live = observer.next(&status, now);
        minute.lock().unwrap_or_else(PoisonError::into_inner).add(&live);
        // Serialisation fails only for a number that JSON cannot express, which would be a programming
        // error. Pages then keep the previous moment.
        if let Ok(json) = serde_json::to_string(&live) {
            moments.send_replace(Arc::new(Moment { live, json }));
        }
        due = due.plus_ns(PERIOD.as_nanos() as i64).max(now);
        Some(Duration::from_nanos(due.ns_since(now).unsigned_abs()))
    };
    scheduler.start("live", Box::new(|| Box::new(publish)))?;
    Ok(watched)
}

/// Computes each moment from the latest status and from the history of the counters.
#[derive(Default)]
pub struct Observer {
    tracks: Vec<Track>,
    /// Reference marks; `None` until they have been read, or if none are stored.
    pub homing: Option<HomingConfig>,
    rate_hz: u32,
    without_clocks: bool,
    /// Name of the current run.
    run: Option<String>,
    run_begun: MonoNs,
    /// Origin number of the counters in the previous status. The number increases when a terminal restarts its counter.
    origin: u32,
    coverage: VisitedCells,
    restarted: Option<Restarted>,
}

impl Observer {
    /// Creates an observer for the encoders of a service.
    pub fn new(settings: &Settings) -> Self {
        let tracks = settings.bar.encoders.iter().map(Track::new).collect();
        let without_clocks = !settings.daemon.distributed_clocks;
        Self { tracks, rate_hz: settings.daemon.rate_hz, without_clocks, ..Self::default() }
    }

    /// Computes the moment that belongs to `status` at the time `now`.
    pub fn next(&mut self, status: &Status, now: MonoNs) -> Live {
        self.follow_run(status, now);
        // A larger origin number means that a terminal has restarted its counter, so the tracks begin again. A smaller number
        // is normal: each run begins with origin 0, although the counters continue. After the bus was closed, for example
        // because the cycle thread died, the next session begins with origin 0, too. The counters may then have restarted, so
        // a status without encoders also resets the tracks.
        if status.encoders.is_empty() || status.origin > self.origin {
            self.tracks.iter_mut().for_each(|track| track.counter = None);
        }
        self.origin = status.origin;
        // Add the latest sample of each encoder to its track, then update the coverage.
        let marks = self.marks(status);
        let mut has_restarted = false;
        for (index, track) in self.tracks.iter_mut().enumerate() {
            let sample = status.encoders.get(index).filter(|encoder| encoder.valid);
            has_restarted |= track.add_sample(sample, status.sampled, marks.get(index).copied().flatten());
        }
        if has_restarted {
            self.restart_coverage(status.run.is_some(), now);
        }
        self.visit_cell(now);
        // Compute the content from the tracks. The warnings are last, because they depend on the rest of the content.
        let run_s = status.run.is_some().then(|| now.seconds_since(self.run_begun));
        let joints: Vec<Joint> = self
            .tracks
            .iter()
            .enumerate()
            .map(|(index, track)| {
                let sample = status.encoders.get(index).filter(|_| !status.is_without_bus());
                track.joint(sample, now)
            })
            .collect();
        let disk_hours =
            status.disk_usable_mb.map(|usable_mb| hours_left(usable_mb * 1_000_000, self.rate_hz));
        let run = status.run.as_ref().zip(run_s);
        let verdict = run.and_then(|(run, run_s)| self.verdict_so_far(run, &joints, run_s));
        let mut live = Live {
            at_ms: now.0 / 1_000_000,
            headline: status.headline(),
            warnings: Vec::new(),
            disk_hours,
            verdict,
            run_s,
            coverage: self.coverage.to_coverage(run_s.map(|_| now), self.is_absolute()),
            restarted: self.restarted,
            joints,
            status: without_histograms(status),
        };
        live.warnings = self.warnings(&live, now);
        live
    }

    /// Grade that the run would get if it ended now; `None` before any cycle is on disk. During the first seconds the travel
    /// of the joints is not graded.
    fn verdict_so_far(&self, run: &RunStatus, joints: &[Joint], run_s: f64) -> Option<Verdict> {
        let has_had_time = run_s > MOVE_WITHIN_S;
        let turned = joints.iter().filter(|_| has_had_time).map(|joint| (joint.joint, joint.range_deg));
        (run.cycles > 0).then(|| {
            Verdict::grade(&GradeInput {
                cycles: run.cycles,
                cycles_valid: run.cycles_valid,
                cycles_lost: run.cycles_lost,
                period_s: 1.0 / f64::from(self.rate_hz.max(1)),
                flagged: &run.flagged,
                recovered: false,
                without_clocks: self.without_clocks,
                turned_deg: &turned.collect::<Vec<_>>(),
            })
        })
    }

    /// Clears the coverage, because angles count from zero again and new cells cannot be compared with the earlier cells.
    fn restart_coverage(&mut self, in_run: bool, now: MonoNs) {
        let before = self.restarted.map_or(0, |restarted| restarted.cells_before);
        let cells_before = before + self.coverage.cells.len();
        self.coverage = VisitedCells::default();
        let run_s = in_run.then(|| now.seconds_since(self.run_begun));
        self.restarted = Some(Restarted { at_ms: now.0 / 1_000_000, run_s, cells_before });
    }

    /// Resets everything that is measured per run, if a new run has begun.
    fn follow_run(&mut self, status: &Status, now: MonoNs) {
        let run = status.run.as_ref().map(|run| run.name.clone());
        if run != self.run && run.is_some() {
            self.run_begun = now;
            self.coverage = VisitedCells::default();
            self.restarted = None;
            self.tracks.iter_mut().for_each(Track::begin_run);
        }
        self.run = run;
    }

    /// Reference mark of each encoder \[counts\]; `None` if the latch of the terminal no longer agrees with the mark.
    fn marks(&self, status: &Status) -> Vec<Option<u32>> {
        let Some(homing) = &self.homing else { return Vec::new() };
        let info = |track: &Track| EncoderInfo { joint: track.config.joint, scale: track.config.scale() };
        let mut infos: Vec<_> = self.tracks.iter().map(info).collect();
        let latches: Vec<_> = status.encoders.iter().map(|encoder| encoder.latch).collect();
        let stale = homing.apply(&mut infos, &latches);
        let valid_mark =
            |info: &EncoderInfo| Some(info.scale.reference_counts).filter(|_| !stale.contains(&info.joint));
        infos.iter().map(valid_mark).collect()
    }

    fn track(&self, joint: u8) -> Option<&Track> {
        self.tracks.iter().find(|track| track.config.joint == joint)
    }

    /// Whether the angles of joints 1 and 2 are absolute; see [`Coverage::absolute`].
    fn is_absolute(&self) -> bool {
        [1, 2].iter().all(|joint| self.track(*joint).is_some_and(|track| track.bar_angle_deg().is_some()))
    }

    fn visit_cell(&mut self, now: MonoNs) {
        let angle = |joint| {
            let track = self.track(joint)?;
            track.bar_angle_deg().or(track.angle_deg).filter(|_| track.is_fresh(now))
        };
        let here =
            angle(1).zip(angle(2)).map(|(angle1_deg, angle2_deg)| (cell(angle1_deg), cell(angle2_deg)));
        self.coverage.visit(here, now);
    }

    fn warnings(&self, live: &Live, now: MonoNs) -> Vec<Problem> {
        let fresh = self.tracks.iter().filter(|track| track.is_fresh(now));
        let mut facts: Vec<Fact> = fresh.flat_map(Track::warnings).collect();
        if live.run_s.is_some_and(|run_s| run_s > MOVE_WITHIN_S) {
            let still = live.joints.iter().filter(|joint| !joint.has_moved && joint.level == Level::Good);
            facts.extend(
                still.map(|joint| Fact::JointStill { joint: joint.joint, range_deg: joint.range_deg }),
            );
        }
        let restarted_s = live.run_s.and(self.restarted).and_then(|restarted| restarted.run_s);
        facts.extend(restarted_s.map(|since_s| Fact::AnglesRestarted { since_s }));
        if self.homing.is_some() && !live.status.encoders.is_empty() {
            let stale = live.joints.iter().filter(|joint| !joint.from_mark && joint.angle_deg.is_some());
            let joints: Vec<u8> = stale.map(|joint| joint.joint).collect();
            facts.extend((!joints.is_empty()).then_some(Fact::MarksStale { joints }));
        }
        let of_disk = live.disk_hours.and_then(space_problem);
        let of_cables = live.status.bad_cables.iter().cloned();
        facts.into_iter().map(Problem::from).chain(of_disk).chain(of_cables).collect()
    }
}

/// Removes the histograms of durations. They are long, and a page does not need them ten times a second.
fn without_histograms(status: &Status) -> Status {
    let mut status = status.clone();
    let timings = [
        status.run.as_mut().and_then(|run| run.timing.as_mut()),
        status.last.as_mut().and_then(|last| last.timing.as_mut()),
    ];
    for timing in timings.into_iter().flatten() {
        for durations in [&mut timing.lateness, &mut timing.round_trip, &mut timing.duration] {
            durations.histogram.clear();
        }
    }
    status
}

/// The angle of one encoder over time, from its counter.
struct Track {
    config: EncoderConfig,
    /// Converts counts to radians. Reference mark and offset are zero, so that it converts differences of counts.
    scale: EncoderScale,
    /// Reference mark from which the angle counts \[counts\]; `None` if the angle counts from the first sample.
    mark: Option<u32>,
    /// Unwraps the counts. The second value is the unwrapped count at angle zero. `None` until a sample has arrived.
    counter: Option<(Unwrapper, i64)>,
    /// Time of the latest sample.
    sampled: MonoNs,
    /// Angle at the latest sample \[deg\].
    angle_deg: Option<f64>,
    /// Times and angles \[deg\] of the samples within [`SPEED_NS`].
    recent: VecDeque<(MonoNs, f64)>,
    /// Lowest and highest angle since the run began or the counter last restarted \[deg\].
    range_deg: Option<(f64, f64)>,
    /// Largest range of the angle since the run began, over all restarts of the counter \[deg\].
    widest_deg: f64,
}

impl Track {
    fn new(config: &EncoderConfig) -> Self {
        Self {
            config: config.clone(),
            scale: config.scale(),
            mark: None,
            counter: None,
            sampled: MonoNs(0),
            angle_deg: None,
            recent: VecDeque::new(),
            range_deg: None,
            widest_deg: 0.0,
        }
    }

    fn begin_run(&mut self) {
        (self.range_deg, self.widest_deg) = (None, 0.0);
    }

    /// Adds a sample if it is valid and new. Returns true if the angle was known before and now counts from zero again.
    fn add_sample(&mut self, sample: Option<&EncoderStatus>, at: MonoNs, mark: Option<u32>) -> bool {
        let Some(sample) = sample.filter(|_| at.0 != 0 && at != self.sampled) else { return false };
        let is_continuous = self.is_continuous(sample.count, at);
        let has_restarted = !is_continuous && mark.is_none() && self.angle_deg.is_some();
        if !is_continuous || mark != self.mark {
            self.restart(sample.count, mark);
        }
        let Some((unwrapper, zero)) = &mut self.counter else { return has_restarted };
        let counts = unwrapper.next(sample.count) - *zero;
        let angle_deg = self.scale.counts_to_rad(counts).to_degrees();
        (self.sampled, self.angle_deg) = (at, Some(angle_deg));
        self.recent.push_back((at, angle_deg));
        while self.recent.front().is_some_and(|(oldest, _)| at.ns_since(*oldest) > SPEED_NS) {
            self.recent.pop_front();
        }
        let (low, high) = self.range_deg.unwrap_or((angle_deg, angle_deg));
        let (low, high) = (low.min(angle_deg), high.max(angle_deg));
        (self.range_deg, self.widest_deg) = (Some((low, high)), self.widest_deg.max(high - low));
        has_restarted
    }

    /// Whether the joint can have turned this far since the last sample. If not, the counter has restarted.
    fn is_continuous(&self, count: u32, at: MonoNs) -> bool {
        let Some((unwrapper, _)) = &self.counter else { return false };
        let turned_counts = f64::from(unwrapper.distance(count).unsigned_abs());
        let lines = turned_counts / f64::from(1u32 << self.config.interpolation_bits);
        lines <= LINES_PER_S_MAX * at.seconds_since(self.sampled).max(0.0)
    }

    /// Restarts the angle at this sample. The angle counts from the mark if there is one, otherwise from this sample.
    fn restart(&mut self, count: u32, mark: Option<u32>) {
        self.mark = mark;
        let unwrapper = EncoderScale { reference_counts: mark.unwrap_or(0), ..self.scale }.unwrapper();
        // Use a copy, because the caller passes this sample to the unwrapper again.
        let mut copy = unwrapper;
        let first = copy.next(count);
        self.counter = Some((unwrapper, mark.map_or(first, i64::from)));
        self.recent.clear();
        self.range_deg = None;
    }

    fn is_fresh(&self, now: MonoNs) -> bool {
        self.angle_deg.is_some() && now.ns_since(self.sampled) <= STALE_NS
    }

    fn speed_deg_per_s(&self) -> Option<f64> {
        let (begun, first_deg) = *self.recent.front()?;
        let (ended, last_deg) = *self.recent.back()?;
        let lasted_s = ended.seconds_since(begun);
        (lasted_s > 0.0).then(|| (last_deg - first_deg) / lasted_s)
    }

    /// Angle of the joint in the model of the bar; `None` if the mark or its angle `mark_deg` is unknown \[deg\].
    fn bar_angle_deg(&self) -> Option<f64> {
        self.mark?;
        Some(self.angle_deg? + self.config.mark_deg?)
    }

    fn joint(&self, sample: Option<&EncoderStatus>, now: MonoNs) -> Joint {
        let is_fresh = self.is_fresh(now);
        let problem = if is_fresh { None } else { Some(sample_problem(sample)) };
        Joint {
            joint: self.config.joint,
            name: bar_joint_name(self.config.joint).into(),
            angle_deg: self.angle_deg.filter(|_| is_fresh),
            from_mark: self.mark.is_some(),
            speed_deg_per_s: self.speed_deg_per_s().filter(|_| is_fresh),
            level: if is_fresh { Level::Good } else { Level::Bad },
            problem,
            has_moved: self.widest_deg >= TRAVEL_MIN_DEG,
            range_deg: self.widest_deg,
        }
    }

    fn warnings(&self) -> Vec<Fact> {
        let (joint, from_mark) = (self.config.joint, self.mark.is_some());
        let wound_deg = self.angle_deg.filter(|angle_deg| angle_deg.abs() > WOUND_DEG);
        let wound = wound_deg.map(|turned_deg| Fact::JointWound { joint, turned_deg, from_mark });
        // The pose is singular if the rod is parallel to the first axis of the bar (joint 2 at a multiple of 180 degrees) or
        // to the last axis (joint 4 at a multiple of 180 degrees).
        let distance_deg =
            self.bar_angle_deg().filter(|_| [2, 4].contains(&joint)).map(singular_distance_deg);
        let near_deg = distance_deg.filter(|distance_deg| *distance_deg < SINGULAR_DEG);
        let near = near_deg.map(|distance_deg| Fact::JointSingular { joint, distance_deg });
        let limit_deg_per_s = full_resolution_deg_per_s(&self.config);
        let fast_deg_per_s = self.speed_deg_per_s().filter(|speed| speed.abs() > limit_deg_per_s);
        let fast =
            fast_deg_per_s.map(|speed_deg_per_s| Fact::JointFast { joint, speed_deg_per_s, limit_deg_per_s });
        [wound, near, fast].into_iter().flatten().collect()
    }
}

/// Text for the page: why an encoder has no value, from the status word of its terminal.
fn sample_problem(sample: Option<&EncoderStatus>) -> String {
    let Some(sample) = sample else { return "no bus".into() };
    let status = el5021::StatusWord(sample.status);
    let text = match (sample.valid, status.amplitude_error(), status.frequency_error()) {
        (true, ..) => "no new sample",
        (_, true, _) => "signal too low: cable, plug or supply",
        (_, _, true) => "turned too fast",
        _ if status.sync_error() => "cycles not synchronous",
        _ => "no valid sample",
    };
    text.into()
}

/// Distance to the nearest multiple of 180 degrees, where the sine is zero \[deg\].
fn singular_distance_deg(angle_deg: f64) -> f64 {
    let within = angle_deg.rem_euclid(180.0);
    within.min(180.0 - within)
}

/// Joint speed above which an EL5021 omits the finest steps \[deg/s\]. The signal frequencies are values
/// of Beckhoff with a tolerance of 15 %.
fn full_resolution_deg_per_s(encoder: &EncoderConfig) -> f64 {
    let lines_per_s = match encoder.interpolation_bits {
        ..=8 => 9000.0,
        9 => 4500.0,
        10 => 2500.0,
        11 => 1500.0,
        12 => 750.0,
        13.. => 650.0,
    };
    360.0 * lines_per_s / f64::from(encoder.lines.max(1))
}

/// Index of the row or column that contains an angle.
fn cell(angle_deg: f64) -> usize {
    (((angle_deg + 180.0).rem_euclid(360.0) / CELL_DEG) as usize).min(CELLS - 1)
}

/// Cells of the sphere that the rod has visited.
#[derive(Default)]
struct VisitedCells {
    /// Indices of the visited cells: row (joint 2) times [`CELLS`] plus column (joint 1).
    cells: BTreeSet<usize>,
    newest: Option<MonoNs>,
    here: Option<(usize, usize)>,
}

impl VisitedCells {
    fn visit(&mut self, here: Option<(usize, usize)>, now: MonoNs) {
        self.here = here;
        if here.is_some_and(|(column, row)| self.cells.insert(row * CELLS + column)) {
            self.newest = Some(now);
        }
    }

    /// Returns the coverage for the page. The age of the newest cell is shown only during a run, when `now` is given.
    fn to_coverage(&self, now: Option<MonoNs>, absolute: bool) -> Coverage {
        let digit = |first: usize| {
            let visited = (first..first + 4).map(|cell| u32::from(self.cells.contains(&cell)));
            char::from_digit(visited.fold(0, |bits, visited| bits << 1 | visited), 16).unwrap_or('0')
        };
        Coverage {
            cells: (0..CELLS * CELLS).step_by(4).map(digit).collect(),
            visited: self.cells.len(),
            newest_s: now.zip(self.newest).map(|(now, newest)| now.seconds_since(newest)),
            here: self.here,
            absolute,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use shared::config::{self, BallBarConfig, DaemonConfig};
    use shared::encoder::wrap;
    use shared::time::UtcNs;

    use super::super::status::ServiceState;
    use super::*;
    use crate::homing::MarksFile;
    use crate::run::BusChoice;

    const COUNTS_PER_DEG: f64 = 14_745_600.0 / 360.0;
    const START: i64 = 5_000_000;

    /// An observer of the default bar, with the time and the counter state from which the next simulated status is made.
    struct ObservedBar {
        observer: Observer,
        now: MonoNs,
        origin: u32,
        latch: u32,
    }

    impl ObservedBar {
        fn new(change: impl FnOnce(&mut Settings)) -> Self {
            let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
            let bar: BallBarConfig = config::load(&shipped.join("ball_bar.toml")).unwrap();
            let mut settings = Settings {
                bus: BusChoice::Simulated,
                faults: Vec::new(),
                daemon: DaemonConfig::default(),
                bar,
                marks_file: MarksFile::new("state".into(), None),
                live_tap: None,
            };
            change(&mut settings);
            Self { observer: Observer::new(&settings), now: MonoNs(NS_PER_S), origin: 0, latch: START as u32 }
        }

        /// Returns the moment a tenth of a second later, with the joints at these angles. A joint
        /// without an angle has an invalid sample.
        fn at(&mut self, angles_deg: [Option<f64>; 5], run: Option<&str>) -> Live {
            self.now = self.now.plus_ns(NS_PER_S / 10);
            let latch = self.latch;
            let encoder = |(index, angle_deg): (usize, &Option<f64>)| EncoderStatus {
                joint: index as u8 + 1,
                count: wrap(START + (angle_deg.unwrap_or(0.0) * COUNTS_PER_DEG) as i64),
                latch,
                status: if angle_deg.is_some() { 0 } else { 1 << 4 },
                valid: angle_deg.is_some(),
                ..EncoderStatus::default()
            };
            let run = run.map(|name| RunStatus {
                name: name.into(),
                cycles: 2_000,
                cycles_valid: 2_000,
                ..RunStatus::default()
            });
            let status = Status {
                state: ServiceState::Writing,
                encoders: angles_deg.iter().enumerate().map(encoder).collect(),
                sampled: self.now,
                origin: self.origin,
                run,
                ..Status::default()
            };
            self.observer.next(&status, self.now)
        }

        fn turn(&mut self, joint: usize, to_deg: f64, deg_per_s: f64) -> Live {
            let steps = (to_deg / deg_per_s * 10.0) as usize;
            let at = |step: usize| {
                let mut angles = [Some(0.0); 5];
                angles[joint - 1] = Some(step as f64 * deg_per_s / 10.0);
                angles
            };
            (0..=steps).map(|step| self.at(at(step), None)).last().unwrap()
        }
    }

    fn subjects(live: &Live) -> Vec<(&str, usize)> {
        live.warnings.iter().map(|warning| warning.fact.key()).collect()
    }

    #[test]
    fn angles_and_speeds_are_those_of_the_joints_across_the_wrap_of_the_counter() {
        let mut bench = ObservedBar::new(|_| {});
        let live = bench.turn(3, 300.0, 30.0);
        let joint = &live.joints[2];
        assert!((joint.angle_deg.unwrap() - 300.0).abs() < 1e-3, "{joint:?}");
        assert!((joint.speed_deg_per_s.unwrap() - 30.0).abs() < 1e-3, "{joint:?}");
        assert!(joint.has_moved && !live.joints[0].has_moved && live.warnings.is_empty(), "{live:?}");
    }

    #[test]
    fn what_is_older_than_a_second_is_stale_and_shows_no_value() {
        let mut bench = ObservedBar::new(|_| {});
        bench.at([Some(1.0); 5], None);
        for _ in 0..9 {
            let live = bench.at([Some(1.0), None, Some(1.0), Some(1.0), Some(1.0)], None);
            assert_eq!(live.joints[1].level, Level::Good);
        }
        let live = (0..3)
            .map(|_| bench.at([Some(1.0), None, Some(1.0), Some(1.0), Some(1.0)], None))
            .last()
            .unwrap();
        assert_eq!((live.joints[1].angle_deg, live.joints[1].level), (None, Level::Bad));
        assert!(live.joints[1].problem.as_ref().unwrap().contains("signal too low"), "{live:?}");
        assert_eq!(live.joints[0].level, Level::Good);
    }

    #[test]
    fn a_status_that_is_not_renewed_is_stale() {
        let mut bench = ObservedBar::new(|_| {});
        bench.at([Some(1.0); 5], None);
        let old = Status { sampled: bench.now, ..Status::default() };
        let live = bench.observer.next(&old, bench.now.plus_ns(2 * NS_PER_S));
        assert!(live.joints.iter().all(|joint| joint.angle_deg.is_none() && joint.level == Level::Bad));
    }

    #[test]
    fn a_wound_cable_and_a_fast_joint_are_warned_of() {
        let mut bench = ObservedBar::new(|_| {});
        assert_eq!(subjects(&bench.turn(1, 365.0, 50.0)), [("joint_wound", 1)]);
        let mut bench = ObservedBar::new(|_| {});
        assert_eq!(subjects(&bench.turn(2, 200.0, 80.0)), [("joint_fast", 2)]);
    }

    #[test]
    fn a_counter_that_begins_anew_turns_no_joint() {
        let mut bench = ObservedBar::new(|_| {});
        bench.turn(1, 100.0, 50.0);
        bench.at([None; 5], None);
        bench.origin += 1;
        let live = bench.at([Some(1000.0); 5], None);
        assert_eq!(live.joints[0].angle_deg, Some(0.0));
        assert!(subjects(&live).is_empty() && live.joints[0].has_moved, "{live:?}");
        // A run begins with origin 0, although the counters have not restarted.
        bench.origin = 0;
        let live = bench.at([Some(1010.0); 5], Some("one"));
        assert!((live.joints[0].angle_deg.unwrap() - 10.0).abs() < 1e-3, "{live:?}");
    }

    #[test]
    fn a_new_session_of_the_bus_turns_no_joint() {
        let mut bench = ObservedBar::new(|_| {});
        bench.turn(1, 100.0, 50.0);
        // After the cycle thread has died, the next session begins with origin 0, too.
        bench.observer.next(&Status::default(), bench.now);
        let live = bench.at([Some(1000.0); 5], None);
        assert!(live.joints.iter().all(|joint| joint.angle_deg == Some(0.0)), "{live:?}");
        assert!(
            (live.joints[0].range_deg - 100.0).abs() < 1e-3 && live.joints[1].range_deg == 0.0,
            "{live:?}"
        );
    }

    #[test]
    fn a_run_without_distributed_clocks_has_the_grade_of_its_file() {
        let level = |distributed_clocks| {
            let mut bench =
                ObservedBar::new(|settings| settings.daemon.distributed_clocks = distributed_clocks);
            bench.at([Some(1.0); 5], Some("one")).verdict.unwrap().level
        };
        assert_eq!([true, false].map(level), [Level::Good, Level::Check]);
    }

    #[test]
    fn a_joint_that_stands_still_in_a_run_is_warned_of_and_counts_from_its_beginning() {
        let mut bench = ObservedBar::new(|_| {});
        bench.turn(1, 20.0, 20.0);
        let moving = |step: i32| [20.0, 0.2 * f64::from(step), 1.0, 1.0, 1.0].map(Some);
        let live = (0..160).map(|step| bench.at(moving(step), Some("one"))).last().unwrap();
        assert_eq!(subjects(&live), [1, 3, 4, 5].map(|joint| ("joint_still", joint)));
        assert_eq!(
            live.verdict.unwrap().to_string(),
            "CHECK: joint 1 turned by 0.0\u{b0}, joint 3 turned by 0.0\u{b0}, joint 4 turned by 0.0\u{b0}, joint 5 turned by \
             0.0\u{b0}; `identify` needs at least 3\u{b0} of each joint"
        );
    }

    #[test]
    fn a_singular_pose_is_warned_of_if_the_angles_are_known() {
        let mut bench = ObservedBar::new(|settings| settings.bar.encoders[1].mark_deg = Some(170.0));
        let encoders: Vec<_> = bench.observer.tracks.iter().map(|track| track.config.clone()).collect();
        bench.observer.homing = Some(HomingConfig::new(UtcNs(0), &encoders, &[START as u32; 5]));
        assert!(subjects(&bench.at([Some(0.0); 5], None)).is_empty());
        let live = bench.at([Some(0.0), Some(4.0), Some(0.0), Some(0.0), Some(0.0)], None);
        assert_eq!(subjects(&live), [("joint_singular", 2)]);
        assert!(live.joints.iter().all(|joint| joint.from_mark));
        assert!(live.warnings[0].text.contains("6.0 degrees"), "{:?}", live.warnings);
        // A second homing stores a mark that is 40 degrees away from the first mark.
        let further = START as u32 + (40.0 * COUNTS_PER_DEG) as u32;
        (bench.latch, bench.observer.homing) =
            (further, Some(HomingConfig::new(UtcNs(0), &encoders, &[further; 5])));
        let live = bench.at([Some(4.0); 5], None);
        assert!((live.joints[1].angle_deg.unwrap() + 36.0).abs() < 1e-3, "{:?}", live.joints[1]);
    }

    #[test]
    fn a_page_that_begins_gets_the_last_minute_and_no_more() {
        let (mut bench, mut minute) = (ObservedBar::new(|_| {}), Minute::default());
        for step in 0..700 {
            let angle_deg = (step != 650).then_some(f64::from(step) * 0.01);
            // An encoder is stale only after a second, so one missing sample makes no gap.
            minute.add(&bench.at([angle_deg; 5], None));
        }
        let last_ms = *minute.at_ms.back().unwrap();
        assert_eq!((minute.at_ms.len(), last_ms - minute.at_ms[0]), (601, MINUTE_MS));
        assert!(minute.angles_deg.len() == 5 && minute.angles_deg.iter().all(|angles| angles.len() == 601));
        assert_eq!((minute.angles_deg[4][0], minute.angles_deg[4][600]), (Some(0.99), Some(6.99)));
    }

    #[test]
    fn coverage_grows_with_the_directions_of_the_rod_and_begins_with_the_run() {
        let mut bench = ObservedBar::new(|_| {});
        let live = bench.turn(1, 95.0, 50.0);
        assert_eq!(
            (live.coverage.visited, live.coverage.newest_s),
            (10, None),
            "without a run nothing grows"
        );
        let live = bench.at([Some(0.0); 5], Some("one"));
        assert_eq!(live.coverage.newest_s, Some(0.0));
        assert_eq!((live.coverage.visited, live.coverage.here), (1, Some((18, 18))));
        let live =
            (0..30).map(|step| bench.at([3.0 * f64::from(step), 0.0, 0.0, 0.0, 0.0].map(Some), Some("one")));
        let live = live.last().unwrap();
        assert_eq!(live.coverage.visited, 9);
        let set: u32 =
            live.coverage.cells.chars().map(|digit| digit.to_digit(16).unwrap().count_ones()).sum();
        assert_eq!((live.coverage.cells.len(), set), (CELLS * CELLS / 4, 9));
        // Counters that restart begin a new map. The number of earlier cells is kept.
        assert_eq!(live.restarted, None);
        bench.origin += 1;
        let live = bench.at([Some(0.0); 5], Some("one"));
        assert_eq!(live.coverage.visited, 1);
        let restarted = live.restarted.unwrap();
        assert_eq!((restarted.cells_before, restarted.at_ms), (9, live.at_ms));
        assert!((restarted.run_s.unwrap() - live.run_s.unwrap()).abs() < 1e-9, "{restarted:?}");
        assert_eq!(subjects(&live), [("angles_restarted", 0)]);
        assert!(live.warnings[0].text.contains("since 0:03"), "{:?}", live.warnings);
        // The next run is not affected.
        let live = bench.at([Some(0.0); 5], Some("two"));
        assert_eq!((live.restarted, subjects(&live).len()), (None, 0));
    }
}
