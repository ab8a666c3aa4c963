//! A mapping for a table that none was written for: what its columns are by name, unit and range, tried on the robot.
//!
//! None of it is certain, so the mapping lists the reason of each choice for the user to check.

use std::collections::BTreeMap;
use std::path::Path;

use shared::config::{AngleUnit, RobotConfig};

use crate::calibrate::rows::{likely, misfit, some_of};
use crate::instrument::{Instrument, Mistake, PoseRow, Tracker};
use crate::kinematics::flange_chain;
use crate::logs::{
    ContactMapping, CsvLayout, EulerFrame, JointColumn, JointMistake, JointUnit, LengthColumn, LengthUnit,
    LogError, MeasuredLengthMapping, MeasuredPoseMapping, MeasuredPoses, PositionColumns, RobotLogMapping,
    RotationColumns, RotationForm, RowsAsText, TimeColumn, TimeUnit, own_columns,
};
use crate::statistics::median;

/// What a table holds, with the mapping that reads it.
#[derive(Debug, Clone, PartialEq)]
pub enum Mapping {
    /// Robot log: joints over time.
    RobotLog(Box<RobotLogMapping>),
    /// Joints and where a tracker saw the flange.
    MeasuredPoses(MeasuredPoseMapping),
    /// Joints and a length.
    MeasuredLengths(MeasuredLengthMapping),
    /// Joints and the socket of a ball.
    Contacts(ContactMapping),
}

/// A mapping and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// Mapping for the table.
    pub mapping: Mapping,
    /// Why it is so.
    pub notes: Notes,
}

/// Why a mapping is as it is.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Notes {
    /// What each choice rests on.
    pub reasons: Vec<String>,
    /// What looks wrong, and what to try.
    pub doubts: Vec<String>,
}

impl Proposal {
    /// The mapping as the text of a file, with reasons and open questions as its comments.
    ///
    /// # Errors
    /// Where a value cannot be written as TOML.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        let body = match &self.mapping {
            Mapping::RobotLog(mapping) => toml::to_string(mapping),
            Mapping::MeasuredPoses(mapping) => toml::to_string(mapping),
            Mapping::MeasuredLengths(mapping) => toml::to_string(mapping),
            Mapping::Contacts(mapping) => toml::to_string(mapping),
        }?;
        let what = match self.mapping {
            Mapping::RobotLog(_) => "a robot's log, for --log-mapping",
            Mapping::MeasuredPoses(_) => "measured poses, for `identify calibrate tracker --mapping`",
            Mapping::MeasuredLengths(_) => "measured lengths, for `identify calibrate wire --mapping`",
            Mapping::Contacts(_) => "a ball in sockets, for `identify calibrate contact --mapping`",
        };
        let mut text = format!("# Proposed by `identify inspect`: {what}. Read it before you use it.\n");
        text.extend(self.notes.reasons.iter().map(|reason| format!("# - {reason}\n")));
        text.extend(self.notes.doubts.iter().map(|doubt| format!("# ! {doubt}\n")));
        Ok(text + "\n" + &body)
    }
}

/// Why no mapping can be proposed.
#[derive(Debug, thiserror::Error)]
pub enum ProposeError {
    /// The file cannot be read as a table.
    #[error(transparent)]
    Log(#[from] LogError),
    /// No rows of numbers.
    #[error(
        "{path}: no rows of numbers with a column for each of {joints} joints; give the file of the robot that was logged, or another table"
    )]
    NoTable {
        /// Path of the file.
        path: String,
        /// Joints of the robot.
        joints: usize,
    },
    /// No columns look like joints.
    #[error(
        "{path}: no {joints} columns look like the robot's joints; found {found}. Write a mapping as config/robot_log.toml explains"
    )]
    NoJoints {
        /// Path of the file.
        path: String,
        /// Joints of the robot.
        joints: usize,
        /// Columns that are there.
        found: String,
    },
    /// Joints, but neither times nor anything measured.
    #[error(
        "{path}: joints, but neither time stamps nor a measured position, a length or a socket; found {found}"
    )]
    NothingMeasured {
        /// Path of the file.
        path: String,
        /// Columns that are there.
        found: String,
    },
}

