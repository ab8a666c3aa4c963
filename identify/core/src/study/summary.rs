//! Summarises a study's results for the page and the terminal. A point of a curve consists of quantiles of the errors of all
//! experiments with one size. The answer to a statement is a mean or a ratio of medians, or the size at which a curve
//! reaches the limit. Tables have the format of those in the thesis.

use std::collections::BTreeMap;
use std::iter;

use serde::Serialize;

use super::results::PlacedRow;
use super::{CurveChoice, Definition, Figure, FigureKind, Measure, ResultRow, Results, Statement};
use crate::statistics::quantile;

/// A parameter counts as affected if its median error is above this (thesis 3.3) \[mm|mrad\].
const AFFECTED_MM_MRAD: f64 = 0.05;
/// Number of parameters in a row of table B.1 of the thesis.
const LARGEST: usize = 5;

/// Quantiles of the errors of all experiments at one point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorQuantiles {
    /// Median of the errors.
    pub median: f64,
    /// Lower quartile of the errors.
    pub lower_quartile: f64,
    /// Upper quartile of the errors.
    pub upper_quartile: f64,
    /// Largest of the errors.
    pub worst: f64,
}

impl ErrorQuantiles {
    fn from_values(mut values: Vec<f64>) -> Self {
        let [median, lower_quartile, upper_quartile, worst] =
            [0.5, 0.25, 0.75, 1.0].map(|part| quantile(&mut values, part));
        Self { median, lower_quartile, upper_quartile, worst }
    }
}

/// Summary of the experiments with one size.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CurvePoint {
    /// Size of the varied conditions.
    pub x: f64,
    /// Number of experiments with this size.
    pub experiments: usize,
    /// Number of experiments without an estimate.
    pub failed: usize,
    /// Quantiles of the errors, by measure, over the experiments with an estimate. Empty if half of the experiments or
    /// more have no estimate.
    pub errors: BTreeMap<Measure, ErrorQuantiles>,
}

/// Errors of one estimator in one series.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ErrorCurve {
    /// The figure's number.
    pub figure: String,
    /// The series' name.
    pub series: String,
    /// Name of the estimator.
    pub estimator: String,
    /// Name of the estimator for display.
    pub label: String,
    /// Points in the order of the series' sizes.
    pub points: Vec<CurvePoint>,
    /// Size at which the Euclidean error reaches the study's limit.
    pub limit_at: Reach,
}

/// Size at which a curve reaches a limit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Reach {
    /// The curve reaches the limit at this size. The size is interpolated between two sizes of the curve, in logarithms, or
    /// linearly if a number is not positive.
    At(f64),
    /// All errors are below the limit. The curve would reach the limit above this size, the largest of the curve.
    BetterUpTo(f64),
    /// All errors are above the limit. The curve would reach the limit below this size, the smallest of the curve.
    WorseDownTo(f64),
    /// The curve has no points.
    Unknown,
}

/// The answer to a [`Statement`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StatementAnswer {
    /// Text of the question or claim.
    pub text: String,
    /// Result as a sentence.
    pub answer: String,
    /// Value of the result; `None` if it could not be computed.
    pub value: Option<f64>,
    /// Whether the claim holds; `None` for a question, and if the results do not contain the curve.
    pub holds: Option<bool>,
    /// Explanation of the answer.
    pub why: String,
}

/// Table of a figure that is presented as a table.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct FigureTable {
    /// The figure's number.
    pub figure: String,
    /// Headings of the columns.
    pub head: Vec<String>,
    /// Cells of each row.
    pub rows: Vec<Vec<String>>,
}

/// Summary of a study: curves, tables and answers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StudySummary {
    /// The study's name.
    pub title: String,
    /// Number of experiments at each point.
    pub seeds: u32,
    /// All curves, in the order of the study's file.
    pub curves: Vec<ErrorCurve>,
    /// Tables of figures that are presented as tables.
    pub tables: Vec<FigureTable>,
    /// Answers to the statements, in the order of the study's file.
    pub findings: Vec<StatementAnswer>,
    /// Number of experiments without an estimate, by estimator and reason.
    pub failures: BTreeMap<String, usize>,
}

