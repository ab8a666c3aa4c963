//! Files about the identified robot for other programs, beside a calibration.

use std::path::{Path, PathBuf};

use shared::config::{BallBarConfig, JointKind, RobotConfig};

use super::corrections::{Correction, corrections, csv, log_corrections};
use super::file::{CalibrationFile, FileError, ParameterEntry, replace};
use super::urdf::urdf;
use crate::calibrate::validation::deployment::Deployment;
use crate::kinematics::{Chain, DhLink, LinkParameter, Pose, flange_chain, robot_chain};
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

const fn number_of(link: &mut DhLink, parameter: LinkParameter) -> &mut f64 {
    match parameter {
        LinkParameter::A => &mut link.a_m,
        LinkParameter::D => &mut link.d_m,
        LinkParameter::Alpha => &mut link.alpha_rad,
        LinkParameter::Theta => &mut link.theta_rad,
        LinkParameter::Beta => &mut link.beta_rad,
    }
}

impl CalibrationFile {
    /// The robot's links with one number of each parameter, standing at the root; joints are as the file says where it is supported.
    pub(crate) fn links(&self, number: impl Fn(&ParameterEntry) -> f64) -> Chain {
        let mut links: Vec<DhLink> = Vec::new();
        for entry in &self.parameters {
            let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
            let is_prismatic = self.validity.as_ref().is_some_and(|of| of.prismatic.contains(&link));
            let joint = if is_prismatic { JointKind::Prismatic } else { JointKind::Revolute };
            if links.len() <= link {
                links.resize_with(link + 1, DhLink::default);
            }
            links[link].joint = joint;
            *number_of(&mut links[link], parameter) = number(entry);
        }
        Chain::new(Pose::identity(), links)
    }

    /// The identified robot, to the frame where the calibration's last link ends: the flange, or the end of the ball-bar.
    pub fn robot_chain(&self, robot: &RobotConfig, bar: Option<&BallBarConfig>) -> Chain {
        let mut chain = bar.map_or_else(|| flange_chain(robot), |bar| robot_chain(robot, bar));
        for entry in &self.parameters {
            let Ok(ParameterId::Robot { link, parameter }) = entry.name.parse() else { continue };
            let Some(link) = chain.links.get_mut(link) else { continue };
            *number_of(link, parameter) = entry.value;
        }
        chain
    }

    /// Writes what a controller can take, as far as it predicts held-out data better than the nominal robot: `robot.urdf` and
    /// `corrections.csv` for links without errors of joints, `offsets.csv` for joint offsets alone where these have a fit of
    /// their own, and beside each its joints as the log has them. Each is written whole or not at all. Returns their paths.
    ///
    /// # Errors
    /// [`RobotFileError`].
    pub fn write_robot(
        &self,
        robot: &RobotConfig,
        bar: Option<&BallBarConfig>,
        directory: &Path,
    ) -> Result<Vec<PathBuf>, RobotFileError> {
        let mut written = Vec::new();
        let mut write = |name: &str, rows: &[Correction]| -> Result<(), RobotFileError> {
            written.push(replace(directory, name, &csv(rows).map_err(FileError::from)?)?);
            Ok(())
        };
        if self.serves(Deployment::Dh) {
            write("corrections.csv", &corrections(self, Deployment::Dh))?;
            write("corrections_log.csv", &log_corrections(self, robot, Deployment::Dh)?)?;
        }
        if self.serves(Deployment::Offsets) {
            write("offsets.csv", &corrections(self, Deployment::Offsets))?;
            write("offsets_log.csv", &log_corrections(self, robot, Deployment::Offsets)?)?;
        }
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
        }
        Ok(written)
    }
}
