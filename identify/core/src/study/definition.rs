//! A study with all that it needs: what is written beside its results, so that they can be put together anywhere.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use shared::config::{self, BallBarConfig, ConfigError, Kind, RobotConfig, Source};

use super::{Driven, PathChoice, Reference, ReferenceError, StudyFile};
use crate::logs::{self, LogError};
use crate::simulate::Experiment;

/// The word for the shipped study of the thesis' chapter 3.
pub const THESIS: &str = "thesis";

/// Why a study cannot begin.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// A file of it.
    #[error(transparent)]
    File(#[from] ConfigError),
    /// The robot's log.
    #[error(transparent)]
    Log(#[from] LogError),
    /// Neither the bar nor a wire is simulated with such an arm.
    #[error(
        "{robot} is not an arm of six revolute axes, which studies simulate; name another file as `robot`"
    )]
    Arm {
        /// The robot's name.
        robot: String,
    },
    /// The robot's log has no path on a sphere.
    #[error(transparent)]
    Reference(#[from] ReferenceError),
}

/// A study with its robot, bar and path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Definition {
    /// The study's file.
    pub study: StudyFile,
    /// The robot, nominal.
    pub robot: RobotConfig,
    /// The bar, nominal.
    pub bar: BallBarConfig,
    /// The path that is driven.
    pub reference: Reference,
    /// Who computes: numbers of other versions do not belong with these.
    pub software: String,
}

impl Definition {
    /// The shipped study [`THESIS`], or that of a file.
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
        Experiment::new(&robot, &bar).check().map_err(|_| LoadError::Arm { robot: robot.name.clone() })?;
        let reference = match &study.path {
            PathChoice { seed: Some(seed), .. } => Reference::Same(*seed),
            PathChoice { planned: Some(file), .. } => Reference::Planned(config::load(&beside(file))?),
            PathChoice { log: Some(file), .. } => {
                Reference::Driven(Driven::of(&logs::load(&beside(file), &robot)?, &robot, &bar)?)
            }
            PathChoice { .. } => Reference::Random,
        };
        Ok(Self::new(study, robot, bar, reference))
    }

    fn new(study: StudyFile, robot: RobotConfig, bar: BallBarConfig, reference: Reference) -> Self {
        Self { study, robot, bar, reference, software: shared::version::software("identify") }
    }

    /// Checksum of all of it, hexadecimal: results of equal ones belong together.
    ///
    /// # Errors
    /// A number that does not fit JSON.
    pub fn sha256(&self) -> Result<String, serde_json::Error> {
        let sum = Sha256::digest(serde_json::to_vec(self)?);
        Ok(sum.iter().map(|byte| format!("{byte:02x}")).collect())
    }
}