impl StudySummary {
    /// Summarises the results of all experiments.
    pub fn new(definition: &Definition, results: &Results) -> Self {
        let study = &definition.study;
        let placed: Vec<PlacedRow<'_>> = results.placed(definition).collect();
        let mut failures = BTreeMap::new();
        for PlacedRow { estimator, row, .. } in &placed {
            if let Some(reason) = &row.failed {
                *failures.entry(format!("{estimator}: {reason}")).or_default() += 1;
            }
        }
        let (mut curves, mut tables) = (Vec::new(), Vec::new());
        for figure in &study.figures {
            let of_figure: Vec<&PlacedRow<'_>> =
                placed.iter().filter(|placed| placed.trial.figure.id == figure.id).collect();
            curves.extend(curves_of(definition, figure, &of_figure));
            let table = match figure.kind {
                FigureKind::Curves => continue,
                FigureKind::Levels => levels_table(definition, figure, &of_figure),
                FigureKind::Affected => affected_table(&of_figure),
                FigureKind::Errors => errors_table(&of_figure),
                FigureKind::Largest => largest_table(&of_figure),
            };
            tables.push(FigureTable { figure: figure.id.clone(), ..table });
        }
        let limit = study.limit_mm_mrad;
        let findings = study.statements.iter().map(|statement| finding(statement, &curves, limit)).collect();
        Self { title: study.title.clone(), seeds: study.seeds, curves, tables, findings, failures }
    }
}

impl ErrorCurve {
    /// Size and median error of each point within the chosen range of sizes.
    fn medians(&self, choice: &CurveChoice) -> impl Iterator<Item = (f64, f64)> {
        let between = choice.between.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
        let points = self.points.iter().filter(move |point| between[0] <= point.x && point.x <= between[1]);
        points.filter_map(|point| Some((point.x, point.errors.get(&choice.measure)?.median)))
    }
}

