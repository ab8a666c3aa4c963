//! What makes positions uncertain, contribution by contribution, in the manner of the GUM (JCGM 100:2008).

use serde::{Deserialize, Serialize};

use super::workspace::{POSTURES, Postures};
use crate::model::{Group, Model, ParameterId, Role};
use crate::solver::{Covariance, Source};

/// How a contribution is evaluated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Evaluation {
    /// From the scatter of samples.
    #[serde(rename = "A")]
    Statistical,
    /// From what somebody states.
    #[serde(rename = "B")]
    Stated,
}

/// One contribution.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Contribution {
    /// For a person.
    pub source: String,
    /// How it is evaluated.
    pub evaluation: Evaluation,
    /// Standard uncertainty of a position, root mean square over the workspace \[m\].
    pub u_m: f64,
}

/// All contributions to the uncertainty of a position, which are independent of each other.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Budget {
    /// Combined standard uncertainty, root mean square over the workspace \[m\].
    pub u_m: f64,
    /// Its effective degrees of freedom (Welch and Satterthwaite); absent where it is as good as known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub freedom: Option<f64>,
    /// Coverage factor of the expanded uncertainty.
    pub coverage_factor: f64,
    /// Expanded uncertainty \[m\].
    pub expanded_m: f64,
    /// The largest first.
    pub contributions: Vec<Contribution>,
    /// How far positions move, root mean square over the workspace, for each metre by which the bar's offset plate is longer than
    /// stated: the derivative of the solution. Absent without a plate, or where it is taken as exact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moved_by_plate: Option<f64>,
}

/// Coverage factor: 95 % of normal errors along an axis, and more of a distance in space.
const K: f64 = 2.0;

impl Budget {
    /// `columns` are those of the covariance that the postures are derived by.
    pub(in crate::evaluate) fn new(
        model: &Model,
        covariance: &Covariance,
        columns: &[(usize, ParameterId)],
        postures: &Postures,
    ) -> Self {
        let spread = covariance.spread();
        let moved_m =
            &postures.by_parameter * spread.by_source.select_rows(columns.iter().map(|(column, _)| column));
        let mut contributions: Vec<Contribution> = Vec::new();
        let (mut moved_by_plate, plate) = (None, ParameterId::plate(model.axes()));
        for (source, moved_m) in spread.sources.iter().zip(moved_m.column_iter()) {
            let (name, u_m) = (named(*source, model, covariance), moved_m.norm() / (POSTURES as f64).sqrt());
            if let Source::Prior { column } | Source::Considered { column } = *source
                && covariance.name(column) == plate.to_string()
            {
                moved_by_plate = stated_sigma(model, plate).map(|sigma| u_m / sigma);
            }
            match contributions.iter_mut().find(|one| one.source == name) {
                Some(one) => one.u_m = one.u_m.hypot(u_m),
                None => {
                    let statistical = source.is_statistical();
                    let evaluation = if statistical { Evaluation::Statistical } else { Evaluation::Stated };
                    contributions.push(Contribution { source: name, evaluation, u_m });
                }
            }
        }
        contributions.sort_by(|a, b| b.u_m.total_cmp(&a.u_m));
        let squared = |wanted: &dyn Fn(&Contribution) -> bool| -> f64 {
            contributions.iter().filter(|one| wanted(one)).map(|one| one.u_m.powi(2)).sum()
        };
        let statistical = squared(&|one| one.evaluation == Evaluation::Statistical);
        let variance = squared(&|_| true);
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

    /// Part of the variance that is a contribution's, 0 to 1.
    pub fn part(&self, of: &Contribution) -> f64 {
        if self.u_m > 0.0 { (of.u_m / self.u_m).powi(2) } else { 0.0 }
    }
}

/// Standard deviation that is stated of a parameter, SI.
fn stated_sigma(model: &Model, id: ParameterId) -> Option<f64> {
    match model.parameter(id)?.role {
        Role::Prior { sigma, .. } | Role::Considered { sigma } => Some(sigma),
        Role::Free | Role::Fixed => None,
    }
}

/// For a person: what is stated of one length by itself, of others by what they are.
fn named(source: Source, model: &Model, covariance: &Covariance) -> String {
    let (column, how) = match source {
        Source::Together => return "errors of the samples, with all priors".into(),
        Source::Samples { data_set } => return format!("errors of the samples of data set {}", data_set + 1),
        Source::Known => return "what is known of sockets or faces".into(),
        Source::LeftOut => return "errors of joints that the samples neither show nor exclude".into(),
        Source::Prior { column } => (column, "estimated, expected"),
        Source::Considered { column } => (column, "fixed"),
    };
    let name = covariance.name(column);
    let Some(id) = name.split('@').next().and_then(|name| name.parse::<ParameterId>().ok()) else {
        return name.to_owned();
    };
    let sigma = stated_sigma(model, id);
    let known = ParameterId::known_lengths(model.axes());
    let alone = matches!(source, Source::Considered { .. }) || known.contains(&id);
    match (id.group(), sigma) {
        (_, Some(sigma)) if known.contains(&id) => {
            let what =
                if id == ParameterId::ROD { "length of the rod" } else { "length of the offset plate" };
            format!("{what} ({name}), stated within {}", id.unit().display(sigma))
        }
        (_, Some(sigma)) if alone => {
            format!("{name}, {how} within {}", id.unit().display(sigma))
        }
        (Group::Term(group), _) => format!("what is expected of {}", group.name()),
        (Group::Link, _) => "tolerance of the links".into(),
        _ => match id {
            ParameterId::EncoderOffset { .. } => "offsets of encoders that lost their origin".into(),
            ParameterId::Probe { .. } => "mounting of the probe".into(),
            ParameterId::Ball { .. } => "mounting of the ball".into(),
            _ => format!("{name}, {how}"),
        },
    }
}
