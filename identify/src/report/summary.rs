//! The few lines of a calibration that a person needs at once: verdict, before and after, what limits, files, next step.

use std::path::{Path, PathBuf};

use super::result::file::CalibrationFile;
use super::verdict::Grade;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::{Limit, WorkspaceError};

/// Columns of a terminal.
pub const COLUMNS: usize = 100;

/// Text whose lines fit a terminal; what a line is continued with is set in.
pub fn wrapped(text: &str) -> String {
    let options = textwrap::Options::new(COLUMNS).subsequent_indent("  ").break_words(false);
    let line = |line: &str| {
        if line.chars().count() > COLUMNS { textwrap::fill(line, &options) } else { line.into() }
    };
    let lines: Vec<String> = text.split('\n').map(line).collect();
    lines.join("\n")
}

/// One line each, as far as they fit; `written` are the files beside the page.
pub fn summary(
    file: &CalibrationFile,
    workspace: &WorkspaceError,
    limits: &[Limit],
    written: &[PathBuf],
    page: &Path,
) -> String {
    let Some(verdict) = &file.verdict else { return String::new() };
    let mm = |metres: f64| format!("{:.3} mm", metres * 1e3);
    let (before, after) = (&workspace.before, &workspace.after);
    let expanded = file.budget.as_ref().map(|budget| {
        format!("; the geometry is known within {} (k = {})", mm(budget.expanded_m), budget.coverage_factor)
    });
    let held_out = file.held_out_m(Deployment::Full).map(|[nominal, calibrated]| {
        let parts: String = file.deployments_reported().iter().map(|told| format!("; {told}")).collect();
        format!("; on data that no fit has seen {} and {} (RMS{parts})", mm(nominal), mm(calibrated))
    });
    let lines = [
        verdict.to_string(),
        format!(
            "position error by geometry: {} before, {} after, mean over the workspace{}{}",
            mm(before.mean_m),
            mm(after.mean_m),
            expanded.unwrap_or_default(),
            held_out.unwrap_or_default(),
        ),
        format!("limited by: {}{}", limit(file, limits).trim_end_matches('.'), measured(file)),
        files(written, page),
        format!("next: {}", next(file)),
    ];
    lines.map(|line| wrapped(&line) + "\n").concat()
}

/// The first limit that the verdict does not name, or what makes positions uncertain most.
fn limit(file: &CalibrationFile, limits: &[Limit]) -> String {
    let reason = file.verdict.as_ref().and_then(|verdict| verdict.reason.as_ref());
    let other = limits.iter().find(|limit| limit.serious && Some(&limit.sentence) != reason);
    let largest = || {
        let budget = file.budget.as_ref()?;
        let most = budget.contributions.first()?;
        let part = 100.0 * budget.part(most);
        Some(format!("{}, {part:.0} % of the variance of a position", most.source))
    };
    other
        .map(|limit| limit.sentence.clone())
        .or_else(largest)
        .unwrap_or_else(|| "nothing that is known".into())
}

/// Where the calibration is supported.
fn measured(file: &CalibrationFile) -> String {
    let validity = file.validity.as_ref().filter(|validity| !validity.joints.is_empty());
    validity.map_or_else(String::new, |validity| format!("; supported (deg): {validity}"))
}

fn files(written: &[PathBuf], page: &Path) -> String {
    let names = written.iter().map(PathBuf::as_path).chain([page]);
    let names = names.map(|path| path.file_name().unwrap_or_default().to_string_lossy());
    let directory = page.parent().unwrap_or(Path::new("."));
    format!("in {}: {}", directory.display(), names.collect::<Vec<_>>().join(", "))
}

fn next(file: &CalibrationFile) -> &'static str {
    match file.verdict.as_ref().map(|verdict| verdict.grade) {
        _ if !file.may_be_applied() => {
            "read report.html for what to measure otherwise; keep the nominal geometry"
        }
        _ if !file.serves(Deployment::Dh) => {
            "without the terms of calibration.json a controller gains nothing sure: read report.html"
        }
        Some(Grade::Green) => "apply corrections.csv, then measure once more and `identify compare` both",
        _ => "read report.html, then apply corrections.csv if what limits does not matter",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_line_is_wider_than_a_terminal_but_a_single_word() {
        let path = format!("/{}", "long".repeat(40));
        let text = format!("a sentence of several words {}\n{path}\nshort\n", "that goes on ".repeat(20));
        let wrapped = wrapped(&text);
        let fits = |line: &str| line.chars().count() <= COLUMNS || line == path;
        assert!(wrapped.lines().all(fits), "{wrapped}");
        let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(words(&wrapped), words(&text));
    }
}
