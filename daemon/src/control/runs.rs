//! The recordings of a directory: how long, what they are worth, and which of them were recovered.

use std::io;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shared::recording::schema::{EncoderSample, Provenance};
use shared::recording::{
    ACTIVE_ENDING, Disk, FINISHED_ENDING, ReadError, Recording, RunOverview, is_absent, is_in_use,
};
use shared::time::UtcNs;

use super::note;
use super::verdict::Verdict;

/// One recording of the list.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunLine {
    /// Its name.
    pub name: String,
    /// Its file.
    pub file: PathBuf,
    /// When it began; none where the file does not tell.
    pub started: Option<UtcNs>,
    /// Length \[s\].
    pub length_s: f64,
    /// Bus cycles in it.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that were lost between bus and file.
    pub cycles_lost: u64,
    /// What it is worth; none before it is finished.
    pub verdict: Option<Verdict>,
    /// Why it has no verdict, or why it ended.
    pub cause: String,
    /// It was cut short and recovered.
    pub recovered: bool,
    /// Length of the file \[bytes\].
    pub bytes: u64,
    /// Who recorded it.
    pub operator: String,
    /// Which robot.
    pub robot: String,
    /// Which bar.
    pub bar: String,
    /// What the robot carried.
    pub payload: String,
    /// Free text that was given with it, or since.
    pub note: String,
    /// Whether it is simulated, or a replay.
    #[serde(flatten)]
    pub provenance: Provenance,
}

/// Recordings of a directory, the latest first; those that do not tell when they began come last. With those of runs
/// that had to go on in `spare`.
pub fn list(disk: &dyn Disk, directory: &Path, spare: Option<&Path>) -> io::Result<Vec<RunLine>> {
    let files = files(disk, directory, spare)?;
    let mut lines: Vec<_> = files.into_iter().filter_map(|file| line(disk, file)).collect();
    lines.sort_by(|one, other| other.started.cmp(&one.started).then_with(|| one.name.cmp(&other.name)));
    Ok(lines)
}

/// The finished recording of this name. The name is compared with those that are there and never made a path of.
pub fn find(
    disk: &dyn Disk,
    directory: &Path,
    spare: Option<&Path>,
    name: &str,
) -> io::Result<Option<PathBuf>> {
    let is_it = |file: &PathBuf| stem(file, FINISHED_ENDING).is_some_and(|stem| stem == name);
    Ok(files(disk, directory, spare)?.into_iter().find(is_it))
}

fn files(disk: &dyn Disk, directory: &Path, spare: Option<&Path>) -> io::Result<Vec<PathBuf>> {
    let mut files = disk.list(directory)?;
    files.extend(spare.map_or(Ok(Vec::new()), |spare| list_if_there(disk, spare))?);
    Ok(files)
}

/// Files of runs that no living process writes.
pub fn left_behind(disk: &dyn Disk, directory: &Path) -> io::Result<Vec<PathBuf>> {
    let mut files = list_if_there(disk, directory)?;
    files.retain(|path| stem(path, ACTIVE_ENDING).is_some());
    // One that cannot be asked is not in use, and one that has just been finished is not there any more.
    files.retain(|path| match is_in_use(disk, path) {
        Ok(is_in_use) => !is_in_use,
        Err(error) => !is_absent(&error),
    });
    Ok(files)
}

/// A directory is made when a run needs it.
fn list_if_there(disk: &dyn Disk, directory: &Path) -> io::Result<Vec<PathBuf>> {
    match disk.list(directory) {
        Err(error) if is_absent(&error) => Ok(Vec::new()),
        listed => listed,
    }
}

fn stem(path: &Path, ending: &str) -> Option<String> {
    let name = path.file_name()?.to_str()?;
    Some(name.strip_suffix(ending)?.strip_suffix('.')?.to_owned()).filter(|stem| !stem.is_empty())
}

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

/// The line of a finished recording.
pub fn finished(disk: &dyn Disk, name: String, file: PathBuf) -> RunLine {
    let bytes = disk.open(&file).and_then(|opened| disk.length(&opened)).unwrap_or(0);
    match RunOverview::open_on(disk, &file) {
        Ok(overview) => {
            let verdict = Some(Verdict::of_file(&overview));
            let RunOverview { mut run, end } = overview;
            note::apply(disk, &file, &mut run);
            RunLine {
                provenance: run.provenance(),
                name,
                file,
                started: Some(run.started),
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
            }
        }
        Err(error) => {
            let verdict = Some(Verdict::bad(error.kind.to_string()));
            RunLine { name, file, verdict, bytes, ..RunLine::default() }
        }
    }
}

/// Moments of a run that are drawn.
const CURVE_POINTS: usize = 1500;

/// A run as a whole, for people to look at.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Curves {
    /// Since its first cycle \[s\].
    pub t_s: Vec<f64>,
    /// The encoders, in bus order.
    pub joints: Vec<Curve>,
}

/// One encoder.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Curve {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Its angle since its first sample; none where it gave none \[deg\].
    pub angle_deg: Vec<Option<f64>>,
}

/// Reads the whole file. Of each part of it the worst cycle is shown: a gap stays one, however short.
pub fn curves(disk: &dyn Disk, file: &Path) -> Result<Curves, ReadError> {
    let Recording { run, cycles, .. } = Recording::open_on(disk, file)?;
    let each = cycles.len().div_ceil(CURVE_POINTS).max(1);
    let Some(first) = cycles.first() else { return Ok(Curves::default()) };
    let t_s = cycles.iter().step_by(each).map(|cycle| cycle.sample_time.seconds_since(first.sample_time));
    let joints = run.encoders.iter().enumerate().map(|(place, encoder)| {
        let mut unwrapper = encoder.scale.unwrapper();
        let mut begin = None;
        let mut angle = |sample: EncoderSample| {
            let counts = unwrapper.next(sample.count);
            let from = *begin.get_or_insert(counts);
            (encoder.scale.direction.sign() * (counts - from)) as f64
                * encoder.scale.rad_per_count().to_degrees()
        };
        let angles = cycles.iter().map(|cycle| {
            let sample = cycle.encoders().get(place).copied().unwrap_or_default();
            sample.valid.then(|| angle(sample))
        });
        let angles: Vec<_> = angles.collect();
        let of_part =
            |part: &[Option<f64>]| if part.contains(&None) { None } else { part.first().copied().flatten() };
        Curve { joint: encoder.joint, angle_deg: angles.chunks(each).map(of_part).collect() }
    });
    Ok(Curves { t_s: t_s.collect(), joints: joints.collect() })
}
