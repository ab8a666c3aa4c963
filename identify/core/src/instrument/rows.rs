//! Rows of measurements at poses of the robot, and the instrument that they make.

use super::{
    Contact, ContactError, ContactRow, HoldOut, Instrument, LengthRow, PoseRow, SocketTable, Standing,
    Tracker, Wire,
};
use crate::kinematics::{Chain, Joints};
use crate::model::Model;
use crate::prepare::Moving;

/// Decides which groups of rows come together where nobody says so.
pub const SEED: u64 = 1042;

/// Rows of one set-up, in the order in which the robot went there.
#[derive(Debug, Clone)]
pub struct Rows {
    /// What was measured.
    pub measured: Measured,
    /// Which are left out together; none: as is usual for the instrument.
    pub hold_out: Option<HoldOut>,
    /// Decides which groups come together.
    pub seed: Option<u64>,
    /// Highest number of waves per turn that the errors of joints may have, where there is no ball-bar.
    pub joint_waves: Option<u8>,
}

/// What an instrument measured at poses at which the robot stood still, or a tracker while it moved.
#[derive(Debug, Clone)]
pub enum Measured {
    /// A tracker.
    Poses(Vec<PoseRow>),
    /// A tracker that followed a moving robot, with its own log.
    Path(Vec<PoseRow>, Moving),
    /// A draw-wire or a telescoping bar.
    Lengths(Vec<LengthRow>),
    /// A ball in sockets, with what is known of these.
    Contacts(Vec<ContactRow>, SocketTable),
}

impl From<Measured> for Rows {
    fn from(measured: Measured) -> Self {
        Self { measured, hold_out: None, seed: None, joint_waves: None }
    }
}

impl Measured {
    /// Of a tracker its rows.
    pub fn poses(&self) -> Option<&[PoseRow]> {
        match self {
            Self::Poses(rows) | Self::Path(rows, _) => Some(rows),
            Self::Lengths(_) | Self::Contacts(..) => None,
        }
    }
}

impl Rows {
    /// What is left out together: regions where there are poses, single ones of lengths, of a ball in sockets and of a tracker in
    /// several stations, unless somebody says so: a region could have all rows of a station.
    pub fn hold_out(&self) -> HoldOut {
        self.hold_out.unwrap_or(match &self.measured {
            Measured::Poses(rows) if rows.iter().any(|row| row.set_up.station > 0) => HoldOut::Rows,
            Measured::Poses(_) | Measured::Path(..) => HoldOut::Regions,
            Measured::Lengths(_) | Measured::Contacts(..) => HoldOut::Rows,
        })
    }

    /// Decides which groups come together.
    pub fn seed(&self) -> u64 {
        self.seed.unwrap_or(SEED)
    }

    /// Joints of each row.
    pub fn joints(&self) -> Vec<Joints> {
        match &self.measured {
            Measured::Poses(rows) | Measured::Path(rows, _) => {
                rows.iter().map(|row| row.joints_rad).collect()
            }
            Measured::Lengths(rows) => rows.iter().map(|row| row.joints_rad).collect(),
            Measured::Contacts(rows, _) => rows.iter().map(|row| row.joints_rad).collect(),
        }
    }

    /// The instrument with the nominal robot.
    pub(crate) fn at_nominal(&self, robot: &Chain) -> Result<(Instrument, Model), ContactError> {
        Ok(match &self.measured {
            Measured::Poses(rows) => {
                let tracker = Tracker::new(self.standing(rows, |row| row.joints_rad, robot));
                let model = tracker.fitted_out(Model::measured_pose(robot));
                (Instrument::Tracker(tracker), model)
            }
            Measured::Path(rows, moving) => {
                let at = self.standing(rows, |row| row.joints_rad, robot);
                let tracker = Tracker::of_moving(at, moving.clone());
                let model = tracker.fitted_out(Model::measured_pose(robot));
                (Instrument::Tracker(tracker), model)
            }
            Measured::Lengths(rows) => {
                let wire = Wire::new(self.standing(rows, |row| row.joints_rad, robot));
                let model = wire.fitted_out(Model::measured_length(robot));
                (Instrument::Wire(wire), model)
            }
            Measured::Contacts(rows, table) => {
                let contact = Contact::new(self.standing(rows, |row| row.joints_rad, robot), table)?;
                let model = Model::contact(robot, contact.sockets().names().len());
                (Instrument::Contact(contact), model)
            }
        })
    }

    fn standing<R: Copy>(&self, rows: &[R], joints: impl Fn(&R) -> Joints, robot: &Chain) -> Standing<R> {
        Standing::of_file(rows, joints, robot, self.hold_out(), self.seed())
    }
}
