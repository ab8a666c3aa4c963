//! The mapping of a bar log: a TOML file with the columns and units of the bar's encoders in a file of another
//! program. `config/bar_log.toml` explains each key.

use serde::{Deserialize, Serialize};
use shared::config::{Validate, Violation};

use crate::kinematics::BAR_JOINTS;
use crate::logs::robot::mapping::CsvLayout;
use crate::logs::tables::stamp::TimeColumn;

/// Smallest number of values of a counter whose wraps can be followed.
const WRAPS_AT_MIN: u64 = 1 << 10;
/// Number of values of an EL5021's counter.
const WRAPS_AT: u64 = 1 << 32;

/// Unit of an encoder's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EncoderUnit {
    /// Raw counts. The bar's configuration contains the counts per turn and the direction.
    Counts,
    /// Angles in radians, any number of turns.
    Rad,
    /// Angles in degrees, any number of turns.
    Deg,
}

/// The values of one encoder: their column in a table, or their joint in a bag.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderColumn {
    /// Joint of the bar that the encoder measures, 1 to 5.
    pub joint: u8,
    /// Name of the column in the header of a table, or of the joint in a ROS 2 bag.
    pub column: String,
    /// Unit of the values. If absent, it is counts in a table and radians in a bag.
    pub unit: Option<EncoderUnit>,
    /// Name of a column that is zero, false or empty if the value is invalid.
    pub valid: Option<String>,
}

/// Describes how to read the bar's encoders.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BarLogMapping {
    /// Name of the clock of the stamps.
    pub clock: Option<String>,
    /// Topic to read if a bag contains several topics with the bar's joints.
    pub topic: Option<String>,
    /// Layout of a text table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Column and unit of the stamps of a table.
    pub time: Option<TimeColumn>,
    /// Number of values of a counter: the file contains each count modulo this number.
    #[serde(default = "wraps_at")]
    pub wraps_at: u64,
    /// The encoders of the file. Joints of the bar that are not listed are not used.
    pub encoders: Vec<EncoderColumn>,
}

const fn wraps_at() -> u64 {
    WRAPS_AT
}

impl Validate for BarLogMapping {
    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        self.time.as_ref().map_or(Ok(()), TimeColumn::check)?;
        let found = format!("{} is not the width of a counter", self.wraps_at);
        let remedy = "give the number of its values, such as 65536";
        Violation::unless(self.wraps_at >= WRAPS_AT_MIN, "wraps_at", found, remedy)?;
        let remedy = "write one [[encoders]] block for each encoder of the file";
        Violation::unless(!self.encoders.is_empty(), "encoders", "there are none", remedy)?;
        for (index, encoder) in self.encoders.iter().enumerate() {
            let (key, joint) = (format!("encoders[{index}].joint"), encoder.joint);
            let is_of_bar = (1..=BAR_JOINTS as u8).contains(&joint);
            let remedy = "use 1 to 3 for the gimbal, 4 and 5 for the cardan";
            Violation::unless(is_of_bar, &key, format!("the bar has no joint {joint}"), remedy)?;
            let is_first = self.encoders[..index].iter().all(|other| other.joint != joint);
            Violation::unless(
                is_first,
                key,
                format!("joint {joint} has two encoders"),
                "list each joint once",
            )?;
            let is_first = self.encoders[..index].iter().all(|other| other.column != encoder.column);
            Violation::unless(
                is_first,
                format!("encoders[{index}].column"),
                format!("column `{}` is given for two encoders", encoder.column),
                "give each encoder its own column",
            )?;
        }
        Ok(())
    }
}

impl BarLogMapping {
    /// Number of values of a counter; without a mapping, that of an EL5021.
    pub(super) fn wraps_at_of(mapping: Option<&Self>) -> u64 {
        mapping.map_or(WRAPS_AT, |mapping| mapping.wraps_at)
    }
}
