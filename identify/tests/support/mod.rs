//! Shared by the tests: configurations of the repository, an independent kinematics, the reference set-up.
#![allow(dead_code, reason = "each test file uses its part")]
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test stops at the first surprise")]

pub mod independent;

use std::path::{Path, PathBuf};

use shared::config::{self, BallBarConfig, RobotConfig};

pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

pub fn irb2400() -> RobotConfig {
    config::load(&repository("config/robots/irb2400_16.toml")).unwrap()
}

pub fn nj220() -> RobotConfig {
    config::load(&repository("config/robots/nj220_2_7.toml")).unwrap()
}

pub fn bar() -> BallBarConfig {
    config::load(&repository("config/ball_bar.toml")).unwrap()
}
