//! Time in integer nanoseconds. Each clock has its own type, so that bus time, host time and UTC cannot be mixed.

use std::fmt;
use std::time::Duration;

use chrono::{DateTime, Utc};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Nanoseconds in one second.
pub const NS_PER_S: i64 = 1_000_000_000;

/// Parses a duration that a person typed. A number without a unit is in seconds: `90` means `90s`. Example with a
/// unit: `2m` is two minutes.
///
/// # Errors
/// If the text is not a duration. The message lists the units.
pub fn parse_duration(text: &str) -> Result<Duration, String> {
    let without_unit =
        text.trim().parse::<f64>().ok().map(|seconds| Duration::try_from_secs_f64(seconds).ok());
    without_unit.unwrap_or_else(|| humantime::parse_duration(text).ok()).ok_or_else(|| {
        format!(
            "`{text}` is not a duration; give seconds, or a number with ms, s, m or h, such as 90s or 1h 30m"
        )
    })
}

macro_rules! clock_instant {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
        #[serde(transparent)]
        pub struct $name(pub i64);

        impl $name {
            /// Signed distance `self - earlier` in ns.
            pub const fn ns_since(self, earlier: Self) -> i64 {
                self.0.wrapping_sub(earlier.0)
            }

            /// This instant shifted by `ns`, which may be negative.
            pub const fn plus_ns(self, ns: i64) -> Self {
                Self(self.0.wrapping_add(ns))
            }

            /// Signed distance `self - earlier` in s.
            pub fn seconds_since(self, earlier: Self) -> f64 {
                self.ns_since(earlier) as f64 * 1e-9
            }
        }
    };
}

clock_instant! {
    /// UTC as ns since 1970-01-01, as estimated by the host.
    UtcNs
}
clock_instant! {
    /// EtherCAT system time in ns: the distributed clock of the bus' reference device.
    DcNs
}
clock_instant! {
    /// The host's `CLOCK_MONOTONIC` in ns.
    MonoNs
}

impl UtcNs {
    /// The calendar date and time of this instant.
    pub fn to_datetime(self) -> DateTime<Utc> {
        DateTime::from_timestamp_nanos(self.0)
    }

    /// Converts a calendar date. Dates outside the years 1677 to 2262 do not fit into 64-bit ns and saturate.
    pub fn from_datetime(when: DateTime<Utc>) -> Self {
        Self(when.timestamp_nanos_opt().unwrap_or(if when.timestamp() < 0 { i64::MIN } else { i64::MAX }))
    }
}

impl fmt::Display for UtcNs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.to_datetime().to_rfc3339_opts(chrono::SecondsFormat::Nanos, true))
    }
}
