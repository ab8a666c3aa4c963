//! Proposes a mapping for a table without one, for `identify inspect --propose`. From the bytes of a table and the robot's
//! file: layout by counting numbers; joints, times, lengths and positions by names, units and ranges of the columns; then
//! signs, order and orientation by the smallest residuals of the nominal robot. None of it is certain, so the mapping lists
//! the reason of each choice.

use std::collections::BTreeMap;
use std::path::Path;

use shared::config::{self, AngleUnit, RobotConfig};

use crate::calibrate::rows::{likely, misfit, some_of};
use crate::instrument::{Instrument, Mistake, PoseRow, Tracker};
use crate::kinematics::flange_chain;
use crate::logs::{
    ContactMapping, CsvLayout, EulerFrame, JointColumn, JointMistake, JointUnit, LengthColumn, LengthUnit,
    LogError, MeasuredLengthMapping, MeasuredPoseMapping, MeasuredPoses, PositionColumns, RobotLogMapping,
    RotationColumns, RotationForm, RowsAsText, TimeColumn, TimeUnit, is_comment, own_columns,
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
            Mapping::RobotLog(mapping) => config::to_toml(mapping),
            Mapping::MeasuredPoses(mapping) => config::to_toml(mapping),
            Mapping::MeasuredLengths(mapping) => config::to_toml(mapping),
            Mapping::Contacts(mapping) => config::to_toml(mapping),
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
    let proposals = sheets.iter().map(|sheet| (sheet.as_str(), for_sheet(bytes, path, robot, Some(sheet))));
    let (usable, others): (Vec<_>, Vec<_>) = proposals.partition(|(_, proposal)| proposal.is_ok());
    let names: Vec<&str> = usable.iter().map(|(sheet, _)| *sheet).collect();
    let Some((_, first)) = usable.into_iter().chain(others).next() else {
        return for_sheet(bytes, path, robot, None);
    };
    let mut first = first?;
    if names.len() > 1 {
        let names = names.join(", ");
        first.notes.doubts.push(format!("sheets {names} all have such a table; the first is taken"));
    }
    Ok(first)
}