/// Proposes a mapping for a table of `robot`; `path` is only named.
///
/// # Errors
/// [`ProposeError`].
pub fn propose(bytes: &[u8], path: &Path, robot: &RobotConfig) -> Result<Proposal, ProposeError> {
    let sheets = RowsAsText::sheets(bytes);
    let tried = sheets.iter().map(|sheet| (sheet.as_str(), of_sheet(bytes, path, robot, Some(sheet))));
    let (usable, others): (Vec<_>, Vec<_>) = tried.partition(|(_, tried)| tried.is_ok());
    let names: Vec<&str> = usable.iter().map(|(sheet, _)| *sheet).collect();
    let Some((_, first)) = usable.into_iter().chain(others).next() else {
        return of_sheet(bytes, path, robot, None);
    };
    let mut first = first?;
    if names.len() > 1 {
        let names = names.join(", ");
        first.notes.doubts.push(format!("sheets {names} all have such a table; the first is taken"));
    }
    Ok(first)
}

/// The same of one sheet of a workbook, or of a file without any.
fn of_sheet(
    bytes: &[u8],
    path: &Path,
    robot: &RobotConfig,
    sheet: Option<&str>,
) -> Result<Proposal, ProposeError> {
    let text = RowsAsText::new(bytes, path, sheet)?;
    let shown = path.display().to_string();
    let no_table = || ProposeError::NoTable { path: shown.clone(), joints: robot.axes() };
    let csv =
        CsvLayout { sheet: sheet.map(str::to_owned), ..layout(&text, robot.axes()).ok_or_else(no_table)? };
    let columns = columns(&text, &csv)?;
    let found = || columns.iter().map(|column| column.name.as_str()).collect::<Vec<_>>().join(", ");
    let mut notes = Notes::default();
    let own = own_columns(robot);
    let has_own = own.iter().all(|name| columns.iter().any(|column| column.name == *name));
    let mut of_joints = Notes::default();
    let joints = joints(&columns, robot, csv.header, &mut of_joints);
    if joints.is_none() && !has_own {
        return Err(ProposeError::NoJoints { path: shown, joints: robot.axes(), found: found() });
    }
    let joints = joints.unwrap_or_default();
    let is_joint = |column: &Column| joints.iter().any(|joint| joint.column == column.name);
    let taken = |column: &Column| is_joint(column) || (has_own && own.contains(&column.name));
    let others: Vec<&Column> = columns.iter().filter(|column| !taken(column)).collect();
    let time = time(&others, &mut notes);
    let length = others.iter().find(|column| column.has_word(LENGTHS)).copied();
    let position = triple(&others, &["x", "y", "z"]);
    let of_tracker = position.is_some_and(|xyz| xyz[0].has_word(TRACKERS));
    let socket = others.iter().find(|column| column.has_word(SOCKETS));
    let mapping = match (time, length, position, socket) {
        (_, _, _, Some(socket)) => {
            notes.reasons.push(format!(
                "column `{}` contains the socket in which the ball is seated: inferred from its name",
                socket.name
            ));
            Mapping::Contacts(ContactMapping { csv, socket: socket.name.clone(), joints })
        }
        (_, Some(length), _, _) => {
            let unit = length.length_unit();
            notes.reasons.push(format!(
                "`{}` is the measured length: inferred from the column's name; {}",
                length.name, unit.1
            ));
            let length = LengthColumn { column: length.name.clone(), unit: unit.0, offset_mm: 0.0 };
            let anchor = named(&others, "wire's anchor", &["anchor", "station"], &mut notes);
            let attachment = named(&others, "place on the flange", &["attachment", "target"], &mut notes);
            Mapping::MeasuredLengths(MeasuredLengthMapping {
                csv,
                length,
                joints,
                flange: None,
                uncertainty: None,
                anchor,
                attachment,
            })
        }
        (Some(time), _, _, _) if !of_tracker => {
            let joints = if has_own {
                let reason = format!("{} are the columns of the robot's own log", listed(&own));
                of_joints = Notes { reasons: vec![reason], ..Notes::default() };
                Vec::new()
            } else {
                joints
            };
            Mapping::RobotLog(Box::new(RobotLogMapping {
                csv,
                time: Some(time),
                joints,
                ..RobotLogMapping::default()
            }))
        }
        (_, _, Some(xyz), _) => {
            let names = xyz.map(|column| column.name.clone());
            let (unit, why) = xyz[0].length_unit();
            notes.reasons.push(format!(
                "{} are positions that the tracker measured: inferred from the columns' names; {why}",
                listed(&names)
            ));
            let position = PositionColumns { columns: names, unit };
            let station = named(&others, "tracker's station", &["station", "setup"], &mut notes);
            let targets = ["target", "reflector", "smr"];
            let target = named(&others, "target that was seen", &targets, &mut notes);
            let mapping = MeasuredPoseMapping {
                csv,
                position,
                rotation: None,
                uncertainty: None,
                station,
                target,
                time: None,
                joints,
            };
            let mapping = Trial { bytes, path, robot }.settled(mapping, &others, &mut notes);
            Mapping::MeasuredPoses(mapping)
        }
        _ => return Err(ProposeError::NothingMeasured { path: shown, found: found() }),
    };
    notes.reasons.splice(0..0, of_joints.reasons);
    notes.doubts.splice(0..0, of_joints.doubts);
    Ok(Proposal { mapping, notes })
}

