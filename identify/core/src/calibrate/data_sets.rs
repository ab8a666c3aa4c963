//! The input of a joint calibration: all measurements on one robot ([`DataSets`]). The preparation aligns the logs of each
//! ball-bar run ([`RunInput`]), which gives a [`BarRun`]. Files of rows from other instruments need no preparation here.

use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::config::IdentifyConfig;
use super::error::CalibrateError;
use crate::instrument::Rows;
use crate::logs::{RobotLog, Unwrapped};
use crate::prepare::{PrepareOptions, Prepared, prepare};

/// Data sets of one robot for a joint calibration.
#[derive(Debug, Clone, Default)]
pub struct DataSets<'a> {
    /// Runs with the ball-bar.
    pub bars: Vec<BarRun<'a>>,
    /// Files of rows from other instruments.
    pub rows: Vec<Rows>,
}

/// A ball-bar run after preparation: its logs are aligned.
#[derive(Debug, Clone)]
pub struct BarRun<'a> {
    /// Samples, motion of the robot, and initial estimate of the bar's pose.
    pub prepared: Prepared,
    /// The bar of this run. The bars of different runs may differ in length.
    pub bar: &'a BallBarConfig,
}

/// Input of one ball-bar run, before the preparation.
#[derive(Debug, Clone, Copy)]
pub struct RunInput<'a> {
    /// Cycle records of the recording.
    pub cycles: &'a [CycleRecord],
    /// Encoders of the recording, in the order of the recording.
    pub encoders: &'a [EncoderInfo],
    /// Encoders whose readings wrapped around and were unwrapped when the file of another program was read. The cycle
    /// records do not show the wraps. `None` for a recording of the daemon.
    pub unwrapped: Option<&'a [Unwrapped]>,
    /// The robot's own log.
    pub log: &'a RobotLog,
    /// The bar of this run.
    pub bar: &'a BallBarConfig,
}

impl<'a> RunInput<'a> {
    /// Prepares each run, that is, aligns its logs.
    ///
    /// # Errors
    /// [`CalibrateError::Prepare`] with the index of the run.
    pub fn prepare_all(
        inputs: &[Self],
        robot: &RobotConfig,
        options: &PrepareOptions,
    ) -> Result<Vec<BarRun<'a>>, CalibrateError> {
        let prepare_one = |(run, input): (usize, &Self)| {
            let mut prepared = prepare(input.cycles, input.encoders, input.log, robot, input.bar, options)
                .map_err(|error| CalibrateError::Prepare { run, error: Box::new(error) })?;
            if let Some(unwrapped) = input.unwrapped {
                prepared.timeline.unwrapped_encoders = unwrapped.to_vec();
            }
            Ok(BarRun { prepared, bar: input.bar })
        };
        inputs.iter().enumerate().map(prepare_one).collect()
    }
}

impl DataSets<'_> {
    /// Checks that there are data, and that each option which differs from its default has an effect on them.
    ///
    /// # Errors
    /// [`CalibrateError::NoRun`] if there are no data. [`CalibrateError::Selection`] if there are files of rows, but the
    /// selection is only for studies. [`CalibrateError::NoEffect`] if an option has no effect.
    pub(super) fn check(&self, config: &IdentifyConfig) -> Result<(), CalibrateError> {
        if self.rows.is_empty() {
            return if self.bars.is_empty() { Err(CalibrateError::NoRun) } else { Ok(()) };
        }
        config.require_usual_selection()?;
        if !self.bars.is_empty() {
            return Ok(());
        }
        // There are no ball-bar runs, so options that only affect such runs must have their defaults. The preparation also
        // affects rows that are aligned with a robot log.
        let default = IdentifyConfig::default();
        let (terms, default_terms) = (&config.joint_terms, &default.joint_terms);
        let has_robot_log = self.rows.iter().any(|rows| rows.instrument.first_s().is_some());
        let options_of_bars = [
            ("cost", config.cost != default.cost),
            ("encoder_harmonics_urad", config.encoder_harmonics_urad != default.encoder_harmonics_urad),
            ("bar_length_um", config.bar_length_um != default.bar_length_um),
            ("joint_terms.amplitude_urad", terms.amplitude_urad != default_terms.amplitude_urad),
            ("joint_terms.ratio_ppm", terms.ratio_ppm != default_terms.ratio_ppm),
            ("joint_terms.delay_ms", terms.delay_ms != default_terms.delay_ms),
            (
                "joint_terms.compliance_urad_per_m",
                terms.compliance_urad_per_m != default_terms.compliance_urad_per_m,
            ),
            ("noise", config.noise != default.noise),
            ("prepare", config.prepare != default.prepare && !has_robot_log),
        ];
        match options_of_bars.into_iter().find(|(_, is_given)| *is_given) {
            Some((option, _)) => Err(CalibrateError::NoEffect { option }),
            None => Ok(()),
        }
    }
}