/// Proposes a mapping for one sheet of a workbook, or for a text file.
fn for_sheet(
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
    // Columns of the robot's own log, as its file names them.
    let log_columns = own_columns(robot);
    let is_own_log = log_columns.iter().all(|name| columns.iter().any(|column| column.name == *name));
    let mut joint_notes = Notes::default();
    let joints = joints(&columns, robot, csv.header, &mut joint_notes);
    if joints.is_none() && !is_own_log {
        return Err(ProposeError::NoJoints { path: shown, joints: robot.axes(), found: found() });
    }
    let joints = joints.unwrap_or_default();
    let is_joint = |column: &Column| joints.iter().any(|joint| joint.column == column.name);
    let taken = |column: &Column| is_joint(column) || (is_own_log && log_columns.contains(&column.name));
    let others: Vec<&Column> = columns.iter().filter(|column| !taken(column)).collect();
    let time = time(&others, &mut notes);
    let length = others.iter().find(|column| column.has_word(LENGTHS)).copied();
    let position = triple(&others, &["x", "y", "z"]);
    let of_tracker = position.is_some_and(|xyz| xyz[0].has_word(TRACKERS));
    let socket = others.iter().find(|column| column.has_word(SOCKETS));
    // The most specific content decides: a log with times may also have the controller's own positions.
    let mapping = match (time, length, position, socket) {
        (_, _, _, Some(socket)) => {
            notes.reasons.push(format!(
                "column `{}` contains the socket in which the ball is seated: inferred from its name",
                socket.name
            ));
            Mapping::Contacts(ContactMapping { csv, socket: socket.name.clone(), joints })
        }
        (_, Some(length), _, _) => {
            let (unit, why) = length.length_unit();
            notes.reasons.push(format!(
                "`{}` is the measured length: inferred from the column's name; {why}",
                length.name
            ));
            let length = LengthColumn { column: length.name.clone(), unit, offset_mm: 0.0 };
            let anchor = label_column(&others, "wire's anchor", &["anchor", "station"], &mut notes);
            let attachment =
                label_column(&others, "place on the flange", &["attachment", "target"], &mut notes);
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
            let joints = if is_own_log {
                let reason = format!("{} are the columns of the robot's own log", listed(&log_columns));
                joint_notes = Notes { reasons: vec![reason], ..Notes::default() };
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
            let station = label_column(&others, "tracker's station", &["station", "setup"], &mut notes);
            let targets = ["target", "reflector", "smr"];
            let target = label_column(&others, "target that was seen", &targets, &mut notes);
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
            let mapping = Trial { bytes, path, robot }.corrected(mapping, &others, &mut notes);
            Mapping::MeasuredPoses(mapping)
        }
        _ => return Err(ProposeError::NothingMeasured { path: shown, found: found() }),
    };
    notes.reasons.splice(0..0, joint_notes.reasons);
    notes.doubts.splice(0..0, joint_notes.doubts);
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

/// One column of a table, with those of its cells that are numbers.
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

    /// Whether the name has one of these words, a list with spaces between them; digits at its end do not count.
    fn has_word(&self, words: &str) -> bool {
        self.words().any(|word| {
            let bare = word.trim_end_matches(|character: char| character.is_ascii_digit());
            words.split(' ').any(|wanted| wanted == word || wanted == bare)
        })
    }

    fn largest(&self) -> f64 {
        self.numbers.iter().fold(0.0, |most, number| most.max(number.abs()))
    }

    fn is_number(&self) -> bool {
        !self.numbers.is_empty() && !self.is_date
    }

    fn length_unit(&self) -> (LengthUnit, String) {
        /// No arm reaches so far in metres; its positions in millimetres are larger.
        const M_MAX: f64 = 20.0;
        match self.unit.as_deref() {
            Some("mm") => (LengthUnit::Mm, "from the header".into()),
            Some("m") => (LengthUnit::M, "from the header".into()),
            _ if self.largest() > M_MAX => (LengthUnit::Mm, format!("up to {:.0}, so mm", self.largest())),
            _ => (LengthUnit::M, format!("up to {:.2}, so m", self.largest())),
        }
    }
}

/// A cell as a number.
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

/// Delimiter, decimal sign and header of a table: of all choices the one that gives most numbers in rows of equal width.
fn layout(text: &RowsAsText<'_>, axes: usize) -> Option<CsvLayout> {
    let lines: Vec<&str> = text.lines().collect();
    let choices =
        [(';', false), (';', true), ('\t', false), ('\t', true), (',', false), ('|', false), (' ', false)];
    // `max_by_key` takes the last of equals, and the reversed order makes it the first: with equal counts no decimal comma.
    let best = choices.into_iter().rev().filter_map(|(delimiter, decimal_comma)| {
        // Of a row of numbers, which may have up to 30 % of other cells: the number of all cells, and of numbers or dates.
        let row_size = |line: &str| {
            let cells = cells(line, delimiter);
            let numbers =
                cells.iter().filter(|cell| number(cell, decimal_comma).is_some() || is_date(cell)).count();
            (numbers >= axes && 10 * numbers >= 7 * cells.len()).then_some((cells.len(), numbers))
        };
        let first = lines.iter().position(|line| row_size(line).is_some())?;
        let (width, _) = row_size(lines.get(first)?)?;
        let rows = lines.iter().filter_map(|line| row_size(line)).filter(|(cells, _)| *cells == width);
        let total: usize = rows.map(|(_, numbers)| numbers).sum();
        Some((total, delimiter, decimal_comma, first, width))
    });
    let (_, delimiter, decimal_comma, first, width) = best.max_by_key(|(total, ..)| *total)?;
    // Lines of the same width above the numbers, from the lowest: lines of units, then a header.
    let above: Vec<usize> = (0..first)
        .rev()
        .filter(|&line| !lines[line].trim().is_empty() && !is_comment(lines[line]))
        .take_while(|&line| cells(lines[line], delimiter).len() == width)
        .collect();
    // Mostly empty cells.
    let is_title = |line: &&usize| {
        cells(lines[**line], delimiter).iter().filter(|cell| cell.is_empty()).count() * 2 > width
    };
    let above: Vec<usize> = above.iter().take_while(|line| !is_title(line)).copied().collect();
    let header = above.last().copied();
    let begin = header.unwrap_or(first);
    let skipped = lines.iter().take(begin).any(|line| !line.trim().is_empty() && !is_comment(line));
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

/// The columns with names, units and numbers, read in this layout.
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

/// Candidates for the joints: each has `axes` columns whose names differ only in the number, or the usual name, of the joint.
fn families(columns: &[Column], axes: usize) -> Vec<Vec<&Column>> {
    // Pattern: a name with `#` in place of the joint. Its columns are keyed by the joint's number.
    let mut by_pattern: BTreeMap<String, BTreeMap<usize, &Column>> = BTreeMap::new();
    for column in columns.iter().filter(|column| column.is_number()) {
        let bytes = column.plain.as_bytes();
        for (at, byte) in bytes.iter().enumerate().filter(|(_, byte)| byte.is_ascii_digit()) {
            let is_digit = |index: Option<usize>| {
                index.and_then(|index| bytes.get(index)).is_some_and(u8::is_ascii_digit)
            };
            if !is_digit(at.checked_sub(1)) && !is_digit(Some(at + 1)) {
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
    let consecutive = |by_number: &BTreeMap<usize, _>| {
        // From 0 if there is a 0, otherwise from 1.
        let first = usize::from(!by_number.contains_key(&0));
        (first..first + axes).map(|number| by_number.get(&number).copied()).collect::<Option<Vec<&Column>>>()
    };
    by_pattern.values().filter_map(consecutive).collect()
}

/// Whether all values, taken in this unit, are within the limits of the joint.
fn is_within(column: &Column, limits_deg: [f64; 2], unit: AngleUnit) -> bool {
    /// Zeros of controllers and models differ by quarter turns.
    const MARGIN_DEG: f64 = 190.0;
    let deg = |number: f64| (number * unit.to_rad()).to_degrees();
    column
        .numbers
        .iter()
        .all(|number| (limits_deg[0] - MARGIN_DEG..=limits_deg[1] + MARGIN_DEG).contains(&deg(*number)))
}

/// The columns of the joints with their unit: of all candidates the one with the highest score.
fn joints(
    columns: &[Column],
    robot: &RobotConfig,
    header: bool,
    notes: &mut Notes,
) -> Option<Vec<JointColumn>> {
    // Only revolute joints have limits in degrees; columns of prismatic ones cannot be recognised by range.
    let axes = robot.joint_limits_deg.len();
    if axes < robot.axes() {
        return None;
    }
    let is_possible = |family: &[&Column], unit| {
        family.iter().zip(&robot.joint_limits_deg).all(|(column, limits)| is_within(column, *limits, unit))
    };
    // Empirical weights: a certain contradiction outweighs all favourable signs.
    let score = |family: &[&Column]| {
        let has = |words| i32::from(family.iter().any(|column| column.has_word(words)));
        let still = family.iter().all(|column| column.numbers.windows(2).all(|pair| pair[0] == pair[1]));
        let has_other_unit = family
            .iter()
            .any(|column| column.unit.as_deref().is_some_and(|unit| !["deg", "rad"].contains(&unit)));
        let has_angle_unit =
            family.iter().all(|column| matches!(column.unit.as_deref(), Some("deg" | "rad")));
        2 * i32::from(has_angle_unit)
            - has(COMMANDED)
            - 5 * has(NOT_ANGLES)
            - 5 * i32::from(has_other_unit)
            - 3 * i32::from(still)
            - 9 * i32::from(!is_possible(family, AngleUnit::Deg))
    };
    let mut choices = families(columns, axes);
    if choices.is_empty() && !header {
        let numeric: Vec<&Column> = columns.iter().filter(|column| column.is_number()).collect();
        choices = numeric.windows(axes).map(<[&Column]>::to_vec).collect();
        // The first neighbouring columns that are neither times nor millimetres.
        choices.retain(|family| {
            is_possible(family, AngleUnit::Deg) && !family.iter().any(|column| rises(column))
        });
        choices.truncate(1);
        if !choices.is_empty() {
            notes.doubts.push(format!(
                "the table has no header: the first {axes} columns that can be angles are taken for the joints"
            ));
        }
    }
    // The first of equals, see `layout`.
    let scored = choices.iter().rev().map(|family| (score(family), family));
    let (_, family) = scored.filter(|(score, _)| *score > -5).max_by_key(|(score, _)| *score)?;
    let unit = angle_unit(family, notes);
    if !is_possible(family, unit) {
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
    let joint = |column: &&Column| JointColumn {
        column: column.name.clone(),
        unit,
        sign: 1.0,
        offset_deg: 0.0,
        offset_m: 0.0,
    };
    Some(family.iter().map(joint).collect())
}

/// The unit by the size of the values; a note states whether the header agrees.
fn angle_unit(family: &[&Column], notes: &mut Notes) -> AngleUnit {
    /// Joints of robots turn by little more than a turn either way.
    const RAD_MAX: f64 = 6.7;
    let stated = family.iter().find_map(|column| match column.unit.as_deref() {
        Some("deg") => Some(AngleUnit::Deg),
        Some("rad") => Some(AngleUnit::Rad),
        _ => None,
    });
    let largest = family.iter().map(|column| column.largest()).fold(0.0, f64::max);
    let inferred = if largest > RAD_MAX { AngleUnit::Deg } else { AngleUnit::Rad };
    match stated {
        Some(stated) if stated == inferred => notes
            .reasons
            .push(format!("angles in {}, from the header; they reach {largest:.1}", stated.suffix())),
        Some(stated) => notes.doubts.push(format!(
            "the header has {}, but the angles reach {largest:.1}, as {} would; {} is written here",
            stated.suffix(),
            inferred.suffix(),
            inferred.suffix()
        )),
        None => notes.reasons.push(format!("angles in {}: they reach {largest:.1}", inferred.suffix())),
    }
    inferred
}

/// Whether more than half of the steps are upwards, and at most 1 % downwards.
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
    let with_unit =
        rising.iter().find(|column| matches!(column.unit.as_deref(), Some("s" | "ms" | "us" | "ns")));
    let with_name = rising.iter().find(|column| column.has_word(TIMES));
    let column = with_unit.or(with_name)?;
    let mut steps: Vec<f64> =
        column.numbers.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0).collect();
    let step = median(&mut steps)?;
    /// Windows FILETIME, 100 ns since 1601, of the years 1980 to 2100.
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

/// One column for each of the words, with names that are otherwise equal, such as `tracker_x`, `tracker_y`, `tracker_z`;
/// those of a tracker are preferred.
fn group<'c>(columns: &[&'c Column], words: &[&str]) -> Option<Vec<&'c Column>> {
    let mut found: Vec<Vec<&Column>> = Vec::new();
    for first in columns.iter().filter(|column| column.is_number()) {
        for at in first.plain.match_indices(words[0]).map(|(at, _)| at) {
            let (before, after) = (&first.plain[..at], &first.plain[at + words[0].len()..]);
            let is_inside_word = |neighbour: Option<char>| neighbour.is_some_and(char::is_alphanumeric);
            if is_inside_word(before.chars().last()) || is_inside_word(after.chars().next()) {
                continue;
            }
            let with_word = |word: &&str| {
                let name = format!("{before}{word}{after}");
                columns.iter().find(|column| column.plain == name && column.is_number()).copied()
            };
            found.extend(words.iter().map(with_word).collect::<Option<Vec<_>>>());
        }
    }
    let preferred = found.iter().position(|group| group[0].has_word(TRACKERS)).unwrap_or(0);
    (preferred < found.len()).then(|| found.swap_remove(preferred))
}

fn triple<'c>(columns: &[&'c Column], words: &[&str; 3]) -> Option<[&'c Column; 3]> {
    group(columns, words).and_then(|group| group.try_into().ok())
}

