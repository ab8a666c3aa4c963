//! Text for `identify examine`. For each cost function it contains the rank of the Jacobian, groups of dependent parameters,
//! the influence of fixed parameters on the estimates, and observability.

use std::fmt::Write;

use crate::examine::Examination;
use crate::solver::{Identifiability, Influence};

/// An error in a fixed parameter counts as affecting an estimate if the estimate changes by more than this fraction of the
/// error (thesis section 3.3).
const AFFECTED: f64 = 0.05;
/// Largest number of names in a list. Longer lists end with the number of the remaining names.
const NAMES_MAX: usize = 8;

/// Writes one block of text for each cost: rank and gap, columns without effect, dependent groups, influence of
/// fixed parameters, and observability.
pub fn examinations(examinations: &[Examination]) -> String {
    let mut text = String::new();
    for one in examinations {
        let _ = writeln!(text, "{}", one.cost.name());
        rank(&mut text, &one.all);
        let _ = writeln!(
            text,
            "  with the base's two rotations: rank {} of {}{}",
            one.tilted.rank,
            one.tilted.names.len(),
            gap(&one.tilted),
        );
        if !one.further_fixed.is_empty() {
            let names: Vec<String> = one.further_fixed.iter().map(ToString::to_string).collect();
            let _ = writeln!(
                text,
                "  fixed besides those of the thesis (dependent or without effect): {}",
                names.join(" ")
            );
        }
        influences(&mut text, &one.influence);
        let _ = writeln!(
            text,
            "  observability of the thesis' free parameters (per mm and mrad): {}\n",
            one.observability
        );
    }
    text
}

/// Appends the rank with its gap, the columns without effect, and the dependent groups.
fn rank(text: &mut String, found: &Identifiability) {
    let names = |columns: &[usize], separator: &str| {
        let name = |column: &usize| found.names.get(*column).map_or("?", String::as_str);
        columns.iter().map(name).collect::<Vec<_>>().join(separator)
    };
    let _ = writeln!(text, "  rank {} of {}{}", found.rank, found.names.len(), gap(found));
    let zero = if found.zero_columns.is_empty() { "none".into() } else { names(&found.zero_columns, " ") };
    let _ = writeln!(text, "  without effect: {zero}");
    for (i, group) in found.groups.iter().enumerate() {
        let earlier_groups = &found.groups[..i];
        let (shared, own): (Vec<usize>, Vec<usize>) = group
            .columns
            .iter()
            .partition(|column| earlier_groups.iter().any(|earlier| earlier.columns.contains(column)));
        // If this group shares a column with an earlier group, any other column of the earlier group could be shared
        // instead. The text therefore names the earlier group, not the column.
        let through: Vec<String> = earlier_groups
            .iter()
            .filter(|earlier| shared.iter().any(|column| earlier.columns.contains(column)))
            .map(|earlier| names(&earlier.columns, "|"))
            .collect();
        let through = if through.is_empty() {
            String::new()
        } else {
            format!(" with one of each of {}", through.join(", "))
        };
        let _ = writeln!(text, "  dependent: {}{through} (fix {})", names(&own, "|"), group.excess);
    }
}

/// Text about the gap, which is the ratio of the singular values before and after the rank. A ratio above 1000 is clear and
/// is written without digits, because its digits depend on the poses.
fn gap(found: &Identifiability) -> String {
    found.gap().map_or_else(String::new, |gap| {
        if gap > 1e3 { ", clear gap above 1e3".into() } else { format!(", gap {gap:.0}") }
    })
}

/// Appends a line for each fixed parameter. The line lists the estimates that change if this parameter has an error, as in
/// table 3.4 of the thesis.
fn influences(text: &mut String, influence: &Influence) {
    let _ =
        writeln!(text, "  an error of 1 mm|mrad in a fixed parameter changes (if by more than {AFFECTED}):");
    for (column, held) in influence.held.iter().enumerate() {
        let changes = influence.change.column(column);
        // Values are rounded as displayed, so that rounding errors change neither the selection nor the order.
        let rounded = changes.iter().map(|change| (change * 100.0).round() / 100.0);
        let changed = influence.estimated.iter().map(String::as_str).zip(rounded);
        let mut affected: Vec<(&str, f64)> = changed.filter(|(_, change)| change.abs() > AFFECTED).collect();
        affected.sort_by(|a, b| b.1.abs().total_cmp(&a.1.abs()));
        let shown: Vec<String> =
            affected.iter().take(NAMES_MAX).map(|(name, change)| format!("{name} {change:+.2}")).collect();
        let more = affected.len().saturating_sub(NAMES_MAX);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        let nothing = if affected.is_empty() { "nothing" } else { "" };
        let _ = writeln!(text, "    {held:<8} {}{more}{nothing}", shown.join("  "));
    }
}
