//! Reads ROS 2 bags in SQLite files (`.db3`) with the tables `topics` and `messages`.

use std::path::Path;

use rusqlite::{Connection, MAIN_DB};

use super::bag::Bag;
use crate::logs::LogError;

/// Offsets of the two format versions in the header of an SQLite file.
const FORMAT_VERSIONS: std::ops::Range<usize> = 18..20;
/// Format version of a file with a rollback journal.
const ROLLBACK_JOURNAL: u8 = 1;

/// Selects the messages with joint states in the order of their times.
const MESSAGES: &str = "SELECT topics.name, messages.timestamp, messages.data FROM messages \
     JOIN topics ON topics.id = messages.topic_id \
     WHERE topics.type IN ('sensor_msgs/msg/JointState', 'sensor_msgs/JointState') \
       AND topics.serialization_format = 'cdr' \
     ORDER BY messages.timestamp, messages.id";

/// Reads the joint states of a bag.
pub(super) fn read(bytes: &[u8], path: &Path) -> Result<Bag, LogError> {
    let broken = |error: rusqlite::Error| {
        let problem = format!("not a ROS 2 bag: {error}");
        LogError::content(path, problem, "check that it is the .db3 of a finished recording")
    };
    let mut bag = Bag::default();
    if has_write_ahead_log(path) {
        bag.remarks.push(
            "the recorder did not close the bag: a `-wal` file lies beside it, which is not read".into(),
        );
    }
    let connection = open(bytes).map_err(broken)?;
    let mut statement = connection.prepare(MESSAGES).map_err(broken)?;
    let mut rows = statement.query([]).map_err(broken)?;
    while let Some(row) = rows.next().map_err(broken)? {
        let name: String = row.get(0).map_err(broken)?;
        let recorded_ns: i64 = row.get(1).map_err(broken)?;
        let data = row.get_ref(2).and_then(|value| Ok(value.as_blob()?)).map_err(broken)?;
        bag.topic(&name).push(recorded_ns, data, path)?;
    }
    Ok(bag)
}

/// Opens the database in memory, because the file may be on a read-only medium.
fn open(bytes: &[u8]) -> rusqlite::Result<Connection> {
    let mut image = bytes.to_vec();
    // A file in WAL mode cannot be opened from memory. Changing its format versions is safe, because the file without its
    // `-wal` file is a complete database as of the last checkpoint.
    if let Some(versions) = image.get_mut(FORMAT_VERSIONS) {
        versions.fill(ROLLBACK_JOURNAL);
    }
    let mut connection = Connection::open_in_memory()?;
    connection.deserialize_read_exact(MAIN_DB, &image[..], image.len(), true)?;
    Ok(connection)
}

fn has_write_ahead_log(path: &Path) -> bool {
    let mut beside = path.as_os_str().to_owned();
    beside.push("-wal");
    std::fs::metadata(beside).is_ok_and(|metadata| metadata.len() > 0)
}