/// The column that names the station or target of each row.
fn label_column(columns: &[&Column], what: &str, words: &[&str], notes: &mut Notes) -> Option<String> {
    let column = columns.iter().find(|column| words.contains(&column.plain.as_str()))?;
    notes
        .reasons
        .push(format!("`{}` has the name of the {what}: inferred from the column's name", column.name));
    Some(column.name.clone())
}

/// Determines by residuals of the nominal robot what the names of the columns leave open.
struct Trial<'a> {
    bytes: &'a [u8],
    path: &'a Path,
    robot: &'a RobotConfig,
}

impl Trial<'_> {
    /// The rows as this mapping reads them.
    fn rows(&self, mapping: &MeasuredPoseMapping) -> Option<Instrument> {
        let read = MeasuredPoses::read(self.bytes, self.path, mapping).ok()?;
        Some(Tracker::new(&read.rows.iter().map(PoseRow::from).collect::<Vec<_>>()).into())
    }

    /// RMS residuals of the nominal robot in position \[m\] and rotation \[rad\] with this mapping.
    fn misfit(&self, mapping: &MeasuredPoseMapping) -> Option<(f64, f64)> {
        let nominal = misfit(&some_of(&self.rows(mapping)?), &flange_chain(self.robot))?;
        Some((nominal.position_m.rms, nominal.rotation_rad.map_or(0.0, |sizes| sizes.rms)))
    }

    /// The mapping with signs, order and unit of the joints corrected, and with the columns of the orientation, as they fit
    /// the nominal robot best.
    fn corrected(
        &self,
        mut mapping: MeasuredPoseMapping,
        others: &[&Column],
        notes: &mut Notes,
    ) -> MeasuredPoseMapping {
        // Positions alone show mistakes in the joints; the orientation is tried with corrected joints.
        if let Some(rows) = self.rows(&mapping) {
            let chain = flange_chain(self.robot);
            match likely(&rows, &chain, &Mistake::of_joints(mapping.joints.len())) {
                Some(likely) => {
                    if let Mistake::Joints(mistake) = likely.mistake {
                        undo(&mut mapping.joints, mistake);
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
        let trials = orientations(others).into_iter().filter_map(|rotation| {
            let mapping = with(rotation);
            Some((self.misfit(&mapping)?.1, mapping))
        });
        /// The nominal robot is within this of the right reading; any wrong one is further away \[rad\].
        const FITS_RAD: f64 = 0.1;
        match trials.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((rms_rad, best)) if rms_rad < FITS_RAD => {
                notes
                    .reasons
                    .push(format!("the orientation is what fits the robot best, {:.1} mrad", rms_rad * 1e3));
                best
            }
            Some((rms_rad, _)) => {
                notes.doubts.push(format!(
                    "no reading of the orientation fits the robot ({:.0} mrad at best): left out",
                    rms_rad * 1e3
                ));
                mapping
            }
            None => mapping,
        }
    }
}

/// Undoes a mistake in the columns of the joints.
fn undo(joints: &mut [JointColumn], mistake: JointMistake) {
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

/// All readings of the columns whose names are those of an orientation.
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
    let rotation = |form, group: Vec<&Column>| RotationColumns {
        form,
        columns: group.iter().map(|column| column.name.clone()).collect(),
        unit: None,
        order: None,
        frame: None,
    };
    let mut all = Vec::new();
    all.extend(group(columns, &NINE).map(|group| rotation(RotationForm::Matrix, group)));
    let four = FOUR.iter().filter_map(|words| group(columns, words));
    all.extend(four.map(|group| rotation(RotationForm::Quaternion, group)));
    for three in THREE.iter().filter_map(|words| group(columns, words)) {
        let unit = Some(angle_unit(&three, &mut Notes::default()));
        let vector = RotationColumns { unit, ..rotation(RotationForm::RotationVector, three) };
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
