//! Generates `parameters.md` from the table of parameters in `identify/core/src/model/parameter.rs`.

use std::fmt::Write;

use generate::page::cell;
use identify::model::{Group, Owner, ParameterId};

use super::check;

const ABOUT: &str = "\
The options `--free` and `--fix`, `[priors]` and the result files use these names. Links, joints and axes are numbered from 1.
Values in result files have the SI unit; values in `[priors]`, on the terminal and in the report have the displayed unit.
The last column shows which parameters have a separate value for each data set. In a calibration from several data sets,
the value for the second data set is called `NAME@2`.
";

/// Parameters of one table row, grouped by their names without digits.
type ParameterRow = Vec<(String, Vec<ParameterId>)>;

const fn heading(owner: Owner) -> &'static str {
    match owner {
        Owner::Robot => "Robot",
        Owner::Clocks => "Clocks of robot and instrument",
        Owner::BallBar => "Ball-bar",
        Owner::Wire => "Draw-wire or telescoping bar",
        Owner::Tracker => "Tracker",
        Owner::Scale => "Scale of a tracker or a wire",
        Owner::Contact => "Ball in sockets",
        Owner::Touch => "Touch probe or dial gauge",
    }
}

#[test]
fn the_page_on_parameters_is_the_table_of_the_model() {
    let mut rows: Vec<(_, ParameterRow)> = Vec::new();
    for id in ParameterId::all() {
        let kind = (id.meaning(), id.block());
        let letters = id.to_string().replace(|letter: char| letter.is_ascii_digit(), "");
        let at = rows.iter().position(|(own, _)| *own == kind).unwrap_or(rows.len());
        if at == rows.len() {
            rows.push((kind, Vec::new()));
        }
        match rows[at].1.iter_mut().find(|(own, _)| *own == letters) {
            Some((_, ids)) => ids.push(id),
            None => rows[at].1.push((letters, vec![id])),
        }
    }
    let (mut text, mut owner) = (ABOUT.to_owned(), None);
    for ((meaning, block), names) in rows {
        if owner.replace(block.owner) != Some(block.owner) {
            let columns =
                "| names | meaning | SI unit | displayed in | for each data set |\n|---|---|---|---|---|";
            let _ = writeln!(text, "\n## {}\n\n{columns}", heading(block.owner));
        }
        let names = names.iter().map(|(_, ids)| match ids[..] {
            [only] => format!("`{only}`"),
            _ => format!("`{}` .. `{}`", ids[0], ids[ids.len() - 1]),
        });
        let names: Vec<_> = names.collect();
        let term = match block.group {
            Group::Term(group) => format!(" Error term: {}.", group.name()),
            _ => String::new(),
        };
        let (si, displayed) = (block.unit.si_symbol(), block.unit.display_symbol());
        let (names, meaning) = (names.join(", "), cell(meaning));
        let of_run = if block.of_run { "yes" } else { "no" };
        let _ = writeln!(text, "| {names} | {meaning}{term} | {si} | {displayed} | {of_run} |");
    }
    check(
        "parameters.md",
        "Parameters of the model",
        "the table in `identify/core/src/model/parameter.rs`",
        &text,
    );
}
