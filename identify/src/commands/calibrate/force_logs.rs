//! Forces on the bar from files of their own.

use std::path::PathBuf;

use shared::config::{self, RobotConfig};

use super::bar::BarArguments;
use crate::logs::{ForceLog, ForceLogMapping};

/// The force of each recording, where there is a file of it.
pub(super) fn force_logs(
    arguments: &BarArguments,
    robot: &RobotConfig,
) -> anyhow::Result<Vec<Option<ForceLog>>> {
    let BarArguments { recording, force_log, force_mapping, .. } = arguments;
    if force_log.is_empty() {
        return Ok(vec![None; recording.len()]);
    }
    anyhow::ensure!(
        force_log.len() == recording.len(),
        "{} recordings and {} force logs; give one --force-log for each --recording, in the same order, or none",
        recording.len(),
        force_log.len()
    );
    let mapping: Option<ForceLogMapping> = force_mapping.as_deref().map(config::load).transpose()?;
    let read = |path: &PathBuf| Ok(Some(ForceLog::load(path, robot, mapping.as_ref())?));
    force_log.iter().map(read).collect()
}
