//! The recordings of a directory. This module lists them with duration, grade and provenance, finds names for new
//! recordings, and reads the angles of one recording for a plot. Everything is read from the files and nothing is cached.
//! API, page and commands use it.

use std::io::{self, BufReader};
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shared::encoder::{EncoderScale, Unwrapper};
use shared::recording::schema::{CycleRecord, EncoderInfo, EncoderSample, Provenance};
use shared::recording::{
    ACTIVE_ENDING, Disk, FINISHED_ENDING, OpenFile, Outline, ReadError, RunMark, RunOverview, is_absent,
    is_in_use, run_name,
};
use shared::time::UtcNs;

use super::verdict::Verdict;
use super::{note, unless_absent};
use crate::control::status::next_command;

/// Highest number that is appended to a base name.
const NUMBERS_MAX: u32 = 10_000;
/// Length limits of robot and bar in an automatic name. Letters of some scripts need up to four bytes each, and the name
/// with date and number must be a valid name of a run.
const PART_CHARS_MAX: usize = 30;
const PART_BYTES_MAX: usize = 48;

/// One recording of the list.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunLine {
    /// Name of the recording.
    pub name: String,
    /// Path of the file.
    pub file: PathBuf,
    /// Beginning of the run \[ns since 1970\]; absent if the file does not contain it. JavaScript numbers cannot represent
    /// it exactly; use `started_ms` there.
    pub started: Option<UtcNs>,
    /// Beginning of the run \[ms since 1970\]; absent if the file does not contain it.
    #[serde(default)]
    pub started_ms: Option<i64>,
    /// Duration \[s\].
    pub length_s: f64,
    /// Number of bus cycles in the file.
    pub cycles: u64,
    /// Number of these cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Number of cycles that were lost between bus and file, or by damage of the file.
    pub cycles_lost: u64,
    /// Grade of the recording; absent until the recording is finished.
    pub verdict: Option<Verdict>,
    /// Why the run ended; if the recording has no grade, the reason for that.
    pub cause: String,
    /// The recording was interrupted, and its file was recovered later.
    pub recovered: bool,
    /// Length of the file \[bytes\].
    pub bytes: u64,
    /// Name of the person who recorded.
    pub operator: String,
    /// Name or serial number of the robot.
    pub robot: String,
    /// Name or serial number of the bar.
    pub bar: String,
    /// Payload of the robot in addition to the bar.
    pub payload: String,
    /// Free text, recorded or added later.
    pub note: String,
    /// Whether it is simulated, or a replay.
    #[serde(flatten)]
    pub provenance: Provenance,
    /// The first markers of the run. One of them is the reason why the run began despite a problem, if it did.
    #[serde(default)]
    pub marks: Vec<RunMark>,
    /// The command that calibrates a robot from this recording and the robot's log; absent without valid cycles.
    #[serde(default)]
    pub next: Option<String>,
}

/// Lists the recordings of these directories: unfinished ones first, then the others, the latest first. Recordings without a
/// start time come last. Several directories are searched, because a run may have continued in the spare directory.
pub fn list(disk: &dyn Disk, directories: &[PathBuf]) -> io::Result<Vec<RunLine>> {
    let files = files(disk, directories)?.into_iter();
    let mut lines: Vec<_> = files.filter_map(|file| line(disk, file)).collect();
    let is_finished = |line: &RunLine| stem(&line.file, ACTIVE_ENDING).is_none();
    lines.sort_by(|a, b| {
        let order = is_finished(a).cmp(&is_finished(b)).then_with(|| b.started.cmp(&a.started));
        order.then_with(|| a.name.cmp(&b.name))
    });
    Ok(lines)
}

/// Returns `base`, or `base-2`, `base-3` and so on if a recording in these directories has that name already.
pub(in crate::control) fn free_name(disk: &dyn Disk, directories: &[PathBuf], base: &str) -> String {
    let numbered = (2..NUMBERS_MAX).map(|number| format!("{base}-{number}"));
    let mut names = std::iter::once(base.to_owned()).chain(numbered);
    names.find(|name| !is_taken(disk, directories, name)).unwrap_or_else(|| base.to_owned())
}