fn listed<S: AsRef<str>>(names: &[S]) -> String {
    names.iter().map(|name| format!("`{}`", name.as_ref())).collect::<Vec<_>>().join(", ")
}

/// Words by which a length is recognised.
const LENGTHS: &str = "length cable wire rope distance laenge länge seil draw";
/// Words by which the socket of a ball is recognised.
const SOCKETS: &str = "socket nest seat cone";
/// Words by which positions are a tracker's and not the controller's own.
const TRACKERS: &str = "tracker meas measured measurement laser probe smr leica api faro";
/// Words of columns beside joints that are not joint angles.
const NOT_ANGLES: &str = "vel velocity speed qd dq qdd acc tau torque moment effort current strom amp temp temperature force \
                          error dev";
/// Words of commanded angles.
const COMMANDED: &str = "cmd command commanded target soll desired ref reference planned set";
/// Words of time stamps.
const TIMES: &str = "t time timestamp stamp zeit clock ipoc utc date datetime tick ticks";

/// One column of a table, with its numbers where they are some.
struct Column {
    name: String,
    /// The name in lower case, without unit.
    plain: String,
    unit: Option<String>,
    numbers: Vec<f64>,
    is_date: bool,
}

impl Column {
    fn words(&self) -> impl Iterator<Item = &str> {
        self.plain.split(|character: char| !character.is_alphanumeric()).filter(|word| !word.is_empty())
    }

    /// Has one of these words, which are between spaces, also with digits behind it.
    fn has_word(&self, words: &str) -> bool {
        self.words().any(|word| {
            let bare = word.trim_end_matches(|character: char| character.is_ascii_digit());
            words.split(' ').any(|one| one == word || one == bare)
        })
    }

    fn largest(&self) -> f64 {
        self.numbers.iter().fold(0.0, |most, number| most.max(number.abs()))
    }

    fn is_number(&self) -> bool {
        !self.numbers.is_empty() && !self.is_date
    }

    fn length_unit(&self) -> (LengthUnit, String) {
        /// No arm reaches so far in metres, and none measures so little in millimetres.
        const M_MAX: f64 = 20.0;
        match self.unit.as_deref() {
            Some("mm") => (LengthUnit::Mm, "from the header".into()),
            Some("m") => (LengthUnit::M, "from the header".into()),
            _ if self.largest() > M_MAX => (LengthUnit::Mm, format!("up to {:.0}, so mm", self.largest())),
            _ => (LengthUnit::M, format!("up to {:.2}, so m", self.largest())),
        }
    }
}

/// A cell as a number; dates are some too.
fn number(cell: &str, decimal_comma: bool) -> Option<f64> {
    let cell = if decimal_comma { cell.replace(',', ".") } else { cell.to_owned() };
    cell.parse::<f64>().ok().filter(|number| number.is_finite())
}

fn is_date(cell: &str) -> bool {
    let digits = cell.bytes().filter(u8::is_ascii_digit).count();
    digits >= 12 && cell.contains(':') && cell.contains('-')
}

fn cells(line: &str, delimiter: char) -> Vec<&str> {
    line.split(delimiter).map(|cell| cell.trim().trim_matches('"')).collect()
}

