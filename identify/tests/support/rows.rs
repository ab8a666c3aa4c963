//! Calibrates a single file of rows.

use identify::calibrate::rows::{RowSet, Stages};
use identify::calibrate::{
    CalibrateError, Calibration, DataSets, IdentifyConfig, JointTermsConfig, calibrate,
};
use identify::instrument::{HoldOut, Instrument, Rows, Tracker, Wire};
use identify::logs::{LengthRow, PoseRow};
use identify::model::{Model, ParameterId};
use shared::config::RobotConfig;

/// Configuration of the calibration of a single file of rows.
#[derive(Clone, Default)]
pub struct Alone {
    pub hold_out: Option<HoldOut>,
    pub seed: Option<u64>,
    pub joint_waves: Option<u8>,
    pub config: IdentifyConfig,
}

/// Result of the calibration of a single file of rows.
pub struct Found(pub Calibration);

impl Alone {
    /// A quick calibration: it holds out single rows, and its joint errors have few harmonics.
    pub fn quick() -> Self {
        Self { hold_out: Some(HoldOut::Rows), joint_waves: Some(20), ..Self::default() }
    }

    /// Estimates only the parameters of the links.
    pub fn without_joint_errors(mut self) -> Self {
        self.config.joint_terms = JointTermsConfig { candidates: Vec::new(), ..self.config.joint_terms };
        self
    }

    pub fn with_fixed(mut self, ids: &[ParameterId]) -> Self {
        self.config.fix = ids.to_vec();
        self
    }

    pub fn poses(&self, rows: &[PoseRow], robot: &RobotConfig) -> Result<Found, CalibrateError> {
        self.calibrated(Tracker::new(rows).into(), robot)
    }

    pub fn lengths(&self, rows: &[LengthRow], robot: &RobotConfig) -> Result<Found, CalibrateError> {
        self.calibrated(Wire::new(rows).into(), robot)
    }

    fn calibrated(&self, instrument: Instrument, robot: &RobotConfig) -> Result<Found, CalibrateError> {
        let Self { hold_out, seed, joint_waves, ref config } = *self;
        let rows = vec![Rows { instrument, hold_out, seed, joint_waves }];
        calibrate(&DataSets { rows, ..DataSets::default() }, robot, config, None).map(Found)
    }
}

impl Found {
    pub fn rows(&self) -> &RowSet {
        &self.0.rows[0]
    }

    pub fn model(&self) -> &Model {
        &self.0.runs[0].model
    }

    pub fn held_out(&self) -> Stages {
        self.rows().held_out()
    }

    pub fn fitted(&self) -> Stages {
        self.rows().fitted()
    }

    pub fn sigma(&self, id: ParameterId) -> Option<f64> {
        self.0.sigma(id)
    }

    /// The table that the command prints.
    pub fn table(&self) -> String {
        let run = &self.0.runs[0];
        identify::report::rows::table(self.rows(), run, &[], &[], &[])
    }
}
