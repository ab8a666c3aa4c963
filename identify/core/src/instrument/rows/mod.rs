//! Rows of measurements at poses of the robot: the code that is common to all instruments that measure row by row.

mod error;
mod mistake;
mod row_noise;
mod screened;
mod split;
mod standing;

pub use error::RowError;
pub use mistake::Mistake;
pub(super) use row_noise::{MEDIAN_OF_ONE, MEDIAN_OF_THREE, RowNoise, sigma_by_median};
pub(super) use screened::Screened;
pub use screened::{RejectedRow, Rejection};
pub(crate) use screened::{faulty, gross_rows, without};
pub use split::HoldOut;
pub(crate) use split::segments;
pub(super) use standing::Standing;
pub use standing::standing;

use super::{Instrument, Measures};
use crate::kinematics::Chain;

/// Default seed of the random assignment of groups to folds.
pub const SEED: u64 = 1042;

/// A file of rows, in the order in which the robot visited its poses, with settings for the validation.
#[derive(Debug, Clone)]
pub struct Rows {
    /// The instrument with its rows.
    pub instrument: Instrument,
    /// Which rows are held out together. `None` uses the default of the instrument.
    pub hold_out: Option<HoldOut>,
    /// Seed of the random assignment of groups to folds. `None` uses [`SEED`].
    pub seed: Option<u64>,
    /// Highest order of joint waves, in waves per turn of a joint, for a fit without a ball-bar. If it is
    /// `None`, the number of rows determines it.
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
    /// Which rows are held out together.
    pub fn hold_out(&self) -> HoldOut {
        self.hold_out.unwrap_or_else(|| self.instrument.hold_out())
    }

    /// Seed of the random assignment of groups to folds.
    pub fn seed(&self) -> u64 {
        self.seed.unwrap_or(SEED)
    }

    /// The instrument, with its rows divided into groups. The rows of a group are held out
    /// together. `robot` is the nominal chain.
    pub(crate) fn grouped(&self, robot: &Chain) -> Instrument {
        let mut grouped = self.instrument.clone();
        let groups = self.hold_out().groups(robot, &self.instrument.joints());
        grouped.group(&groups, self.seed());
        grouped
    }
}