/// How the rows of numbers are written: the delimiter and decimal sign that give most numbers in rows of equal length.
fn layout(text: &RowsAsText<'_>, axes: usize) -> Option<CsvLayout> {
    let lines: Vec<&str> = text.lines().collect();
    let choices =
        [(';', false), (';', true), ('\t', false), ('\t', true), (',', false), ('|', false), (' ', false)];
    // Of equals the first: what reads as numbers both ways has no decimal comma.
    let best = choices.into_iter().rev().filter_map(|(delimiter, decimal_comma)| {
        let numbers = |line: &str| {
            let cells = cells(line, delimiter);
            let numbers =
                cells.iter().filter(|cell| number(cell, decimal_comma).is_some() || is_date(cell)).count();
            (numbers >= axes && 10 * numbers >= 7 * cells.len()).then_some((cells.len(), numbers))
        };
        let first = lines.iter().position(|line| numbers(line).is_some())?;
        let (width, _) = numbers(lines.get(first)?)?;
        let rows = lines.iter().filter_map(|line| numbers(line)).filter(|(cells, _)| *cells == width);
        let total: usize = rows.map(|(_, numbers)| numbers).sum();
        Some((total, delimiter, decimal_comma, first, width))
    });
    let (_, delimiter, decimal_comma, first, width) = best.max_by_key(|(total, ..)| *total)?;
    // Above the numbers: a header, then lines of units.
    let above: Vec<usize> = (0..first)
        .rev()
        .filter(|&line| !lines[line].trim().is_empty() && !lines[line].starts_with('#'))
        .take_while(|&line| cells(lines[line], delimiter).len() == width)
        .collect();
    let is_title = |line: &&usize| {
        cells(lines[**line], delimiter).iter().filter(|cell| cell.is_empty()).count() * 2 > width
    };
    let above: Vec<usize> = above.iter().take_while(|line| !is_title(line)).copied().collect();
    let header = above.last().copied();
    let begin = header.unwrap_or(first);
    let skipped = lines.iter().take(begin).any(|line| !line.trim().is_empty() && !line.starts_with('#'));
    Some(CsvLayout {
        delimiter: (!text.is_workbook()).then_some(delimiter),
        decimal_comma,
        skip_lines: if skipped || header.is_none() { begin } else { 0 },
        header: header.is_some(),
        unit_lines: above.len().saturating_sub(1),
        sheet: None,
    })
}

/// Units, each with its other spellings.
const UNITS: [&str; 13] = [
    "deg degree degrees ° grad",
    "rad radian radians",
    "mm",
    "m",
    "s sec seconds",
    "ms msec",
    "us µs",
    "ns",
    "nm",
    "a",
    "n",
    "deg/s",
    "rad/s",
];

fn unit_named(text: &str) -> Option<String> {
    let text = text.trim().trim_matches(['[', ']', '(', ')']).trim().to_lowercase().replace('μ', "µ");
    let spellings = UNITS.iter().find(|spellings| spellings.split(' ').any(|one| one == text))?;
    spellings.split(' ').next().map(str::to_owned)
}

/// A name in lower case without unit, and the unit: `J1 [deg]`, `q1_deg`, `x(mm)`.
fn plain_and_unit(name: &str) -> (String, Option<String>) {
    let spaced: String = name.chars().fold(String::new(), |mut out, character| {
        // A capital after a small letter begins a word: TrackerX.
        if character.is_uppercase() && out.chars().last().is_some_and(char::is_lowercase) {
            out.push('_');
        }
        out.push(character);
        out
    });
    let name = spaced.to_lowercase();
    if let Some(open) = name.find(['[', '(']) {
        let (before, unit) = name.split_at(open);
        if let Some(unit) = unit_named(unit) {
            return (before.trim().to_owned(), Some(unit));
        }
    }
    if let Some((before, last)) = name.rsplit_once(['_', ' ', '.'])
        && last.len() > 1
        && let Some(unit) = unit_named(last)
    {
        return (before.trim().to_owned(), Some(unit));
    }
    (name, None)
}

/// The columns with their numbers, as the reader of such tables gives them.
fn columns(text: &RowsAsText<'_>, csv: &CsvLayout) -> Result<Vec<Column>, LogError> {
    /// Enough to see ranges and steps.
    const ROWS_MAX: usize = 20_000;
    let (header, units, rows) = text.rows(csv, ROWS_MAX)?;
    let column = |(index, name): (usize, &String)| {
        let (plain, unit) = plain_and_unit(name);
        let cells = || rows.iter().filter_map(|row| row.get(index)).map(String::as_str);
        let is_date = cells().next().is_some_and(is_date);
        let unit = unit
            .or_else(|| units.iter().filter_map(|line| line.get(index)).find_map(|unit| unit_named(unit)));
        let numbers = cells().filter_map(|cell| number(cell, csv.decimal_comma)).collect();
        Column { name: name.clone(), plain, unit, numbers, is_date }
    };
    Ok(header.iter().enumerate().map(column).collect())
}

