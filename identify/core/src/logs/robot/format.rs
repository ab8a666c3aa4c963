//! Recognises the format of a robot log by its first bytes, or by the extension `.egm`.

use std::path::Path;

use crate::logs::LogError;
use crate::logs::tables::text::header_line;
use crate::logs::tables::workbook::is_workbook;

/// Number of bytes within which the header of a table begins, even after comments. A header is not searched for in the rest,
/// which may be a gigabyte.
const HEADER_BYTES_MAX: usize = 1 << 16;

/// Formats of robot logs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LogFormat {
    /// Text table with a header; the robot's configuration or a mapping file determines the columns.
    Csv,
    /// Output of `record.py` of Universal Robots' RTDE client, or of the library `ur_rtde`: columns such as `actual_q_0`,
    /// separated by blanks or commas.
    UrRtde,
    /// ROS 2 bag in MCAP (`.mcap`) with `sensor_msgs/JointState` messages.
    Ros2Mcap,
    /// ROS 2 bag in SQLite (`.db3`) with `sensor_msgs/JointState` messages.
    Ros2Db3,
    /// ABB EGM: `EgmRobot` messages, each preceded by its length.
    Egm,
    /// KUKA RSI: a sequence of `<Rob>` telegrams.
    Rsi,
}

impl LogFormat {
    /// Recognises the format of the log that begins with these `bytes`.
    ///
    /// # Errors
    /// [`LogError::UnknownFormat`] if the bytes are binary data in none of these formats.
    pub fn detect(bytes: &[u8], path: &Path) -> Result<Self, LogError> {
        if bytes.starts_with(b"\x89MCAP0\r\n") {
            return Ok(Self::Ros2Mcap);
        }
        if bytes.starts_with(b"SQLite format 3\0") {
            return Ok(Self::Ros2Db3);
        }
        if is_workbook(bytes) {
            return Ok(Self::Csv);
        }
        let extension =
            path.extension().and_then(|extension| extension.to_str()).unwrap_or_default().to_lowercase();
        if extension == "egm" {
            return Ok(Self::Egm);
        }
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        if text.trim_ascii_start().starts_with(b"<") {
            return Ok(Self::Rsi);
        }
        // Control bytes mean binary data, except in UTF-16 text, which begins with a byte order mark and is
        // decoded by the reader.
        let is_utf_16 = text.starts_with(b"\xff\xfe") || text.starts_with(b"\xfe\xff");
        let has_control_bytes = text.iter().take(4096).any(|byte| matches!(byte, 0..=8 | 14..=31));
        if has_control_bytes && !is_utf_16 {
            return Err(LogError::UnknownFormat { path: path.to_owned() });
        }
        // Comments may contain characters of another encoding. The names of the columns are ASCII.
        let beginning = String::from_utf8_lossy(text.get(..HEADER_BYTES_MAX).unwrap_or(text));
        let header = header_line(&beginning);
        let is_rtde = header.contains("timestamp")
            && ["actual_q_0", "target_q_0"].iter().any(|name| header.contains(name));
        Ok(if is_rtde { Self::UrRtde } else { Self::Csv })
    }

    /// The value of `--log-format`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::UrRtde => "ur-rtde",
            Self::Ros2Mcap => "ros2-mcap",
            Self::Ros2Db3 => "ros2-db3",
            Self::Egm => "egm",
            Self::Rsi => "rsi",
        }
    }
}