/// Default name of a run, such as `2026-11-26_irb-2400_short_01`: date, robot, bar and the first free number.
pub(in crate::control) fn automatic_name(
    disk: &dyn Disk,
    directories: &[PathBuf],
    robot: &str,
    bar: &str,
) -> String {
    let date = chrono::Local::now().format("%Y-%m-%d").to_string();
    let parts = [robot, bar].map(|text| {
        let plain = text.to_lowercase().replace(['.', '+', '_'], " ");
        let fits = |(at, c): &(usize, char)| at + c.len_utf8() <= PART_BYTES_MAX;
        let part = plain.char_indices().take(PART_CHARS_MAX).take_while(fits);
        run_name(&part.map(|(_, c)| c).collect::<String>())
    });
    let base = std::iter::once(date).chain(parts.into_iter().flatten()).collect::<Vec<_>>().join("_");
    let mut names = (1..NUMBERS_MAX).map(|number| format!("{base}_{number:02}"));
    names.find(|name| !is_taken(disk, directories, name)).unwrap_or(base)
}

/// Whether a recording in one of these directories has this name. If the disk returns an error, the name counts as free.
/// Creating the file of the run then fails if the file exists.
pub(in crate::control) fn is_taken(disk: &dyn Disk, directories: &[PathBuf], name: &str) -> bool {
    let exists = |file: PathBuf| disk.has(&file).unwrap_or(false);
    let files = [FINISHED_ENDING, ACTIVE_ENDING].map(|ending| format!("{name}.{ending}"));
    directories.iter().any(|directory| files.iter().any(|file| exists(directory.join(file))))
}

/// Finds the finished recording of this name. The name is only compared with existing names and never becomes part of a path,
/// so it cannot point outside the directories.
pub fn find(disk: &dyn Disk, directories: &[PathBuf], name: &str) -> io::Result<Option<PathBuf>> {
    let has_name = |file: &PathBuf| stem(file, FINISHED_ENDING).is_some_and(|stem| stem == name);
    Ok(files(disk, directories)?.into_iter().find(has_name))
}

/// Files in these directories. A directory that does not exist counts as empty, because it is created when a run needs it.
/// A path that is a file instead of a directory counts as empty, too. The status reports this problem, and recordings in
/// the other directory stay accessible. The spare directory may be equal to the other one, so a repeated directory is skipped.
pub(super) fn files(disk: &dyn Disk, directories: &[PathBuf]) -> io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for (index, directory) in directories.iter().enumerate() {
        if !directories[..index].contains(directory) {
            files.extend(unless_absent(disk.list(directory))?);
        }
    }
    Ok(files)
}

/// Files of unfinished runs that no running process writes.
pub fn left_behind(disk: &dyn Disk, directories: &[PathBuf]) -> io::Result<Vec<PathBuf>> {
    let mut files = files(disk, directories)?;
    files.retain(|path| stem(path, ACTIVE_ENDING).is_some());
    // A file that cannot be checked counts as left behind. A file that has been finished since the
    // listing does not exist any more.
    files.retain(|path| match is_in_use(disk, path) {
        Ok(is_in_use) => !is_in_use,
        Err(error) => !is_absent(&error),
    });
    Ok(files)
}

/// Name of a recording: the file name without `ending`. `None` if the file has another ending.
pub(in crate::control) fn stem(path: &Path, ending: &str) -> Option<String> {
    let name = path.file_name()?.to_str()?;
    Some(name.strip_suffix(ending)?.strip_suffix('.')?.to_owned()).filter(|stem| !stem.is_empty())
}

/// Entry of a recording in the list, finished or not. `None` if the file is not a recording.
fn line(disk: &dyn Disk, file: PathBuf) -> Option<RunLine> {
    if let Some(name) = stem(&file, ACTIVE_ENDING) {
        let cause = match is_in_use(disk, &file) {
            Ok(true) => "is being recorded".into(),
            Ok(false) => {
                "left behind by a crash; it is recovered when the next run or the service starts".into()
            }
            Err(error) => format!("cannot be read: {error}"),
        };
        return Some(RunLine { name, file, cause, ..RunLine::default() });
    }
    let name = stem(&file, FINISHED_ENDING)?;
    Some(finished(disk, name, file))
}

