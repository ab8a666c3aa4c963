//! Files about the identified robot for other programs, beside a calibration.

use std::path::{Path, PathBuf};

use shared::config::{BallBarConfig, RobotConfig};

use super::corrections::{corrections, csv};
use super::file::{CalibrationFile, FileError, replace};
use super::urdf::urdf;
use crate::calibrate::validation::deployment::Deployment;
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

    /// Writes what a controller can take, as far as it predicts held-out data better than the nominal robot: `robot.urdf` and
    /// `corrections.csv` for links without errors of joints, `offsets.csv` for joint offsets alone where these have a fit of
    /// their own. Each is written whole or not at all. Returns their paths.
    ///
    /// # Errors
    /// [`RobotFileError`].
    pub fn write_robot(
        &self,
        robot: &RobotConfig,
        bar: Option<&BallBarConfig>,
        directory: &Path,
    ) -> Result<Vec<PathBuf>, RobotFileError> {
        let table = |of| {
            let text = csv(&corrections(self, robot, of)?).map_err(FileError::from)?;
            Ok::<String, RobotFileError>(text)
        };
        let mut written = Vec::new();
        if self.serves(Deployment::Dh) {
            let links = self.deployed(Deployment::Dh).robot_chain(robot, bar);
            let about = self.held_out_m(Deployment::Dh).map_or_else(String::new, |[nominal_m, own_m]| {
                format!(
                    " Links alone, without errors of joints: held-out positions {:.4} mm RMS, nominal {:.4}.",
                    own_m * 1e3,
                    nominal_m * 1e3
                )
            });
            written.push(replace(directory, "robot.urdf", &urdf(robot, &links, bar, &about))?);
            written.push(replace(directory, "corrections.csv", &table(Deployment::Dh)?)?);
        }
        if self.serves(Deployment::Offsets) {
            written.push(replace(directory, "offsets.csv", &table(Deployment::Offsets)?)?);
        }
        Ok(written)
    }
}
