//! The file of a study and its validation. A study consists of figures, estimators, and questions about the result. A figure
//! has one or more series. A series varies some conditions by several sizes. Each size is one point of a curve. For each
//! point, there are as many experiments as the study has seeds.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use shared::config::{Validate, Violation};

use super::Conditions;
use crate::calibrate::IdentifyConfig;
use crate::plan::DURATION_S_MIN;

/// Contents of a study's file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StudyFile {
    /// Name of the study.
    pub title: String,
    /// Subject of the study, shown at the top of the page.
    #[serde(default)]
    pub about: String,
    /// Path of the robot's configuration, relative to the study's file.
    pub robot: PathBuf,
    /// Path of the bar's configuration, relative to the study's file.
    pub bar: PathBuf,
    /// Source of the path of the experiments. If absent, there is a separate random path for each seed.
    #[serde(default)]
    pub path: PathChoice,
    /// Number of experiments at each point of a curve.
    pub seeds: u32,
    /// Number of pairs of robot and bar angles in each experiment, unless a series sets `points`.
    pub points: u32,
    /// Length of a random path \[s\].
    pub duration_s: f64,
    /// Position of the bar in the second half of an experiment with two stations \[m\].
    pub second_base_m: Option<[f64; 3]>,
    /// Largest acceptable error \[mm|mrad\].
    pub limit_mm_mrad: f64,
    /// Estimators that solve the experiments.
    pub estimators: Vec<Estimator>,
    /// Figures with their varied conditions.
    pub figures: Vec<Figure>,
    /// Questions about the result.
    #[serde(default)]
    pub statements: Vec<Statement>,
}

/// Source of the path. At most one of the three fields may be set.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PathChoice {
    /// Seed of a random path that all experiments share.
    pub seed: Option<u64>,
    /// Path of a file `path.toml` written by `identify plan`.
    pub planned: Option<PathBuf>,
    /// Path of a log of the robot's joints while the robot was connected to the bar.
    pub log: Option<PathBuf>,
}

/// A method of estimation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Estimator {
    /// Name by which figures select the estimator.
    pub name: String,
    /// Name for display in reports.
    pub label: String,
    /// Instrument that the estimator uses.
    #[serde(default)]
    pub instrument: StudyInstrument,
    /// Configuration as in `config/identify.toml`. A draw-wire uses the default configuration.
    #[serde(default)]
    pub config: IdentifyConfig,
}

/// Instrument of an estimator.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StudyInstrument {
    /// The ball-bar, with the path and the conditions of the experiment.
    #[default]
    BallBar,
    /// A draw-wire that measures `wire_rows` random postures.
    Wire,
}

/// Presentation of a figure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FigureKind {
    /// Curves of the error over the size of the varied conditions. There is one curve for each combination
    /// of series and estimator.
    #[default]
    Curves,
    /// A table with the median and largest errors of each estimator.
    Levels,
    /// A table of the parameters with a median error above 0.05 mm|mrad.
    Affected,
    /// A table with the error of each parameter in the first experiment.
    Errors,
    /// A table with the five largest errors of each experiment.
    Largest,
}

/// Measure of the error of an estimate.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// Euclidean norm of the errors of the thesis' parameters \[mm|mrad\].
    #[default]
    Euclidean,
    /// Largest error of the thesis' parameters \[mm|mrad\].
    Largest,
    /// Mean distance between true and estimated position of the robot's end, over all postures \[mm\].
    Position,
}

impl Measure {
    /// All measures, in the order of the tables.
    pub const ALL: [Self; 3] = [Self::Euclidean, Self::Largest, Self::Position];

    /// Text for display, with the unit.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Euclidean => "Euclidean error [mm|mrad]",
            Self::Largest => "largest error [mm|mrad]",
            Self::Position => "position error of the robot [mm]",
        }
    }
}

/// A figure or table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Figure {
    /// Number of the figure.
    pub id: String,
    /// Title of the figure.
    pub title: String,
    /// Result of the thesis, paraphrased.
    #[serde(default)]
    pub thesis: String,
    /// Presentation of the figure.
    #[serde(default)]
    pub kind: FigureKind,
    /// Error measure of the curves.
    #[serde(default)]
    pub measure: Measure,
    /// Varied quantity, with its unit.
    #[serde(default)]
    pub x: String,
    /// Names of the estimators.
    pub estimators: Vec<String>,
    /// Series of varied conditions.
    pub series: Vec<FigureSeries>,
}

