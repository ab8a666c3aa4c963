//! The columns of a table with their names, units and numbers, and groups of columns with related names.

use super::Notes;
use super::layout::{is_date, number};
use crate::logs::{CsvLayout, LengthUnit, LogError, RowsAsText};

/// Words that show that positions were measured by a tracker and are not the controller's own.
pub(super) const TRACKERS: &str = "tracker meas measured measurement laser probe smr leica api faro";

/// One column of a table. Of its cells, only the numbers are stored.
pub(super) struct TableColumn {
    pub(super) name: String,
    /// The name in lower case, without unit.
    pub(super) plain: String,
    pub(super) unit: Option<&'static str>,
    pub(super) numbers: Vec<f64>,
    pub(super) is_date: bool,
}

impl TableColumn {
    /// Position at which the plain name contains this text. A single letter must be a word of its own.
    pub(super) fn find(&self, text: &str) -> Option<usize> {
        let is_part = |beside: Option<char>| beside.is_some_and(char::is_alphanumeric);
        let is_found = |at: usize| {
            let (before, after) = (&self.plain[..at], &self.plain[at + text.len()..]);
            text.len() > 1 || !(is_part(before.chars().next_back()) || is_part(after.chars().next()))
        };
        self.plain.match_indices(text).map(|(at, _)| at).find(|at| is_found(*at))
    }

    /// Whether the name contains one of these words, which are separated by spaces. Digits at the end of a word in
    /// the name are ignored.
    pub(super) fn has_word(&self, words: &str) -> bool {
        self.plain.split(|character: char| !character.is_alphanumeric()).any(|word| {
            let bare = word.trim_end_matches(|character: char| character.is_ascii_digit());
            words.split(' ').any(|wanted| wanted == word || wanted == bare)
        })
    }

    /// Largest absolute value; zero without numbers.
    pub(super) fn largest(&self) -> f64 {
        self.numbers.iter().fold(0.0, |most, number| most.max(number.abs()))
    }

    pub(super) fn is_number(&self) -> bool {
        !self.numbers.is_empty() && !self.is_date
    }

    /// Whether more than half of the steps between consecutive numbers are upwards, and at most 1 % are downwards.
    pub(super) fn rises(&self) -> bool {
        let steps = self.numbers.len().saturating_sub(1);
        let rising = self.numbers.windows(2).filter(|pair| pair[1] > pair[0]).count();
        let falling = self.numbers.windows(2).filter(|pair| pair[1] < pair[0]).count();
        2 * rising > steps && 100 * falling <= steps
    }

    /// Unit of a length, from the header or from the size of the numbers, with the reason.
    pub(super) fn length_unit(&self) -> (LengthUnit, String) {
        /// No position of an arm is larger than this in metres. In millimetres, positions are larger.
        const M_MAX: f64 = 20.0;
        match self.unit {
            Some("mm") => (LengthUnit::Mm, "from the header".into()),
            Some("m") => (LengthUnit::M, "from the header".into()),
            _ if self.largest() > M_MAX => (LengthUnit::Mm, format!("up to {:.0}, so mm", self.largest())),
            _ => (LengthUnit::M, format!("up to {:.2}, so m", self.largest())),
        }
    }
}

/// Units with their other spellings. The units of torques, currents, forces and speeds show that a column does
/// not contain joint angles.
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

fn unit_named(text: &str) -> Option<&'static str> {
    let text = text.trim().trim_matches(['[', ']', '(', ')']).trim().to_lowercase().replace('μ', "µ");
    let spellings = UNITS.iter().find(|spellings| spellings.split(' ').any(|one| one == text))?;
    spellings.split(' ').next()
}

/// Splits the name of a column into the name in lower case and the unit. The unit is in brackets or the last word, as
/// in `J1 [deg]`, `x(mm)`, `q1_deg`.
fn plain_and_unit(name: &str) -> (String, Option<&'static str>) {
    let spaced: String = name.chars().fold(String::new(), |mut out, character| {
        // A capital after a small letter begins a new word, as in `TrackerX`.
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
    // A single letter at the end belongs to the name and is not a unit: `joint_a` is not in amperes. Columns such as `x_m`
    // are still read correctly, because the unit of a length is then inferred from the size of its numbers.
    if let Some((before, last)) = name.rsplit_once(['_', ' ', '.'])
        && last.len() > 1
        && let Some(unit) = unit_named(last)
    {
        return (before.trim().to_owned(), Some(unit));
    }
    (name, None)
}

/// Reads the columns in this layout, with names, units and numbers.
pub(super) fn columns(text: &RowsAsText<'_>, csv: &CsvLayout) -> Result<Vec<TableColumn>, LogError> {
    /// Largest number of rows that are read, sufficient to determine ranges and steps.
    const ROWS_MAX: usize = 20_000;
    let (header, units, rows) = text.rows(csv, ROWS_MAX)?;
    let column = |(index, name): (usize, &String)| {
        let (plain, unit) = plain_and_unit(name);
        let cells = || rows.iter().filter_map(|row| row.get(index)).map(String::as_str);
        let is_date = cells().next().is_some_and(is_date);
        let unit = unit
            .or_else(|| units.iter().filter_map(|line| line.get(index)).find_map(|unit| unit_named(unit)));
        let numbers = cells().filter_map(|cell| number(cell, csv.decimal_comma)).collect();
        TableColumn { name: name.clone(), plain, unit, numbers, is_date }
    };
    Ok(header.iter().enumerate().map(column).collect())
}

/// Finds a group of columns, one for each of the words, whose names differ only in this word, such as `tracker_x`,
/// `tracker_y`, `tracker_z`. If there are several such groups, a group of a tracker is preferred.
pub(super) fn group<'c>(columns: &[&'c TableColumn], words: &[&str]) -> Option<Vec<&'c TableColumn>> {
    let mut found: Vec<Vec<&TableColumn>> = Vec::new();
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

/// As [`group`], for three words.
pub(super) fn triple<'c>(columns: &[&'c TableColumn], words: &[&str; 3]) -> Option<[&'c TableColumn; 3]> {
    group(columns, words).and_then(|group| group.try_into().ok())
}

/// Name of the column that contains the station or target of each row. `what` names this content in the note.
pub(super) fn label_column(
    columns: &[&TableColumn],
    what: &str,
    words: &[&str],
    notes: &mut Notes,
) -> Option<String> {
    let column = columns.iter().find(|column| words.contains(&column.plain.as_str()))?;
    notes.reason(format!("`{}` has the name of the {what}: inferred from the column's name", column.name));
    Some(column.name.clone())
}
