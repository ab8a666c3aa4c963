//! `config/identify.toml`: what to minimise, what is free, and the limits of the preparation.

use serde::{Deserialize, Serialize};
use shared::config::{Validate, Violation};

use crate::kinematics::BAR_JOINTS;
use crate::model::{ParameterId, Selection};
use crate::prepare::PrepareOptions;

/// Cost functions that need a ball-bar.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum CostName {
    /// All entries of robot minus bar (thesis eq. 2.4); five encoders.
    Transform,
    /// Position and two angles of the cardan (thesis eq. 2.3); encoders 1, 2, 4 and 5.
    PositionAngles,
    /// Position (thesis eq. 2.2); encoders 1 and 2.
    Position,
    /// Distance from the bar's base against its length (thesis eq. 2.1); no encoder.
    Length,
}

impl CostName {
    /// The best cost that these encoders allow.
    pub fn for_encoders(measured: &[bool; BAR_JOINTS]) -> Self {
        match measured {
            [true, true, true, true, true] => Self::Transform,
            [true, true, _, true, true] => Self::PositionAngles,
            [true, true, ..] => Self::Position,
            _ => Self::Length,
        }
    }

    /// Name in files and reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Transform => "transform",
            Self::PositionAngles => "position_angles",
            Self::Position => "position",
            Self::Length => "length",
        }
    }
}

/// Named sets of free parameters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum SelectionName {
    /// The thesis' 38 and the clocks.
    Thesis,
    /// And two rotations of the bar's base, which no real cell has at zero.
    #[default]
    Cell,
}

impl From<SelectionName> for Selection {
    fn from(name: SelectionName) -> Self {
        match name {
            SelectionName::Thesis => Self::ThesisWithClocks,
            SelectionName::Cell => Self::CellWithClocks,
        }
    }
}

/// How to calibrate.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IdentifyConfig {
    /// Cost; absent: the best that the encoders allow.
    pub cost: Option<CostName>,
    /// Free parameters.
    pub selection: SelectionName,
    /// Parameters freed on top of the selection.
    pub free: Vec<String>,
    /// Parameters fixed all the same.
    pub fix: Vec<String>,
    /// Limits of the preparation.
    pub prepare: PrepareOptions,
}

impl Validate for IdentifyConfig {
    fn validate(&self) -> Result<(), Violation> {
        for (key, names) in [("free", &self.free), ("fix", &self.fix)] {
            for (index, name) in names.iter().enumerate() {
                name.parse::<ParameterId>().map_err(|error| {
                    Violation::new(format!("{key}[{index}]"), error.to_string(), "correct the name")
                })?;
            }
        }
        Ok(())
    }
}
