//! Homing as the service does it: the steps in words, and the file at the end.

use std::path::Path;

use shared::config::{EncoderConfig, bar_joint_name};

use super::service::Settings;
use super::status::HomingStatus;
use crate::homing::{self, Found, HomingError, HomingStep};
use crate::run::{ActiveHoming, Session};

/// A homing, until the next one.
pub(super) struct Homing {
    active: ActiveHoming,
    status: HomingStatus,
}

impl Homing {
    /// Begins.
    pub fn begin(session: &Session) -> Self {
        Self { active: session.begin_homing(), status: HomingStatus::default() }
    }

    /// Asks it to end.
    pub fn stop(&self, cause: &str) {
        self.active.stop.stop(cause);
    }

    /// What people see of it.
    pub fn status(&self) -> &HomingStatus {
        &self.status
    }

    /// Takes what was told since the last look; whether it is over now. What was found is written then.
    pub fn look(&mut self, settings: &Settings) -> bool {
        look(&mut self.active, &mut self.status, &settings.bar.encoders, &settings.homing_file)
    }
}

/// Takes what `active` told since the last look into `status`; whether it has just ended, with its outcome in
/// `status` and, if it went well, in `file`.
pub fn look(
    active: &mut ActiveHoming,
    status: &mut HomingStatus,
    encoders: &[EncoderConfig],
    file: &Path,
) -> bool {
    while let Some(step) = active.take_step() {
        note(status, step);
    }
    let Some(outcome) = active.outcome() else { return false };
    status.is_over = true;
    (status.joint, status.turned_deg) = (None, None);
    match outcome.and_then(|found| keep(encoders, &found, file)) {
        Ok(()) => status.lines.push(format!(
            "{}: runs count angles from these marks until the terminals lose power; then home again",
            file.display()
        )),
        Err(error) => status.error = Some(error.to_string()),
    }
    true
}

fn keep(encoders: &[EncoderConfig], found: &[Found], file: &Path) -> Result<(), HomingError> {
    let marks = homing::verify(encoders, found)?;
    homing::file::write(file, encoders, &marks).map_err(|error| HomingError::Stopped(error.to_string()))
}

fn note(status: &mut HomingStatus, step: HomingStep) {
    match step {
        HomingStep::Turn { joint, .. } => {
            (status.joint, status.turned_deg) = (Some(joint), Some(0.0));
            status.lines.push(format!(
                "joint {joint} ({}): turn it slowly in its positive direction, alone, by 5 degrees or more and over its \
                 reference mark",
                bar_joint_name(joint)
            ));
        }
        HomingStep::Turning { turned_rad, .. } => status.turned_deg = Some(turned_rad.to_degrees()),
        HomingStep::Found(found) => {
            let Found { joint, encoder, counts_rise, reference_counts } = found;
            let way = if counts_rise { "up" } else { "down" };
            status.turned_deg = None;
            status.lines.push(format!(
                "joint {joint}: on terminal {}, counts {way}, mark at count {reference_counts}",
                encoder + 1
            ));
        }
    }
}