/// Names of joints that have no numbers.
const NAMED_JOINTS: &[[&str; 6]] = &[
    ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"],
    ["base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3"],
    ["s", "l", "u", "r", "b", "t"],
];

/// Columns whose names differ in nothing but the joint, `axes` of them.
fn families(columns: &[Column], axes: usize) -> Vec<Vec<&Column>> {
    let mut by_pattern: BTreeMap<String, BTreeMap<usize, &Column>> = BTreeMap::new();
    for column in columns.iter().filter(|column| column.is_number()) {
        let bytes = column.plain.as_bytes();
        for (at, byte) in bytes.iter().enumerate().filter(|(_, byte)| byte.is_ascii_digit()) {
            let alone = |index: Option<usize>| {
                !index.and_then(|index| bytes.get(index)).is_some_and(u8::is_ascii_digit)
            };
            if alone(at.checked_sub(1)) && alone(Some(at + 1)) {
                let pattern = format!("{}#{}", &column.plain[..at], &column.plain[at + 1..]);
                by_pattern.entry(pattern).or_default().entry(usize::from(byte - b'0')).or_insert(column);
            }
        }
        for (set, names) in NAMED_JOINTS.iter().enumerate() {
            for (joint, name) in names.iter().enumerate() {
                let is_whole = name.len() > 1 || column.words().any(|word| word == *name);
                if let (true, Some(at)) = (is_whole, column.plain.find(name)) {
                    let pattern =
                        format!("{set}{}#{}", &column.plain[..at], &column.plain[at + name.len()..]);
                    by_pattern.entry(pattern).or_default().entry(joint + 1).or_insert(column);
                }
            }
        }
    }
    let consecutive = |of: &BTreeMap<usize, _>| {
        // From 0 or from 1; what has 0 and 6 is numbered from 0.
        let first = usize::from(!of.contains_key(&0));
        (first..first + axes).map(|joint| of.get(&joint).copied()).collect::<Option<Vec<&Column>>>()
    };
    by_pattern.values().filter_map(consecutive).collect()
}

/// Whether a joint's values are angles of it in this unit.
fn within(column: &Column, limits_deg: [f64; 2], unit: AngleUnit) -> bool {
    /// Zeros of controllers and models differ by quarter turns.
    const MARGIN_DEG: f64 = 190.0;
    let deg = |number: f64| (number * unit.to_rad()).to_degrees();
    column
        .numbers
        .iter()
        .all(|number| (limits_deg[0] - MARGIN_DEG..=limits_deg[1] + MARGIN_DEG).contains(&deg(*number)))
}

/// The joints' columns and their unit.
fn joints(
    columns: &[Column],
    robot: &RobotConfig,
    header: bool,
    notes: &mut Notes,
) -> Option<Vec<JointColumn>> {
    // Names and ranges of lengths are those of anything.
    let axes = robot.joint_limits_deg.len();
    if axes < robot.axes() {
        return None;
    }
    let suits = |family: &[&Column], unit| {
        family.iter().zip(&robot.joint_limits_deg).all(|(column, limits)| within(column, *limits, unit))
    };
    let score = |family: &[&Column]| {
        let has = |words| i32::from(family.iter().any(|column| column.has_word(words)));
        let still = family.iter().all(|column| column.numbers.windows(2).all(|pair| pair[0] == pair[1]));
        let rate = family
            .iter()
            .any(|column| column.unit.as_deref().is_some_and(|unit| !["deg", "rad"].contains(&unit)));
        let angle =
            i32::from(family.iter().all(|column| matches!(column.unit.as_deref(), Some("deg" | "rad"))));
        let possible = suits(family, AngleUnit::Deg);
        2 * angle
            - has(COMMANDED)
            - 5 * has(NOT_ANGLES)
            - 5 * i32::from(rate)
            - 3 * i32::from(still)
            - 9 * i32::from(!possible)
    };
    let mut choices = families(columns, axes);
    if choices.is_empty() && !header {
        let numeric: Vec<&Column> = columns.iter().filter(|column| column.is_number()).collect();
        choices = numeric.windows(axes).map(<[&Column]>::to_vec).collect();
        // As many in a row that are neither times nor millimetres; the first such.
        choices.retain(|family| suits(family, AngleUnit::Deg) && !family.iter().any(|column| rises(column)));
        choices.truncate(1);
        if !choices.is_empty() {
            notes.doubts.push(format!(
                "the table has no header: the first {axes} columns that can be angles are taken for the joints"
            ));
        }
    }
    // Of equals the first.
    let scored = choices.iter().rev().map(|family| (score(family), family));
    let (_, family) = scored.filter(|(score, _)| *score > -5).max_by_key(|(score, _)| *score)?;
    let unit = angle_unit(family, notes);
    if !suits(family, unit) {
        notes.doubts.push(format!(
            "some joints leave the robot's limits by more than half a turn: is this a log of {}?",
            robot.name
        ));
    }
    if family.iter().any(|column| column.has_word(COMMANDED)) {
        notes.doubts.push(
            "these are commanded angles, according to the columns' names; measured ones are better".into(),
        );
    }
    let names: Vec<&str> = family.iter().map(|column| column.name.as_str()).collect();
    notes.reasons.insert(
        0,
        format!("{} are joints 1 to {axes}: inferred from the columns' names and ranges", listed(&names)),
    );
    let unit = if unit == AngleUnit::Deg { JointUnit::Deg } else { JointUnit::Rad };
    let column = |column: &&Column| column.name.clone();
    let joint =
        |of: &&Column| JointColumn { column: column(of), unit, sign: 1.0, offset_deg: 0.0, offset_m: 0.0 };
    Some(family.iter().map(joint).collect())
}

