//! Files about the identified robot for other programs, beside a calibration.

use std::path::{Path, PathBuf};

use shared::config::{BallBarConfig, RobotConfig};

use super::corrections::{corrections, csv};
use super::file::{CalibrationFile, FileError, replace};
use super::urdf::urdf;
use crate::kinematics::{Chain, LinkParameter, flange_chain, robot_chain};
use crate::logs::LogError;
use crate::model::ParameterId;

/// Why there is no such file.
#[derive(Debug, thiserror::Error)]
pub enum RobotFileError {
    /// The robot's log cannot be converted.
    #[error(transparent)]
    Conversion(#[from] LogError),
    /// It cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
}

impl CalibrationFile {
    /// The identified robot, to the frame where the calibration's last link ends: the flange, or the end of the ball-bar.
    pub fn robot_chain(&self, robot: &RobotConfig, bar: Option<&BallBarConfig>) -> Chain {
        let mut chain = bar.map_or_else(|| flange_chain(robot), |bar| robot_chain(robot, bar));
        for entry in &self.parameters {
            let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
            let Some(link) = chain.links.get_mut(link) else { continue };
            *match parameter {
                LinkParameter::A => &mut link.a_m,
                LinkParameter::D => &mut link.d_m,
                LinkParameter::Alpha => &mut link.alpha_rad,
                LinkParameter::Theta => &mut link.theta_rad,
                LinkParameter::Beta => &mut link.beta_rad,
            } = entry.value;
        }
        chain
    }

    /// Writes `robot.urdf` and `corrections.csv` into the directory, each whole or not at all. Returns their
    /// paths.
    ///
    /// # Errors
    /// [`RobotFileError`].
    pub fn write_robot(
        &self,
        robot: &RobotConfig,
        bar: Option<&BallBarConfig>,
        directory: &Path,
    ) -> Result<[PathBuf; 2], RobotFileError> {
        let table = csv(&corrections(self, robot)?).map_err(FileError::from)?;
        let urdf = replace(directory, "robot.urdf", &urdf(robot, &self.robot_chain(robot, bar), bar))?;
        Ok([urdf, replace(directory, "corrections.csv", &table)?])
    }
}
