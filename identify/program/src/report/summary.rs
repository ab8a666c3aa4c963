//! Short summary of a calibration for the terminal: verdict, position error before and after, most important limit,
//! written files, and next step.

use std::path::{Path, PathBuf};

use super::result::deployments::what;
use super::result::file::CalibrationFile;
use super::verdict::Grade;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::WorkspaceError;

/// Number of columns of a terminal.
pub const COLUMNS: usize = 100;

/// Wraps all lines that are longer than [`COLUMNS`]. Continued lines are indented.
pub fn wrapped(text: &str) -> String {
    let options = textwrap::Options::new(COLUMNS).subsequent_indent("  ").break_words(false);
    let line = |line: &str| {
        if line.chars().count() > COLUMNS { textwrap::fill(line, &options) } else { line.into() }
    };
    let lines: Vec<String> = text.split('\n').map(line).collect();
    lines.join("\n")
}

/// The summary; empty if the calibration has no verdict. Each item is a paragraph that is wrapped to the width of the
/// terminal. `page` is the report page and `written` are the other files.
pub fn summary(
    file: &CalibrationFile,
    workspace: &WorkspaceError,
    written: &[PathBuf],
    page: &Path,
) -> String {
    if file.verdict.is_none() {
        return String::new();
    }
    let mm = |metres: f64| format!("{:.3} mm", metres * 1e3);
    let (before, after) = (&workspace.before, &workspace.after);
    let expanded = file
        .budget
        .as_ref()
        .map(|budget| format!("; known within {} (k = {})", mm(budget.expanded_m), budget.coverage_factor));
    let deployed: String = file
        .deployments_expected(workspace)
        .map(|(deployment, expected)| format!(", {} with {}", mm(expected.mean_m), what(deployment)))
        .collect();
    let parts = file.deployments_reported();
    let lines = [
        file.is_simulated().then(|| SIMULATED.to_owned()),
        Some(file.verdict_sentence()),
        Some(format!(
            "position error, mean over the workspace: {} before, {} after{deployed}{}",
            mm(before.mean_m),
            mm(after.mean_m),
            expanded.unwrap_or_default(),
        )),
        (!parts.is_empty()).then(|| format!("held-out data with a part of the model: {}", parts.join("; "))),
        file.scale.as_ref().map(|scale| format!("scale: {scale}")),
        Some(format!("limited by: {}{}", limit(file).trim_end_matches('.'), supported(file))),
        not_separated(file),
        Some(files(written, page)),
        Some(format!("next: {}", next(file))),
    ];
    lines.into_iter().flatten().map(|line| wrapped(&line) + "\n").collect()
}

/// Heading of every result of simulated measurements.
pub(crate) const SIMULATED: &str = "SIMULATED: no robot was measured";

/// Clauses about link parameters of which the data determine only a combination, and about link parameters that the data
/// do not determine at all.
pub(in crate::report) fn not_separated(file: &CalibrationFile) -> Option<String> {
    let (groups, single): (Vec<&str>, Vec<&str>) =
        file.not_separated.iter().map(String::as_str).partition(|group| group.contains('|'));
    let part =
        |what: &str, names: Vec<&str>| (!names.is_empty()).then(|| format!("{what}: {}", names.join(", ")));
    let parts =
        [part("not separated by the data", groups), part("not determined by the data, near nominal", single)];
    let parts: Vec<String> = parts.into_iter().flatten().collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

/// The most important limit that the verdict does not name. The page lists all limits.
fn limit(file: &CalibrationFile) -> &str {
    file.other_limits().next().map_or("nothing that is known", |limit| &limit.sentence)
}

/// Clause about the joint ranges for which the calibration is supported.
fn supported(file: &CalibrationFile) -> String {
    let validity = file.validity.as_ref().filter(|validity| !validity.joints.is_empty());
    validity.map_or_else(String::new, |validity| format!("; supported (deg): {validity}"))
}

fn files(written: &[PathBuf], page: &Path) -> String {
    let names = written.iter().map(PathBuf::as_path).chain([page]);
    let names = names.map(|path| path.file_name().unwrap_or_default().to_string_lossy());
    let directory = page.parent().unwrap_or(Path::new("."));
    format!("in {}: {}", directory.display(), names.collect::<Vec<_>>().join(", "))
}

/// The recommended next step. It depends on the verdict and on the tables of corrections that are written.
fn next(file: &CalibrationFile) -> &'static str {
    let grade = file.verdict.as_ref().map(|verdict| verdict.grade);
    match (file.serves(Deployment::Dh), grade) {
        _ if !file.may_be_applied() => {
            "keep the nominal geometry in the controller and measure again; report.html lists what limits"
        }
        (true, Some(Grade::Green)) => {
            "add each number of corrections.csv to the controller's own (joints in its units and signs: corrections_log.csv), then \
             calibrate a second run: its error before should be about the one above with links alone (Applying a result, step 7)"
        }
        (true, _) => {
            "read report.html; if what limits is acceptable, add each number of corrections.csv to the controller's own"
        }
        (false, _) if file.serves(Deployment::Offsets) => {
            "add each number of offsets.csv to the controller's own (joints in its units and signs: offsets_log.csv)"
        }
        (false, _) => {
            "change nothing in the controller: neither links alone nor joint offsets alone are surely better than nominal; \
             calibration.json has the full model"
        }
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