/// One series of a figure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FigureSeries {
    /// Name of the series; empty if the figure has only one series.
    #[serde(default)]
    pub name: String,
    /// Sizes by which the varied conditions are multiplied.
    pub x: Vec<f64>,
    /// Value of each varied condition at size 1, by key.
    #[serde(default)]
    pub vary: BTreeMap<String, f64>,
    /// Value of each constant condition, by key.
    #[serde(default)]
    pub with: BTreeMap<String, f64>,
    /// Names of the estimators of this series; if absent, those of the figure.
    pub estimators: Option<Vec<String>>,
}

/// Selects a curve of a figure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurveChoice {
    /// The figure's number.
    pub figure: String,
    /// The series' name; if absent, all series are selected.
    pub series: Option<String>,
    /// The estimator's name.
    pub estimator: String,
    /// Lowest and highest size; if absent, all sizes are selected.
    pub between: Option<[f64; 2]>,
    /// Measure of the error.
    #[serde(default)]
    pub measure: Measure,
}

/// A question about a curve. If the result has bounds, it is a claim instead. The result is one of three numbers:
///
/// - By default, it is the geometric mean of the curve's medians.
/// - With `against`, it is the ratio of the curve's medians to the medians of another curve.
/// - With `reaches_limit`, it is the size at which the curve reaches the study's limit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Statement {
    /// Text of the question or claim.
    pub text: String,
    /// Curve from which the result is computed.
    pub of: CurveChoice,
    /// Curve for comparison: the result is divided by the medians of this curve.
    pub against: Option<CurveChoice>,
    /// Whether the result is the size at which the curve reaches the study's limit.
    #[serde(default)]
    pub reaches_limit: bool,
    /// Lower bound of the claim.
    pub at_least: Option<f64>,
    /// Upper bound of the claim.
    pub at_most: Option<f64>,
    /// Explanation of the answer.
    #[serde(default)]
    pub why: String,
}

/// A figure that the study does not contain.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the study has no figure `{id}`; choose from {known}")]
pub struct UnknownFigure {
    id: String,
    known: String,
}

impl StudyFile {
    /// An estimator by its name.
    pub fn estimator(&self, name: &str) -> Option<&Estimator> {
        self.estimators.iter().find(|estimator| estimator.name == name)
    }

    /// Keeps only the figures with these numbers, and the statements that use only such figures. If `ids`
    /// is empty, keeps everything.
    ///
    /// # Errors
    /// [`UnknownFigure`].
    pub fn keep_figures(&mut self, ids: &[String]) -> Result<(), UnknownFigure> {
        if ids.is_empty() {
            return Ok(());
        }
        if let Some(id) = ids.iter().find(|id| !self.figures.iter().any(|figure| figure.id == **id)) {
            let known = self.figures.iter().map(|figure| figure.id.as_str()).collect::<Vec<_>>().join(", ");
            return Err(UnknownFigure { id: id.clone(), known });
        }
        self.figures.retain(|figure| ids.contains(&figure.id));
        let is_kept = |choice: &CurveChoice| ids.contains(&choice.figure);
        self.statements
            .retain(|statement| is_kept(&statement.of) && statement.against.as_ref().is_none_or(is_kept));
        Ok(())
    }

