//! A study with all its inputs: study file, robot, bar and path. The definition is stored with the results. Results from
//! several machines can therefore be checked and merged without the original files.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use shared::config::{self, BallBarConfig, ConfigError, JointKind, Kind, RobotConfig, Source};

use super::{Driven, PathChoice, Reference, ReferenceError, StudyFile};
use crate::logs::{self, LogError};

/// Name of the built-in study of chapter 3 of the thesis.
pub const THESIS: &str = "thesis";

/// Why a study cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// A file of the study cannot be loaded.
    #[error(transparent)]
    File(#[from] ConfigError),
    /// The robot's log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The robot is not an arm of six revolute axes. Studies cannot simulate other arms.
    #[error(
        "{robot} is not an arm of six revolute axes, which studies simulate; name another file as `robot`"
    )]
    Arm {
        /// Name of the robot.
        robot: String,
    },
    /// The robot's log contains no path on a sphere, or the bar's inverse kinematics fails on this path.
    #[error(transparent)]
    Reference(#[from] ReferenceError),
}

/// A study with its robot, bar and path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Definition {
    /// Contents of the study's file.
    pub study: StudyFile,
    /// Configuration of the nominal robot.
    pub robot: RobotConfig,
    /// Configuration of the nominal bar.
    pub bar: BallBarConfig,
    /// Path of the experiments.
    pub reference: Reference,
    /// Version of the program. Results of different versions are not merged.
    pub software: String,
}

impl Definition {
    /// Loads the built-in study [`THESIS`], or a study from a file.
    ///
    /// # Errors
    /// [`LoadError`].
    pub fn load(study: &str) -> Result<Self, LoadError> {
        if study == THESIS {
            let file = |name: &str| PathBuf::from(format!("config/{name}"));
            let study: StudyFile = config::parse(
                include_str!("../../../../config/studies/thesis.toml"),
                &file("studies/thesis.toml"),
            )?;
            let robot = config::parse(Kind::Robot.built_in("irb2400_16"), &file("robots/irb2400_16.toml"))?;
            let bar = config::parse(Kind::BallBar.built_in("ball_bar"), &file("ball_bar.toml"))?;
            return Ok(Self::new(study, robot, bar, Reference::Random));
        }
        let path = Path::new(study);
        let beside = |file: &Path| Source::beside(path.parent().unwrap_or(Path::new("")), file);
        let study: StudyFile = config::load(path)?;
        let robot: RobotConfig = config::load(&beside(&study.robot))?;
        let bar: BallBarConfig = config::load(&beside(&study.bar))?;
        if robot.joint_kinds().ne([JointKind::Revolute; 6]) {
            return Err(LoadError::Arm { robot: robot.name });
        }
        let reference = match &study.path {
            PathChoice { seed: Some(seed), .. } => Reference::Same(*seed),
            PathChoice { planned: Some(file), .. } => Reference::Planned(config::load(&beside(file))?),
            PathChoice { log: Some(file), .. } => {
                Reference::Driven(Driven::from_bytes(&logs::load(&beside(file), &robot)?, &robot, &bar)?)
            }
            PathChoice { .. } => Reference::Random,
        };
        Ok(Self::new(study, robot, bar, reference))
    }

    fn new(study: StudyFile, robot: RobotConfig, bar: BallBarConfig, reference: Reference) -> Self {
        Self { study, robot, bar, reference, software: shared::version::software("identify") }
    }

    /// SHA-256 checksum of the definition, hexadecimal. Results with equal checksums can be merged.
    ///
    /// # Errors
    /// An error if the definition cannot be written as JSON.
    pub fn sha256(&self) -> Result<String, serde_json::Error> {
        let sum = Sha256::digest(serde_json::to_vec(self)?);
        Ok(sum.iter().map(|byte| format!("{byte:02x}")).collect())
    }
}