/// The unit that header and values agree on.
fn angle_unit(family: &[&Column], notes: &mut Notes) -> AngleUnit {
    /// A robot's joints turn by at most a turn and a bit either way, mostly less.
    const RAD_MAX: f64 = 6.7;
    let said = family.iter().find_map(|column| match column.unit.as_deref() {
        Some("deg") => Some(AngleUnit::Deg),
        Some("rad") => Some(AngleUnit::Rad),
        _ => None,
    });
    let largest = family.iter().map(|column| column.largest()).fold(0.0, f64::max);
    let seen = if largest > RAD_MAX { AngleUnit::Deg } else { AngleUnit::Rad };
    match said {
        Some(said) if said == seen => notes
            .reasons
            .push(format!("angles in {}, from the header; they reach {largest:.1}", said.suffix())),
        Some(said) => notes.doubts.push(format!(
            "the header has {}, but the angles reach {largest:.1}, as {} would; {} is written here",
            said.suffix(),
            seen.suffix(),
            seen.suffix()
        )),
        None => notes.reasons.push(format!("angles in {}: they reach {largest:.1}", seen.suffix())),
    }
    seen
}

/// Never falls, and mostly rises.
fn rises(column: &Column) -> bool {
    let steps = column.numbers.windows(2).map(|pair| pair[1] - pair[0]);
    let (mut rising, mut falling, mut all) = (0, 0, 0);
    for step in steps {
        all += 1;
        rising += usize::from(step > 0.0);
        falling += usize::from(step < 0.0);
    }
    all > 0 && 2 * rising > all && 100 * falling <= all
}

/// `20161122101500`: year, month, day, hours, minutes and seconds written as one number.
fn is_date_in_digits(number: f64) -> bool {
    let part = |divisor: f64, most: f64| (number / divisor).floor() % most;
    let [year, month, day] = [part(1e10, 1e4), part(1e8, 100.0), part(1e6, 100.0)];
    let time = [part(1e4, 100.0), part(1e2, 100.0), part(1.0, 100.0)];
    number.fract() == 0.0
        && number < 1e14
        && (1980.0..2100.0).contains(&year)
        && (1.0..=12.0).contains(&month)
        && (1.0..=31.0).contains(&day)
        && time.iter().zip([24.0, 60.0, 61.0]).all(|(part, most)| *part < most)
}

