//! Finds delimiter, decimal sign and header of a table by counting numbers.

use crate::logs::{CsvLayout, RowsAsText, is_comment};

/// Parses a cell as a finite number.
pub(super) fn number(cell: &str, decimal_comma: bool) -> Option<f64> {
    let cell = if decimal_comma { cell.replace(',', ".") } else { cell.to_owned() };
    cell.parse::<f64>().ok().filter(|number| number.is_finite())
}

pub(super) fn is_date(cell: &str) -> bool {
    let digits = cell.bytes().filter(u8::is_ascii_digit).count();
    // With points, the day is first: `22.11.2026 10:15:00`.
    let has_day = cell.contains('-') || cell.matches('.').count() >= 2;
    digits >= 12 && cell.contains(':') && has_day
}

fn cells(line: &str, delimiter: char) -> Vec<&str> {
    line.split(delimiter).map(|cell| cell.trim().trim_matches('"')).collect()
}

/// Delimiter, decimal sign and header of a table. The selected layout is the one that results in the most numbers
/// in rows of equal width.
pub(super) fn layout(text: &RowsAsText<'_>, axes: usize) -> Option<CsvLayout> {
    let lines: Vec<&str> = text.lines().collect();
    let choices =
        [(';', false), (';', true), ('\t', false), ('\t', true), (',', false), ('|', false), (' ', false)];
    // `max_by_key` returns the last of several equal maxima. The order is reversed, so that the first choice, without decimal
    // comma, is selected if counts are equal.
    let best = choices.into_iter().rev().filter_map(|(delimiter, decimal_comma)| {
        // Number of all cells in a row, and number of cells with numbers or dates. `None` if fewer than `axes` cells have
        // numbers, or if more than 30 % of the cells have neither numbers nor dates.
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
    // `above` are the lines directly above the first row of numbers that have the same number of cells, from the lowest to
    // the highest. The highest line is the header, and the lines below it contain units.
    let above: Vec<usize> = (0..first)
        .rev()
        .filter(|&line| !lines[line].trim().is_empty() && !is_comment(lines[line]))
        .take_while(|&line| cells(lines[line], delimiter).len() == width)
        .collect();
    // A title has mostly empty cells.
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