/// A curve for each series and estimator of the figure.
fn curves_of(definition: &Definition, figure: &Figure, of_figure: &[&PlacedRow<'_>]) -> Vec<ErrorCurve> {
    let study = &definition.study;
    let mut curves = Vec::new();
    for series in &figure.series {
        for estimator in study.estimators_of(figure, series) {
            // Series are compared by address, because two series may have the same name.
            let of_curve: Vec<&&PlacedRow<'_>> = of_figure
                .iter()
                .filter(|placed| std::ptr::eq(placed.trial.series, series) && placed.estimator == estimator)
                .collect();
            let points: Vec<CurvePoint> = series.x.iter().map(|&x| point(x, &of_curve)).collect();
            let median = |point: &CurvePoint| Some((point.x, point.errors.get(&Measure::Euclidean)?.median));
            let medians: Vec<(f64, f64)> = points.iter().filter_map(median).collect();
            let label = study.estimator(estimator).map_or_else(String::new, |found| found.label.clone());
            curves.push(ErrorCurve {
                figure: figure.id.clone(),
                series: series.name.clone(),
                estimator: estimator.clone(),
                label,
                limit_at: reach(&medians, study.limit_mm_mrad),
                points,
            });
        }
    }
    curves
}

/// Summary of the experiments with size `x`.
fn point(x: f64, of_curve: &[&&PlacedRow<'_>]) -> CurvePoint {
    let rows: Vec<&ResultRow> =
        of_curve.iter().filter(|placed| placed.trial.x == x).map(|placed| placed.row).collect();
    let failed = rows.iter().filter(|row| row.failed.is_some()).count();
    let mut errors = BTreeMap::new();
    if 2 * failed < rows.len() {
        for measure in Measure::ALL {
            let values: Vec<f64> = rows.iter().filter_map(|row| row.error(measure)).collect();
            if !values.is_empty() {
                errors.insert(measure, ErrorQuantiles::from_values(values));
            }
        }
    }
    CurvePoint { x, experiments: rows.len(), failed, errors }
}

/// The smallest size at which the curve crosses the limit, upwards or downwards.
fn reach(medians: &[(f64, f64)], limit: f64) -> Reach {
    let mut sorted: Vec<(f64, f64)> = medians.to_vec();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let crossing = sorted.windows(2).find(|pair| (pair[0].1 <= limit) != (pair[1].1 <= limit));
    if let Some(&[(x0, y0), (x1, y1)]) = crossing {
        let logarithmic = x0 > 0.0 && y0 > 0.0 && y1 > 0.0;
        let scaled = |value: f64| if logarithmic { value.ln() } else { value };
        let part = (scaled(limit) - scaled(y0)) / (scaled(y1) - scaled(y0));
        let x = scaled(x0) + part * (scaled(x1) - scaled(x0));
        return Reach::At(if logarithmic { x.exp() } else { x });
    }
    match (sorted.first(), sorted.last()) {
        (Some(_), Some((x, y))) if *y <= limit => Reach::BetterUpTo(*x),
        (Some((x, _)), Some(_)) => Reach::WorseDownTo(*x),
        _ => Reach::Unknown,
    }
}

/// Answers a question or checks a claim from the curves. `limit` is the study's limit \[mm|mrad\].
fn finding(statement: &Statement, curves: &[ErrorCurve], limit: f64) -> StatementAnswer {
    let points = points_of(curves, &statement.of);
    let (value, answer) = match &statement.against {
        None if statement.reaches_limit => size_at_limit(&points, limit),
        None => {
            let mean = mean_median(&points);
            (mean, mean.map(|mean| format!("{} {}", short(mean), unit(statement.of.measure))))
        }
        Some(against) => {
            let ratio = ratio(&points, &points_of(curves, against), [&statement.of, against]);
            (ratio, ratio.map(|ratio| format!("{} times as large", short(ratio))))
        }
    };
    let Statement { at_least, at_most, .. } = *statement;
    let is_within =
        |value: f64| at_least.is_none_or(|least| value >= least) && at_most.is_none_or(|most| value <= most);
    let is_claim = at_least.is_some() || at_most.is_some();
    StatementAnswer {
        text: statement.text.clone(),
        holds: (is_claim && answer.is_some()).then(|| value.is_some_and(is_within)),
        answer: answer.unwrap_or_else(|| no_points(statement)),
        value,
        why: statement.why.clone(),
    }
}

/// Answer to a statement about curves without points.
fn no_points(statement: &Statement) -> String {
    let choices = iter::once(&statement.of).chain(&statement.against);
    let names: Vec<String> = choices
        .map(|choice| {
            let CurveChoice { figure, estimator, measure, .. } = choice;
            format!("the {} of `{estimator}` in figure `{figure}`", measure.label())
        })
        .collect();
    format!("cannot be computed: no size has {}; choose another `measure` or `between`", names.join(" and "))
}

/// A point of a curve that a statement selects.
struct Point<'a> {
    series: &'a str,
    /// Size of the varied conditions.
    x: f64,
    /// Median of the errors.
    median: f64,
}

/// The points that a statement selects.
fn points_of<'a>(curves: &'a [ErrorCurve], choice: &CurveChoice) -> Vec<Point<'a>> {
    let is_chosen = |curve: &&ErrorCurve| {
        curve.figure == choice.figure
            && curve.estimator == choice.estimator
            && choice.series.as_ref().is_none_or(|series| *series == curve.series)
    };
    let points = |curve: &'a ErrorCurve| {
        curve.medians(choice).map(|(x, median)| Point { series: &curve.series, x, median })
    };
    curves.iter().filter(is_chosen).flat_map(points).collect()
}

/// The size at which the medians reach the limit, as a number and as a sentence. The number is `None` if the curve does
/// not cross the limit.
fn size_at_limit(points: &[Point<'_>], limit: f64) -> (Option<f64>, Option<String>) {
    let medians: Vec<(f64, f64)> = points.iter().map(|point| (point.x, point.median)).collect();
    match reach(&medians, limit) {
        Reach::At(x) => (Some(x), Some(format!("{} is reached at {}", short(limit), short(x)))),
        Reach::BetterUpTo(x) => (None, Some(format!("better than {} up to {}", short(limit), short(x)))),
        Reach::WorseDownTo(x) => (None, Some(format!("worse than {} down to {}", short(limit), short(x)))),
        Reach::Unknown => (None, None),
    }
}

/// Ratio of two selections of points. If both choices have the same range of sizes, each point is compared with a
/// point of equal size, and the result is the geometric mean of these ratios. If the ranges differ, it is the ratio
/// of the geometric means.
///
/// If both choices select the same series, a point is compared only with points of its own series, otherwise with
/// points of any series.
fn ratio(points: &[Point<'_>], against: &[Point<'_>], choices: [&CurveChoice; 2]) -> Option<f64> {
    let [choice, against_choice] = choices;
    if choice.between != against_choice.between {
        return Some(mean_median(points)? / mean_median(against)?);
    }
    let same_series = choice.series == against_choice.series;
    let ratios = points.iter().filter_map(|point| {
        let is_comparable =
            |other: &&Point<'_>| other.x == point.x && (!same_series || other.series == point.series);
        against.iter().find(is_comparable).map(|other| point.median / other.median)
    });
    geometric_mean(ratios)
}

fn mean_median(points: &[Point<'_>]) -> Option<f64> {
    geometric_mean(points.iter().map(|point| point.median))
}

const fn unit(measure: Measure) -> &'static str {
    match measure {
        Measure::Position => "mm",
        Measure::Euclidean | Measure::Largest => "mm|mrad",
    }
}

/// Geometric mean of the positive finite values; `None` if there are no such values.
fn geometric_mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let logarithms = values.filter(|value| *value > 0.0 && value.is_finite()).map(f64::ln);
    let (count, sum) = logarithms.fold((0usize, 0.0), |(count, sum), value| (count + 1, sum + value));
    (count > 0).then(|| (sum / count as f64).exp())
}