    /// Names of the estimators of a series.
    pub fn estimators_of<'a>(&'a self, figure: &'a Figure, series: &'a FigureSeries) -> &'a [String] {
        series.estimators.as_deref().unwrap_or(&figure.estimators)
    }

    fn check_figure(&self, index: usize, figure: &Figure) -> Result<(), Violation> {
        for (number, series) in figure.series.iter().enumerate() {
            let key = |name: &str| format!("figures[{index}].series[{number}].{name}");
            let are_sizes = !series.x.is_empty() && series.x.iter().all(|x| x.is_finite());
            let problem = "no sizes, or one that is not a finite number";
            Violation::unless(are_sizes, key("x"), problem, "give finite numbers")?;
            for &x in &series.x {
                let conditions = Conditions::from_study(self, series, x).map_err(|error| {
                    let named = error.key();
                    let place = match (series.vary.contains_key(named), series.with.contains_key(named)) {
                        (true, _) => key(&format!("vary.{named}")),
                        (_, true) => key(&format!("with.{named}")),
                        _ => named.to_owned(),
                    };
                    Violation::new(place, error.to_string(), "correct the key or the number")
                })?;
                let one_path = self.path.planned.is_some() || self.path.log.is_some();
                Violation::unless(
                    conditions.stations <= 1 || (self.second_base_m.is_some() && !one_path),
                    key("with"),
                    "stations = 2 needs another place and another path",
                    "give second_base_m, and random paths",
                )?;
            }
            for name in self.estimators_of(figure, series) {
                Violation::unless(
                    self.estimator(name).is_some(),
                    key("estimators"),
                    format!("no estimator is called `{name}`"),
                    "give the name of one of [[estimators]]",
                )?;
            }
        }
        Ok(())
    }

    fn check_choice(&self, key: &str, choice: &CurveChoice) -> Result<(), Violation> {
        let has_curve = |figure: &Figure| {
            let named =
                |series: &&FigureSeries| choice.series.as_ref().is_none_or(|name| *name == series.name);
            let mut series = figure.series.iter().filter(named);
            figure.id == choice.figure
                && series.any(|series| self.estimators_of(figure, series).contains(&choice.estimator))
        };
        let problem =
            format!("no series of figure `{}` is estimated by `{}`", choice.figure, choice.estimator);
        let remedy = "name a figure, one of its series and one of its estimators";
        Violation::unless(self.figures.iter().any(has_curve), key, problem, remedy)
    }
}

impl Validate for StudyFile {
    fn validate(&self) -> Result<(), Violation> {
        Violation::unless(self.seeds > 0, "seeds", "0", "give at least 1")?;
        for (key, value) in [("duration_s", self.duration_s), ("limit_mm_mrad", self.limit_mm_mrad)] {
            let is_positive = value.is_finite() && value > 0.0;
            Violation::unless(is_positive, key, value.to_string(), "give a number above zero")?;
        }
        let PathChoice { seed, planned, log } = &self.path;
        let has_path = planned.is_some() || log.is_some();
        let problem = format!("{} s is too short for a random path", self.duration_s);
        let remedy = format!("give at least {DURATION_S_MIN}");
        Violation::unless(has_path || self.duration_s >= DURATION_S_MIN, "duration_s", problem, remedy)?;
        let paths = [seed.is_some(), planned.is_some(), log.is_some()].map(usize::from).iter().sum::<usize>();
        Violation::unless(paths <= 1, "path", "more than one path", "give `seed`, `planned` or `log`")?;
        for (at, estimator) in self.estimators.iter().enumerate() {
            estimator.config.validate().map_err(|violation| Violation {
                key: format!("estimators[{at}].config.{}", violation.key),
                ..violation
            })?;
            let is_wire = estimator.instrument == StudyInstrument::Wire;
            let key = |name: &str| format!("estimators[{at}].{name}");
            let problem = "a draw-wire is calibrated with its defaults";
            let is_usual = !is_wire || estimator.config == IdentifyConfig::default();
            Violation::unless(is_usual, key("config"), problem, "leave it out")?;
            let is_new = self.estimators.iter().take(at).all(|other| other.name != estimator.name);
            let problem = format!("`{}` is there already", estimator.name);
            Violation::unless(is_new, key("name"), problem, "give each its own name")?;
        }
        for (at, figure) in self.figures.iter().enumerate() {
            let is_new = self.figures.iter().take(at).all(|other| other.id != figure.id);
            let problem = format!("`{}` is there already", figure.id);
            Violation::unless(is_new, format!("figures[{at}].id"), problem, "give each its own number")?;
            self.check_figure(at, figure)?;
        }
        for (at, statement) in self.statements.iter().enumerate() {
            self.check_choice(&format!("statements[{at}].of"), &statement.of)?;
            if let Some(against) = &statement.against {
                self.check_choice(&format!("statements[{at}].against"), against)?;
            }
            Violation::unless(
                !statement.reaches_limit || statement.against.is_none(),
                format!("statements[{at}]"),
                "two curves have no common size at which they reach the limit",
                "leave out `against`, or `reaches_limit`",
            )?;
        }
        Ok(())
    }
}
