//! Uncertainty budget of positions, as in the GUM (JCGM 100:2008). Each source of the covariance (samples, priors,
//! considered parameters) is propagated to random postures and becomes one contribution. The report shows the budget; its
//! value after "known within" is the expanded uncertainty.

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use crate::calibrate::Calibration;
use crate::instrument::Run;
use crate::model::{Column, Group, Model, ParameterId, Role};
use crate::solver::UncertaintySource;

/// Type of evaluation of a contribution, A or B (GUM 3.3.4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Evaluation {
    /// Type A: estimated from the scatter of samples.
    #[serde(rename = "A")]
    Statistical,
    /// Type B: a specified uncertainty.
    #[serde(rename = "B")]
    Stated,
}

/// One contribution to the uncertainty.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Contribution {
    /// Name of the source, as text for the report.
    pub source: String,
    /// Type of evaluation: A or B.
    pub evaluation: Evaluation,
    /// Standard uncertainty of a position, root mean square over the workspace \[m\].
    pub u_m: f64,
}

/// All contributions to the uncertainty of a position. The contributions are independent of each other.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Budget {
    /// Combined standard uncertainty, root mean square over the workspace \[m\].
    pub u_m: f64,
    /// Effective degrees of freedom of `u_m` (Welch and Satterthwaite); absent if practically infinite.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub freedom: Option<f64>,
    /// Coverage factor of the expanded uncertainty.
    pub coverage_factor: f64,
    /// Expanded uncertainty: coverage factor times `u_m` \[m\].
    pub expanded_m: f64,
    /// The contributions, largest first.
    pub contributions: Vec<Contribution>,
    /// Displacement of positions if the bar's offset plate is longer than specified, per metre of this length error; root
    /// mean square over the workspace. It is the derivative of the solution with respect to the length. Absent if there is
    /// no plate or if its length is treated as exact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moved_by_plate: Option<f64>,
}

/// Coverage factor. It covers 95 % of normal errors along an axis, and more than 95 % of distances in space.
const K: f64 = 2.0;

impl Budget {
    /// Computes the budget. `moved_m` has one column for each source: the displacement of the robot's end for an error of
    /// one standard deviation in this source. It has three rows for each posture.
    pub(in crate::evaluate) fn new(calibration: &Calibration, moved_m: &DMatrix<f64>) -> Self {
        let (model, covariance) = (calibration.model(), &calibration.solution().covariance);
        let postures = moved_m.nrows() as f64 / 3.0;
        let mut contributions: Vec<Contribution> = Vec::new();
        let (mut moved_by_plate, plate) = (None, ParameterId::plate(model.axes()));
        for (source, moved_m) in covariance.spread().sources.iter().zip(moved_m.column_iter()) {
            let (name, u_m) = (source_name(*source, calibration), moved_m.norm() / postures.sqrt());
            if let UncertaintySource::Prior { column } | UncertaintySource::Considered { column } = *source
                && calibration.solved.covariance_columns[column] == (Column { id: plate, data_set: 0 })
            {
                moved_by_plate = stated_sigma(model, plate).map(|sigma| u_m / sigma);
            }
            match contributions.iter_mut().find(|contribution| contribution.source == name) {
                Some(same) => same.u_m = same.u_m.hypot(u_m),
                None => {
                    let statistical = source.is_statistical();
                    let evaluation = if statistical { Evaluation::Statistical } else { Evaluation::Stated };
                    contributions.push(Contribution { source: name, evaluation, u_m });
                }
            }
        }
        contributions.sort_by(|a, b| b.u_m.total_cmp(&a.u_m));
        let sum_of_squares = |is_wanted: &dyn Fn(&Contribution) -> bool| -> f64 {
            contributions.iter().filter(|one| is_wanted(one)).map(|one| one.u_m.powi(2)).sum()
        };
        let statistical = sum_of_squares(&|one| one.evaluation == Evaluation::Statistical);
        let variance = sum_of_squares(&|_| true);
        let freedom = covariance.sigmas_from.freedom().filter(|_| statistical > 0.0);
        Self {
            u_m: variance.sqrt(),
            freedom: freedom.map(|freedom| freedom * (variance / statistical).powi(2)),
            coverage_factor: K,
            expanded_m: K * variance.sqrt(),
            contributions,
            moved_by_plate,
        }
    }

    /// Fraction of the variance due to a contribution, 0 to 1.
    pub fn part(&self, of: &Contribution) -> f64 {
        if self.u_m > 0.0 { (of.u_m / self.u_m).powi(2) } else { 0.0 }
    }
}

/// Specified standard deviation of a parameter, SI. `None` if the parameter is free or fixed.
fn stated_sigma(model: &Model, id: ParameterId) -> Option<f64> {
    match model.role(id)? {
        Role::Prior { sigma, .. } | Role::Considered { sigma } => Some(sigma),
        Role::Free | Role::Fixed => None,
    }
}

/// Name of a source for the report. Measured lengths and fixed parameters have individual names; other sources
/// are named by type.
fn source_name(source: UncertaintySource, calibration: &Calibration) -> String {
    let (column, how) = match source {
        UncertaintySource::Together => return "errors of the samples, with all priors".into(),
        UncertaintySource::Samples { data_set } => {
            return format!("errors of the samples of data set {}", data_set + 1);
        }
        UncertaintySource::Known => return "stated geometry of sockets or faces".into(),
        UncertaintySource::LeftOut => {
            return "error terms that the samples neither confirm nor exclude".into();
        }
        UncertaintySource::OtherScale => return "common scale error of the robot's lengths".into(),
        UncertaintySource::Contradicted { column } => {
            let name = calibration.solved.covariance_columns[column];
            return format!("{name}, whose prior the data contradict");
        }
        UncertaintySource::Prior { column } => (column, "estimated with a prior"),
        UncertaintySource::Considered { column } => (column, "fixed"),
    };
    let name = calibration.solved.covariance_columns[column];
    let (id, Run { instrument, model }) = (name.id, &calibration.runs[name.data_set]);
    let sigma = stated_sigma(model, id);
    let is_known_length = ParameterId::known_lengths(model.axes()).contains(&id);
    let is_fixed = matches!(source, UncertaintySource::Considered { .. });
    match (id.group(), sigma) {
        (_, Some(sigma)) if is_known_length => {
            let what =
                if id == ParameterId::ROD { "length of the rod" } else { "length of the offset plate" };
            format!("{what} ({name}), stated within {}", id.unit().display(sigma))
        }
        (Group::Scale, Some(sigma)) => {
            format!("scale of the {} ({name}), stated within {}", instrument.name(), id.unit().display(sigma))
        }
        (_, Some(sigma)) if is_fixed => {
            format!("{name}, fixed with an uncertainty of {}", id.unit().display(sigma))
        }
        (Group::Term(group), _) => format!("prior of error terms ({})", group.name()),
        (Group::Link, _) => "tolerance of the links".into(),
        _ => match id {
            ParameterId::EncoderOffset { .. } => "offsets of encoders that lost their origin".into(),
            ParameterId::Probe { .. } => "mounting of the probe".into(),
            ParameterId::Ball { .. } => "mounting of the ball".into(),
            _ => format!("{name}, {how}"),
        },
    }
}