/// Entry of a finished recording in the list.
pub fn finished(disk: &dyn Disk, name: String, file: PathBuf) -> RunLine {
    let bytes = disk.open(&file).and_then(|opened| disk.length(&opened)).unwrap_or(0);
    match RunOverview::open_on(disk, &file) {
        Ok(overview) => {
            let verdict = Some(Verdict::of_file(&overview));
            let RunOverview { mut run, end } = overview;
            note::apply(disk, &file, &mut run);
            let next = (end.cycles_valid > 0).then(|| next_command(&name, &file.display().to_string()));
            RunLine {
                provenance: run.provenance(),
                name,
                file,
                started: Some(run.started),
                started_ms: Some(run.started.0 / 1_000_000),
                length_s: end.cycles as f64 * run.cycle_period_ns as f64 * 1e-9,
                cycles: end.cycles,
                cycles_valid: end.cycles_valid,
                cycles_lost: end.cycles_lost,
                verdict,
                cause: end.cause,
                recovered: end.recovered,
                bytes,
                operator: run.operator,
                robot: run.robot,
                bar: run.bar,
                payload: run.payload,
                note: run.note,
                marks: end.marks,
                next,
            }
        }
        Err(error) => {
            let verdict = Some(Verdict::bad(error.kind.to_string()));
            RunLine { name, file, verdict, bytes, ..RunLine::default() }
        }
    }
}

/// Largest number of points of a plot.
const CURVE_POINTS: u64 = 1500;

/// Angles of a whole run for a plot, at reduced resolution.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Curves {
    /// Time since the first cycle \[s\].
    pub t_s: Vec<f64>,
    /// One curve for each encoder, in bus order.
    pub joints: Vec<Curve>,
}

/// Angle of one joint.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Curve {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Angle at each time in `t_s`, relative to the first sample after the counter last restarted; absent
    /// without a valid sample \[deg\].
    pub angle_deg: Vec<Option<f64>>,
}

/// Reads the file once. The cycles are divided into intervals of equal length, so that each joint has at most `CURVE_POINTS`
/// points. The point of an interval is its first cycle. If any cycle of an interval is invalid, the curve has a gap there.
pub fn curves(disk: &dyn Disk, path: &Path) -> Result<Curves, ReadError> {
    let RunOverview { run, end } = RunOverview::open_on(disk, path)?;
    let interval_cycles = end.cycles.div_ceil(CURVE_POINTS).max(1);
    let mut curves = Curves::default();
    let mut joints: Vec<_> = run.encoders.iter().map(JointCurve::new).collect();
    let mut first_sample = None;
    let mut add_cycle = |cycle: CycleRecord| {
        let begins_interval = cycle.cycle.is_multiple_of(interval_cycles);
        if begins_interval {
            let first = *first_sample.get_or_insert(cycle.sample_time);
            curves.t_s.push(cycle.sample_time.seconds_since(first));
        }
        for (index, joint) in joints.iter_mut().enumerate() {
            joint.add(
                cycle.encoders().get(index).copied().unwrap_or_default(),
                cycle.origin,
                begins_interval,
            );
        }
        Ok(())
    };
    let error = |kind| ReadError { path: path.to_owned(), kind };
    let file = disk.open(path).map_err(|source| error(source.into()))?;
    Outline::read(BufReader::new(OpenFile::new(disk, &file)), &mut add_cycle).map_err(error)?;
    curves.joints = joints.into_iter().map(|joint| joint.curve).collect();
    Ok(curves)
}

/// A curve that grows with each cycle.
struct JointCurve {
    curve: Curve,
    scale: EncoderScale,
    unwrapper: Unwrapper,
    /// Unwrapped count of the first valid sample.
    first: Option<i64>,
    /// Origin number of the counters in the previous cycle.
    origin: u32,
}

impl JointCurve {
    fn new(encoder: &EncoderInfo) -> Self {
        let EncoderInfo { joint, scale } = *encoder;
        let curve = Curve { joint, angle_deg: Vec::new() };
        Self { curve, scale, unwrapper: scale.unwrapper(), first: None, origin: 0 }
    }

