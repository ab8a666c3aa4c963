//! Rows of measurements at poses of the robot: what every instrument has in common that measures such.

mod error;
mod mistake;
mod row_noise;
mod screened;
mod split;
mod standing;

pub use error::RowError;
pub use mistake::Mistake;
pub(super) use row_noise::{MEDIAN_OF_ONE, MEDIAN_OF_THREE, RowNoise};
pub(super) use screened::Screened;
pub use screened::{RejectedRow, Rejection};
pub(crate) use screened::{faulty, gross_rows, without};
pub use split::HoldOut;
pub(crate) use split::segments;
pub(super) use standing::Standing;
pub use standing::standing;

use super::{Instrument, Measures};
use crate::kinematics::Chain;

/// Usual seed of the choice which groups of rows come together.
pub const SEED: u64 = 1042;

/// Rows of one set-up, in the order in which the robot went there, and how they are used.
#[derive(Debug, Clone)]
pub struct Rows {
    /// The instrument with its rows.
    pub instrument: Instrument,
    /// Which are left out together; none: as is usual for the instrument.
    pub hold_out: Option<HoldOut>,
    /// Decides which groups come together.
    pub seed: Option<u64>,
    /// Highest number of waves per turn that the errors of joints may have, without a ball-bar.
    pub joint_waves: Option<u8>,
}

impl From<Instrument> for Rows {
    fn from(instrument: Instrument) -> Self {
        Self { instrument, hold_out: None, seed: None, joint_waves: None }
    }
}

impl<M: Measures + 'static> From<M> for Rows {
    fn from(of: M) -> Self {
        Instrument::from(of).into()
    }
}

impl Rows {
    /// What is left out together.
    pub fn hold_out(&self) -> HoldOut {
        self.hold_out.unwrap_or_else(|| self.instrument.hold_out())
    }

    /// Decides which groups come together.
    pub fn seed(&self) -> u64 {
        self.seed.unwrap_or(SEED)
    }

    /// The instrument with its rows in the groups that are left out together; `robot` is the nominal one.
    pub(crate) fn grouped(&self, robot: &Chain) -> Instrument {
        let mut grouped = self.instrument.clone();
        let groups = self.hold_out().groups(robot, &self.instrument.joints());
        grouped.group(&groups, self.seed());
        grouped
    }
}