/// The time stamps, if there are some.
fn time(columns: &[&Column], notes: &mut Notes) -> Option<TimeColumn> {
    let dated = columns.iter().find(|column| column.is_date && column.has_word(TIMES));
    if let Some(column) = dated.or_else(|| columns.iter().find(|column| column.is_date)) {
        notes.reasons.push(format!("`{}` has dates", column.name));
        return Some(TimeColumn::new(&column.name, TimeUnit::DateTime));
    }
    let rising: Vec<&&Column> = columns.iter().filter(|column| column.is_number() && rises(column)).collect();
    let said = rising.iter().find(|column| matches!(column.unit.as_deref(), Some("s" | "ms" | "us" | "ns")));
    let named = rising.iter().find(|column| column.has_word(TIMES));
    let column = said.or(named)?;
    let mut steps: Vec<f64> =
        column.numbers.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0).collect();
    let step = median(&mut steps)?;
    /// FILETIME of the years 1980 to 2100.
    const FILETIME: std::ops::Range<f64> = 1.19e17..1.58e17;
    if column.numbers.iter().all(|number| is_date_in_digits(*number)) {
        notes
            .reasons
            .push(format!("`{}` has dates (YYYYMMDDhhmmss), too coarse for times of rows", column.name));
        return None;
    }
    let (unit, why) = match column.unit.as_deref() {
        Some("s") => (TimeUnit::S, "from the header".to_owned()),
        Some("ms") => (TimeUnit::Ms, "from the header".into()),
        Some("us") => (TimeUnit::Us, "from the header".into()),
        Some("ns") => (TimeUnit::Ns, "from the header".into()),
        _ if FILETIME.contains(&column.numbers[0]) => (TimeUnit::Filetime, "by its size".into()),
        // Robots log at 1 Hz to 1 kHz and stamps hardly have more digits than that.
        _ if step < 0.9 => (TimeUnit::S, format!("stamps are {step:.4} apart")),
        _ if step < 900.0 => (TimeUnit::Ms, format!("stamps are {step:.1} apart")),
        _ if step < 9e5 => (TimeUnit::Us, format!("stamps are {step:.0} apart")),
        _ => (TimeUnit::Ns, format!("stamps are {step:.0} apart")),
    };
    notes.reasons.push(format!(
        "`{}` is the time in {}: {why}",
        column.name,
        format!("{unit:?}").to_lowercase()
    ));
    Some(TimeColumn::new(&column.name, unit))
}

/// Columns whose names differ in one word that is the wanted one; those of a tracker before others.
fn group<'c>(columns: &[&'c Column], words: &[&str]) -> Option<Vec<&'c Column>> {
    let mut found: Vec<Vec<&Column>> = Vec::new();
    for first in columns.iter().filter(|column| column.is_number()) {
        for at in first.plain.match_indices(words[0]).map(|(at, _)| at) {
            let (before, after) = (&first.plain[..at], &first.plain[at + words[0].len()..]);
            let ends = |text: Option<char>| !text.is_some_and(char::is_alphanumeric);
            if !ends(before.chars().last()) || !ends(after.chars().next()) {
                continue;
            }
            let named = |word: &&str| {
                let name = format!("{before}{word}{after}");
                columns.iter().find(|column| column.plain == name && column.is_number()).copied()
            };
            found.extend(words.iter().map(named).collect::<Option<Vec<_>>>());
        }
    }
    let of_tracker = found.iter().position(|group| group[0].has_word(TRACKERS)).unwrap_or(0);
    (of_tracker < found.len()).then(|| found.swap_remove(of_tracker))
}

fn triple<'c>(columns: &[&'c Column], words: &[&str; 3]) -> Option<[&'c Column; 3]> {
    group(columns, words).and_then(|group| group.try_into().ok())
}

/// The column that names what a row belongs to.
fn named(columns: &[&Column], what: &str, words: &[&str], notes: &mut Notes) -> Option<String> {
    let column = columns.iter().find(|column| words.contains(&column.plain.as_str()))?;
    notes
        .reasons
        .push(format!("`{}` has the name of the {what}: inferred from the column's name", column.name));
    Some(column.name.clone())
}

/// Tests on the nominal robot what names alone do not determine.
struct Trial<'a> {
    bytes: &'a [u8],
    path: &'a Path,
    robot: &'a RobotConfig,
}