    /// Adds a point at the beginning of an interval, and removes it if a later sample of the interval is
    /// invalid. If the origin of the counter has changed, the angle begins at zero again, because the
    /// motion between the two origins is unknown.
    fn add(&mut self, sample: EncoderSample, origin: u32, begins_interval: bool) {
        if std::mem::replace(&mut self.origin, origin) != origin {
            (self.unwrapper, self.first) = (self.scale.unwrapper(), None);
        }
        let angle_deg = sample.valid.then(|| {
            let counts = self.unwrapper.next(sample.count);
            let counts = counts - *self.first.get_or_insert(counts);
            (self.scale.direction.sign() * counts) as f64 * self.scale.rad_per_count().to_degrees()
        });
        match self.curve.angle_deg.last_mut() {
            Some(point_deg) if !begins_interval => *point_deg = point_deg.filter(|_| angle_deg.is_some()),
            _ => self.curve.angle_deg.push(angle_deg),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use shared::recording::SystemDisk;

    use super::*;

    #[test]
    fn a_curve_begins_at_zero_again_with_another_origin() {
        const QUARTER_TURN: u32 = 3600 * 4096 / 4;
        let mut curve = JointCurve::new(&EncoderInfo { joint: 1, scale: EncoderScale::default() });
        let again = 3_000_000_000;
        for (count, origin) in [(7, 0), (7 + QUARTER_TURN, 0), (again, 1), (again + QUARTER_TURN, 1)] {
            curve.add(EncoderSample { count, valid: true, ..EncoderSample::default() }, origin, true);
        }
        assert_eq!(curve.curve.angle_deg, [0.0, 90.0, 0.0, 90.0].map(Some));
    }

    #[test]
    fn an_automatic_name_of_any_script_can_be_the_name_of_a_run() {
        let home = tempfile::tempdir().unwrap();
        let directories = [home.path().to_owned()];
        for (robot, bar) in [("ж", "я"), ("機", "棒"), ("\u{20000}", "\u{20000}"), ("x", "y")] {
            let name = automatic_name(&SystemDisk, &directories, &robot.repeat(200), &bar.repeat(200));
            assert_eq!(run_name(&name).as_deref(), Some(name.as_str()));
        }
    }

    #[test]
    fn a_name_in_the_spare_directory_is_not_given_again() {
        let home = tempfile::tempdir().unwrap();
        let directories = ["runs", "spare"].map(|name| home.path().join(name));
        fs::create_dir(&directories[1]).unwrap();
        let named = || automatic_name(&SystemDisk, &directories, "IRB 2400", "short");
        let first = named();
        fs::write(directories[1].join(format!("{first}.mcap")), "").unwrap();
        let second = named();
        assert!(first.ends_with("_irb-2400_short_01") && second.ends_with("_02"), "{first}, {second}");
        assert_eq!(free_name(&SystemDisk, &directories, &first), format!("{first}-2"));
    }

    #[test]
    fn recordings_in_the_spare_directory_are_listed_while_the_other_is_missing_or_a_file() {
        let home = tempfile::tempdir().unwrap();
        let directories = ["runs", "spare"].map(|name| home.path().join(name));
        let [runs, spare] = &directories;
        fs::create_dir(spare).unwrap();
        fs::write(spare.join("moved.mcap"), "").unwrap();
        let check = || {
            let lines = list(&SystemDisk, &directories).unwrap();
            assert_eq!(lines.iter().map(|line| line.name.as_str()).collect::<Vec<_>>(), ["moved"]);
            assert!(find(&SystemDisk, &directories, "moved").unwrap().is_some());
        };
        check();
        fs::write(runs, "a file").unwrap();
        check();
    }

    #[test]
    fn recordings_are_listed_once_if_the_spare_directory_is_the_other_directory() {
        let home = tempfile::tempdir().unwrap();
        fs::write(home.path().join("one.mcap"), "").unwrap();
        let directories = [home.path().to_owned(), home.path().to_owned()];
        assert_eq!(list(&SystemDisk, &directories).unwrap().len(), 1);
    }
}
