//! Runs a homing in the service: shows the steps as text, and writes the file of reference marks at the end.

use shared::time::MonoNs;

use crate::control::status::HomingStatus;
use crate::homing::{self, FoundMark, HomingError, HomingStep, MarksFile};
use crate::run::{ActiveHoming, Session, Setup};
use crate::scheduler::Pending;

/// The current homing, or the last one until another homing begins.
pub struct Homing {
    active: ActiveHoming,
    setup: Setup,
    status: HomingStatus,
    /// Task that saves the marks that were found.
    saving: Option<Pending<Result<(), HomingError>>>,
}

impl Homing {
    /// Starts a homing on the session's bus.
    pub fn begin(session: &Session) -> Self {
        Self {
            active: session.begin_homing(),
            setup: session.setup.clone(),
            status: HomingStatus::default(),
            saving: None,
        }
    }

    /// Requests the end of the homing.
    pub fn stop(&self, cause: &str) {
        self.active.stop.stop(cause);
    }

    /// Progress of the homing as text, for people.
    pub fn status(&self) -> &HomingStatus {
        &self.status
    }

    /// Time at which the writing of the marks began; `None` if no marks are being written.
    pub fn saving_since(&self) -> Option<MonoNs> {
        self.saving.as_ref().map(Pending::since)
    }

    /// Handles the steps since the last poll. Returns true if the homing has just ended. The status then contains the
    /// outcome. If the homing succeeded, the file `marks` has been written.
    pub fn poll(&mut self, marks: &MarksFile) -> bool {
        while let Some(step) = self.active.take_step() {
            show_step(&mut self.status, step);
        }
        match self.active.outcome() {
            Some(Ok(found)) => self.save(found, marks),
            Some(Err(error)) => return self.finish(marks, Err(error)),
            None => {}
        }
        let Some(saved) = self.saving.as_ref().and_then(Pending::poll) else { return false };
        let died = |_| Err(HomingError::NotKept("no thread writes them; see the log".into()));
        self.finish(marks, saved.unwrap_or_else(died))
    }

    /// Verifies the marks and starts to write their file.
    fn save(&mut self, found: Vec<FoundMark>, marks: &MarksFile) {
        (self.status.joint, self.status.turned_deg) = (None, None);
        let Setup { scheduler, storage, bar, .. } = &self.setup;
        let (disk, encoders, file) = (storage.disk(), bar.encoders.clone(), marks.clone());
        self.saving = Some(Pending::start(&**scheduler, "homing", move || {
            let marks = homing::verify(&encoders, &found)?;
            let written = file.write(&*disk, &encoders, &marks);
            written.map_err(|error| HomingError::NotKept(error.to_string()))
        }));
    }

    /// Ends the homing with this outcome. Returns true, which [`Self::poll`] passes on.
    fn finish(&mut self, marks: &MarksFile, saved: Result<(), HomingError>) -> bool {
        self.saving = None;
        self.status.is_over = true;
        (self.status.joint, self.status.turned_deg) = (None, None);
        match saved {
            Ok(()) => self.status.lines.push(format!(
                "{}: runs count angles from these marks until the terminals lose power; then home again",
                marks.path().display()
            )),
            Err(error) => self.status.error = Some(error.to_string()),
        }
        tracing::info!("{}", self.status);
        true
    }
}

fn show_step(status: &mut HomingStatus, step: HomingStep) {
    match step {
        HomingStep::Turn { joint, .. } => (status.joint, status.turned_deg) = (Some(joint), Some(0.0)),
        HomingStep::Turning { turned_rad, .. } => status.turned_deg = Some(turned_rad.to_degrees()),
        HomingStep::Found(_) => status.turned_deg = None,
    }
    status.lines.extend(step.line());
}