/// Formats a number with three significant digits. Numbers below 1e-4, and numbers of 1e6 or more, are
/// written in exponential notation.
pub fn short(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let exponent = value.abs().log10().floor() as i32;
    if !(-4..6).contains(&exponent) {
        return format!("{value:.2e}");
    }
    let decimals = (2 - exponent).clamp(0, 9) as usize;
    format!("{value:.decimals$}")
}

/// A table with these headings and rows; the caller sets `figure`.
fn table(head: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> FigureTable {
    let head = head.iter().map(|&name| name.to_owned()).collect();
    FigureTable { head, rows: rows.into_iter().collect(), ..FigureTable::default() }
}

/// Table with a row for each point of each curve: median and worst errors.
fn levels_table(definition: &Definition, figure: &Figure, of_figure: &[&PlacedRow<'_>]) -> FigureTable {
    let rows = curves_of(definition, figure, of_figure).into_iter().flat_map(|curve| {
        let ErrorCurve { series, label, points, .. } = curve;
        points.into_iter().map(move |point| {
            let cell = |measure, value: fn(&ErrorQuantiles) -> f64| {
                point.errors.get(&measure).map_or_else(|| "none".into(), |spread| short(value(spread)))
            };
            vec![
                series.clone(),
                label.clone(),
                cell(Measure::Euclidean, |spread| spread.median),
                cell(Measure::Euclidean, |spread| spread.worst),
                cell(Measure::Largest, |spread| spread.worst),
                cell(Measure::Position, |spread| spread.median),
                format!("{} of {}", point.failed, point.experiments),
            ]
        })
    });
    let head = [
        "",
        "estimator",
        "Euclidean, median [mm|mrad]",
        "worst",
        "largest of all",
        "position, median [mm]",
        "failed",
    ];
    table(&head, rows)
}

/// Table with a row for each series and estimator: the parameters whose median error exceeds [`AFFECTED_MM_MRAD`].
fn affected_table(of_figure: &[&PlacedRow<'_>]) -> FigureTable {
    /// Errors by parameter; one value for each seed.
    type ErrorsByParameter<'a> = BTreeMap<&'a str, Vec<f64>>;
    // Pairs of series and estimator, in order of appearance. The errors of each pair are at the same index
    // of the other list.
    let mut keys: Vec<(&str, &str)> = Vec::new();
    let mut errors_by_key: Vec<ErrorsByParameter<'_>> = Vec::new();
    for placed in of_figure {
        let key = (placed.trial.series.name.as_str(), placed.estimator);
        let index = keys.iter().position(|known| *known == key).unwrap_or_else(|| {
            keys.push(key);
            errors_by_key.push(ErrorsByParameter::new());
            keys.len() - 1
        });
        for (name, error) in &placed.row.errors {
            errors_by_key[index].entry(name).or_default().push(error.abs());
        }
    }
    let rows = keys.into_iter().zip(errors_by_key).map(|((series, estimator), errors)| {
        let medians =
            errors.into_iter().map(|(name, values)| (name, ErrorQuantiles::from_values(values).median));
        let mut affected: Vec<(&str, f64)> = medians.filter(|(_, error)| *error > AFFECTED_MM_MRAD).collect();
        affected.sort_by(|(_, a), (_, b)| b.total_cmp(a));
        let names = affected.iter().map(|(name, error)| format!("{name} ({})", short(*error)));
        let names = names.collect::<Vec<_>>().join(", ");
        vec![
            series.into(),
            estimator.into(),
            affected.len().to_string(),
            if names.is_empty() { "none".into() } else { names },
        ]
    });
    table(&["error of 1 in", "estimator", "affected", "which, with their error [mm|mrad]"], rows)
}

/// Table with a row for each parameter and a column for each estimator: errors in the first experiment.
fn errors_table(of_figure: &[&PlacedRow<'_>]) -> FigureTable {
    let experiment: Vec<&&PlacedRow<'_>> = of_figure.iter().filter(|placed| placed.trial.seed == 1).collect();
    let mut names: Vec<&String> = Vec::new();
    for name in experiment.iter().flat_map(|placed| placed.row.errors.keys()) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let head: Vec<&str> =
        ["parameter"].into_iter().chain(experiment.iter().map(|placed| placed.estimator)).collect();
    let row = |name: &&String| {
        let cell = |placed: &&&PlacedRow<'_>| {
            placed.row.errors.get(*name).map_or_else(|| "-".into(), |error| format!("{error:.4}"))
        };
        std::iter::once((*name).clone()).chain(experiment.iter().map(cell)).collect()
    };
    table(&head, names.iter().map(row))
}

/// Table with a row for each experiment and estimator: the [`LARGEST`] errors with their parameters.
fn largest_table(of_figure: &[&PlacedRow<'_>]) -> FigureTable {
    let row = |placed: &&PlacedRow<'_>| {
        let mut errors: Vec<(&String, f64)> =
            placed.row.errors.iter().map(|(name, error)| (name, error.abs())).collect();
        errors.sort_by(|(_, a), (_, b)| b.total_cmp(a));
        let names = errors.iter().take(LARGEST).map(|(name, error)| format!("{name} ({})", short(*error)));
        [placed.trial.seed.to_string(), placed.estimator.to_owned()].into_iter().chain(names).collect()
    };
    table(
        &["experiment", "estimator", "largest [mm|mrad]", "2nd", "3rd", "4th", "5th"],
        of_figure.iter().map(row),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_reaches_a_limit_between_two_sizes_or_never() {
        let power = |x: f64| (x, 0.01 * x.powi(2));
        let curve: Vec<(f64, f64)> = [1.0, 3.0, 10.0, 30.0].map(power).to_vec();
        let Reach::At(x) = reach(&curve, 0.5) else { panic!("{:?}", reach(&curve, 0.5)) };
        assert!((x - 50.0_f64.sqrt()).abs() < 1e-9, "{x}");
        assert_eq!(reach(&curve, 100.0), Reach::BetterUpTo(30.0));
        assert_eq!(reach(&curve, 1e-3), Reach::WorseDownTo(1.0));
        let falling: Vec<(f64, f64)> = curve.iter().map(|(x, y)| (100.0 / x, *y)).collect();
        assert!(matches!(reach(&falling, 0.5), Reach::At(_)));
        assert_eq!(reach(&[], 0.5), Reach::Unknown);
    }

    #[test]
    fn a_claim_about_an_error_that_no_experiment_has_is_neither_confirmed_nor_refuted() {
        let of = CurveChoice {
            figure: "w".into(),
            series: None,
            estimator: "wire".into(),
            between: None,
            measure: Measure::Euclidean,
        };
        let statement = Statement {
            text: "more rows are better".into(),
            of,
            against: None,
            reaches_limit: false,
            at_least: None,
            at_most: Some(0.9),
            why: String::new(),
        };
        let StatementAnswer { answer, value, holds, .. } = finding(&statement, &[], 0.5);
        assert_eq!((value, holds), (None, None));
        assert!(
            answer.contains("no size has the Euclidean error [mm|mrad] of `wire` in figure `w`"),
            "{answer}"
        );
    }

    #[test]
    fn numbers_have_three_significant_digits() {
        let written = [0.012_345, 1.2345, 123.45, 12_345.0, 0.0, 1.234e-9, -4.56e10].map(short);
        assert_eq!(written, ["0.0123", "1.23", "123", "12345", "0", "1.23e-9", "-4.56e10"]);
    }
}