impl Trial<'_> {
    /// The rows so read.
    fn rows(&self, mapping: &MeasuredPoseMapping) -> Option<Instrument> {
        let read = MeasuredPoses::read(self.bytes, self.path, mapping).ok()?;
        Some(Tracker::new(&read.rows.iter().map(PoseRow::from).collect::<Vec<_>>()).into())
    }

    /// Root mean squares of position \[m\] and rotation \[rad\] of the nominal robot against the rows so read.
    fn misfit(&self, mapping: &MeasuredPoseMapping) -> Option<(f64, f64)> {
        let nominal = misfit(&some_of(&self.rows(mapping)?), &flange_chain(self.robot))?;
        Some((nominal.position_m.rms, nominal.rotation_rad.map_or(0.0, |sizes| sizes.rms)))
    }

    /// The mapping whose signs, order and orientation fit the robot, with what was found.
    fn settled(
        &self,
        mut mapping: MeasuredPoseMapping,
        others: &[&Column],
        notes: &mut Notes,
    ) -> MeasuredPoseMapping {
        // A change that is right shows in the positions; what the orientation means is looked for after that.
        if let Some(rows) = self.rows(&mapping) {
            let chain = flange_chain(self.robot);
            match likely(&rows, &chain, &Mistake::of_joints(mapping.joints.len())) {
                Some(likely) => {
                    if let Mistake::Joints(mistake) = likely.mistake {
                        mend(&mut mapping.joints, mistake);
                    }
                    notes.doubts.push(format!("{likely}; it is written so"));
                }
                None => notes.reasons.extend(self.misfit(&mapping).map(|(position_m, _)| {
                    format!("the nominal robot is {:.1} mm from the positions", position_m * 1e3)
                })),
            }
        }
        let with =
            |rotation: RotationColumns| MeasuredPoseMapping { rotation: Some(rotation), ..mapping.clone() };
        let tried = orientations(others).into_iter().filter_map(|rotation| {
            let mapping = with(rotation);
            Some((self.misfit(&mapping)?.1, mapping))
        });
        /// The nominal robot's orientation is better than this, any wrong order is worse \[rad\].
        const FITS_RAD: f64 = 0.1;
        match tried.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((left, found)) if left < FITS_RAD => {
                notes
                    .reasons
                    .push(format!("the orientation is what fits the robot best, {:.1} mrad", left * 1e3));
                found
            }
            Some((left, _)) => {
                notes.doubts.push(format!(
                    "no reading of the orientation fits the robot ({:.0} mrad at best): left out",
                    left * 1e3
                ));
                mapping
            }
            None => mapping,
        }
    }
}

/// Undoes a mistake in the columns of the joints.
fn mend(joints: &mut [JointColumn], mistake: JointMistake) {
    match mistake {
        JointMistake::Reversed(joint) => joints[joint].sign = -joints[joint].sign,
        JointMistake::Exchanged(one, other) => joints.swap(one, other),
        JointMistake::InRadians | JointMistake::InDegrees => {
            for joint in joints {
                joint.unit = if joint.unit == JointUnit::Deg { JointUnit::Rad } else { JointUnit::Deg };
            }
        }
    }
}

/// What columns named like an orientation can mean.
fn orientations(columns: &[&Column]) -> Vec<RotationColumns> {
    const THREE: [[&str; 3]; 5] = [
        ["rx", "ry", "rz"],
        ["roll", "pitch", "yaw"],
        ["a", "b", "c"],
        ["w", "p", "r"],
        ["rotx", "roty", "rotz"],
    ];
    const FOUR: [[&str; 4]; 2] = [["qx", "qy", "qz", "qw"], ["q_x", "q_y", "q_z", "q_w"]];
    const NINE: [&str; 9] = ["r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"];
    const ORDERS: [&str; 12] =
        ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "xyx", "xzx", "yxy", "yzy", "zxz", "zyz"];
    let of = |form, group: Vec<&Column>| RotationColumns {
        form,
        columns: group.iter().map(|column| column.name.clone()).collect(),
        unit: None,
        order: None,
        frame: None,
    };
    let mut all = Vec::new();
    all.extend(group(columns, &NINE).map(|group| of(RotationForm::Matrix, group)));
    let four = FOUR.iter().filter_map(|words| group(columns, words));
    all.extend(four.map(|group| of(RotationForm::Quaternion, group)));
    for three in THREE.iter().filter_map(|words| group(columns, words)) {
        let unit = Some(angle_unit(&three, &mut Notes::default()));
        let vector = RotationColumns { unit, ..of(RotationForm::RotationVector, three) };
        let euler = |order: &str, frame| RotationColumns {
            form: RotationForm::Euler,
            order: Some(order.to_owned()),
            frame: Some(frame),
            ..vector.clone()
        };
        let frames = [EulerFrame::Moving, EulerFrame::Fixed];
        all.extend(ORDERS.iter().flat_map(|order| frames.map(|frame| euler(order, frame))));
        all.push(vector);
    }
    all
}
