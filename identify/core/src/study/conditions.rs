//! The conditions of one experiment: errors, noise, number of points, and encoders. They are computed from a series
//! in the study's file and a size `x`. Values in the section `with` are used unchanged; values in the section `vary`
//! are multiplied by `x`.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use super::{FigureSeries, StudyFile};
use crate::model::ParameterId;
use crate::simulate::{BarLoad, Effects, StaticErrors};

/// Keys of the conditions that are neither effects nor parameters, with their meanings.
pub const CONDITIONS: [(&str, &str); 9] = [
    ("points", "number of pairs of robot and bar angles"),
    ("encoders", "number of bar joints with an encoder: 5, 4 (not joint 3), 2 (joints 1 and 2) or 0"),
    ("stations", "number of positions of the bar: 1 or 2"),
    ("static_errors", "errors of the links; 1: table 3.1 of the thesis, 0: none"),
    ("time_difference_ms", "time by which the bar is sampled later than the robot"),
    ("encoder_bits", "resolution of the encoders: number of bits per turn"),
    ("wire_rows", "number of postures at which a draw-wire measures"),
    ("wire_noise_um", "standard deviation of the noise of the draw-wire's lengths"),
    ("bar_play_um", "elongation of the bar under tension, and shortening under compression"),
];

/// A condition that is not valid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConditionError {
    /// The key does not exist.
    #[error(
        "`{key}` is not a condition; there are {}, effects of `identify simulate` such as robot_noise_urad, and parameters such as \
         rd3 [mm|mrad]",
        CONDITIONS.map(|(key, _)| key).join(", ")
    )]
    Unknown {
        /// Key as given in the file.
        key: String,
    },
    /// A value outside the valid range.
    #[error("{key} = {value} is invalid; {expected}")]
    Value {
        /// Key as given in the file.
        key: String,
        /// Value as given in the file.
        value: f64,
        /// Valid values of this key.
        expected: &'static str,
    },
}

impl ConditionError {
    /// The key as given in the file.
    pub fn key(&self) -> &str {
        match self {
            Self::Unknown { key } | Self::Value { key, .. } => key,
        }
    }
}

/// The conditions of one experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Conditions {
    /// Number of pairs of robot and bar angles.
    pub points: usize,
    /// For each bar joint, whether it has an encoder.
    pub measured: [bool; 5],
    /// Number of stations (positions of the bar), 1 or 2. Each station has an equal number of points.
    pub stations: usize,
    /// Errors of the links of robot and bar.
    pub errors: StaticErrors,
    /// Additional errors of single parameters \[mm|mrad\].
    pub added_errors: BTreeMap<String, f64>,
    /// Effects on the measured angles, such as noise and harmonics.
    pub effects: Effects,
    /// The force along the bar and its effect on the bar's length.
    pub load: BarLoad,
    /// Number of postures that a draw-wire measures.
    pub wire_rows: usize,
    /// Standard deviation of the white noise of the draw-wire's lengths \[m\].
    pub wire_noise_m: f64,
    /// Time by which the bar is sampled later than the robot \[s\].
    pub time_difference_s: f64,
}

/// Smallest number of pairs in an experiment. Each pair has three rows, and about forty parameters are estimated.
const POINTS_MIN: f64 = 20.0;

impl Conditions {
    /// Computes the conditions of a series at size `x`.
    ///
    /// # Errors
    /// [`ConditionError`].
    pub fn from_study(study: &StudyFile, series: &FigureSeries, x: f64) -> Result<Self, ConditionError> {
        let mut conditions = Self {
            points: 0,
            measured: [true; 5],
            stations: 1,
            errors: StaticErrors::Thesis,
            added_errors: BTreeMap::new(),
            effects: Effects::NONE,
            load: BarLoad::default(),
            wire_rows: 200,
            wire_noise_m: 100e-6,
            time_difference_s: 0.0,
        };
        conditions.set("points", f64::from(study.points))?;
        for (key, &value) in &series.with {
            conditions.set(key, value)?;
        }
        for (key, by) in &series.vary {
            conditions.set(key, by * x)?;
        }
        Ok(conditions)
    }

    fn set(&mut self, key: &str, value: f64) -> Result<(), ConditionError> {
        let refuse = |expected| Err(ConditionError::Value { key: key.to_owned(), value, expected });
        if !value.is_finite() {
            return refuse("give a finite number");
        }
        let (valid, expected) = match key {
            "points" | "wire_rows" => (POINTS_MIN..=1e6, "give 20 to a million"),
            "stations" => (1.0..=2.0, "give 1 or 2"),
            "encoder_bits" => (1.0..=64.0, "give 1 to 64 bits for each turn"),
            "wire_noise_um" | "bar_play_um" => (0.0..=f64::MAX, "give no negative number"),
            _ => (f64::MIN..=f64::MAX, ""),
        };
        if !valid.contains(&value) || (key == "stations" && value.fract() != 0.0) {
            return refuse(expected);
        }
        match (key, value) {
            ("points", _) => self.points = value.round() as usize,
            ("encoders", 5.0) => self.measured = [true; 5],
            ("encoders", 4.0) => self.measured = [true, true, false, true, true],
            ("encoders", 2.0) => self.measured = [true, true, false, false, false],
            ("encoders", 0.0) => self.measured = [false; 5],
            ("encoders", _) => return refuse("give 5, 4 (all but that of joint 3), 2 (joints 1 and 2) or 0"),
            ("stations", _) => self.stations = value as usize,
            ("static_errors", 0.0) => self.errors = StaticErrors::None,
            ("static_errors", 1.0) => self.errors = StaticErrors::Thesis,
            ("static_errors", _) => return refuse("give 0 (none) or 1 (table 3.1 of the thesis)"),
            ("time_difference_ms", _) => self.time_difference_s = value * 1e-3,
            ("wire_rows", _) => self.wire_rows = value.round() as usize,
            ("wire_noise_um", _) => self.wire_noise_m = value * 1e-6,
            ("encoder_bits", _) => self.effects.encoder_step_urad = TAU / value.exp2() * 1e6,
            // The effect of play depends only on the sign of the force, so any force above zero can be used.
            ("bar_play_um", _) => self.load = BarLoad { force_n: 1.0, play_um: value, ..self.load },
            _ => return self.set_effect_or_parameter(key, value),
        }
        Ok(())
    }

    fn set_effect_or_parameter(&mut self, key: &str, value: f64) -> Result<(), ConditionError> {
        if let Some(size) = self.effects.size_mut(key) {
            if value < 0.0 {
                let expected = "give no negative number";
                return Err(ConditionError::Value { key: key.to_owned(), value, expected });
            }
            *size = value;
            return Ok(());
        }
        let is_geometry = |id: &ParameterId| {
            use ParameterId::{Bar, Base, Robot};
            matches!(id, Robot { .. } | Bar { .. } | Base { .. })
        };
        let unknown = || ConditionError::Unknown { key: key.to_owned() };
        let id = key.parse::<ParameterId>().ok().filter(is_geometry).ok_or_else(unknown)?;
        self.added_errors.insert(id.to_string(), value);
        Ok(())
    }
}
