//! Writes a recording so that a kill loses at most what came since the last [`RecordingWriter::sync`].
//!
//! Each chunk is built in memory and appended in one go with a right header (`disable_seeking`): a file that
//! was cut ends at a chunk's border or in a torn chunk, never in a record of bogus length.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapError, WriteOptions, Writer};
use serde::Serialize;

use super::messages::{self, MessageError, Topic};
use super::schema::{CycleRecord, Event, RunEnd, RunMetadata};
use super::{CONTENT_KEY, END_METADATA, RUN_METADATA};
use crate::encoder::Unwrapper;
use crate::time::UtcNs;

/// Ending of a finished recording.
pub const FINISHED_ENDING: &str = "mcap";
/// Ending of a recording that is being written, or that was left by a crash.
pub const ACTIVE_ENDING: &str = "mcap.active";

/// Why a recording cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The run's name would not be a plain file name.
    #[error("run name `{0}` is not usable as a file name; use letters, digits, `-`, `_` and `.`")]
    Name(String),
    /// A file of that name is there already.
    #[error("{} exists already and is never overwritten; choose another run name or directory", .0.display())]
    Exists(PathBuf),
    /// The system refused.
    #[error("cannot write {}: {source}; check free space and permissions", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The MCAP layer failed, usually because the disk did.
    #[error("cannot write to the recording: {0}; what was synchronised before is kept in the .active file")]
    Container(#[from] McapError),
    /// A record could not be encoded.
    #[error("cannot encode a record: {0}")]
    Message(#[from] MessageError),
    /// Metadata could not be encoded.
    #[error("cannot encode the run's metadata: {0}")]
    Metadata(#[from] serde_json::Error),
}

/// A run's file on disk, `.mcap.active` until it is finished.
#[derive(Debug)]
pub struct RunFile {
    file: File,
    active: PathBuf,
    finished: PathBuf,
}

impl RunFile {
    /// Creates `<directory>/<name>.mcap.active`; the directory is made where it is missing.
    pub fn create(directory: &Path, name: &str) -> Result<Self, WriteError> {
        let plain = |c: char| c.is_alphanumeric() || "-_.+".contains(c);
        if name.is_empty() || name.starts_with('.') || name.len() > 200 || !name.chars().all(plain) {
            return Err(WriteError::Name(name.to_owned()));
        }
        let io_error = |path: &Path| {
            let path = path.to_owned();
            move |source| WriteError::Io { path, source }
        };
        std::fs::create_dir_all(directory).map_err(io_error(directory))?;
        let active = directory.join(format!("{name}.{ACTIVE_ENDING}"));
        let finished = directory.join(format!("{name}.{FINISHED_ENDING}"));
        if finished.exists() {
            return Err(WriteError::Exists(finished));
        }
        let file =
            OpenOptions::new().read(true).write(true).create_new(true).open(&active).map_err(|source| {
                if source.kind() == io::ErrorKind::AlreadyExists {
                    WriteError::Exists(active.clone())
                } else {
                    WriteError::Io { path: active.clone(), source }
                }
            })?;
        sync_directory(directory).map_err(io_error(directory))?;
        Ok(Self { file, active, finished })
    }

    /// Where the bytes are while the run goes on.
    pub fn active_path(&self) -> &Path {
        &self.active
    }

    /// Gives the file its final name, without ever replacing another.
    fn publish(self) -> Result<PathBuf, WriteError> {
        let Self { file, active, finished } = self;
        let io_error = |source| WriteError::Io { path: finished.clone(), source };
        file.sync_all().map_err(io_error)?;
        rename_without_replacing(&active, &finished).map_err(|source| {
            if source.kind() == io::ErrorKind::AlreadyExists {
                WriteError::Exists(finished.clone())
            } else {
                io_error(source)
            }
        })?;
        sync_directory(finished.parent().unwrap_or(Path::new("."))).map_err(io_error)?;
        Ok(finished)
    }
}

impl Write for RunFile {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.file.write(buffer)
    }

    /// Returns when everything written so far survives a power cut.
    fn flush(&mut self) -> io::Result<()> {
        self.file.sync_data()
    }
}

impl Seek for RunFile {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.file.seek(position)
    }
}

fn rename_without_replacing(from: &Path, to: &Path) -> io::Result<()> {
    use nix::errno::Errno;
    use nix::fcntl::{AT_FDCWD, RenameFlags, renameat2};
    match renameat2(AT_FDCWD, from, AT_FDCWD, to, RenameFlags::RENAME_NOREPLACE) {
        // Some file systems know no such rename; the name was free when the run began.
        Err(Errno::EINVAL | Errno::ENOSYS) if !to.exists() => std::fs::rename(from, to),
        result => result.map_err(io::Error::from),
    }
}

fn sync_directory(directory: &Path) -> io::Result<()> {
    let directory = if directory.as_os_str().is_empty() { Path::new(".") } else { directory };
    File::open(directory)?.sync_all()
}

/// One joint of the plotted joint states.
struct PlottedJoint {
    scale: crate::encoder::EncoderScale,
    unwrapper: Unwrapper,
}

/// Writes one run. Calls block on the disk: never use it from the real-time thread.
pub struct RecordingWriter<W: Write + Seek> {
    writer: Writer<W>,
    cycle_channel: u16,
    event_channel: u16,
    joint_state_channel: u16,
    joint_names: Vec<String>,
    joints: Vec<PlottedJoint>,
    cycles: u64,
    cycles_valid: u64,
    cycles_lost: u64,
    events: u32,
    time_last: UtcNs,
}

impl RecordingWriter<RunFile> {
    /// Begins a run in a directory; metadata and schemas are on disk when this returns.
    pub fn create(directory: &Path, run: &RunMetadata) -> Result<Self, WriteError> {
        Self::begin(RunFile::create(directory, &run.name)?, run)
    }

    /// Ends the run and gives the file its final name, which is returned.
    pub fn finish(self, cause: &str, ended: UtcNs) -> Result<PathBuf, WriteError> {
        self.end(cause, ended)?.publish()
    }
}

impl<W: Write + Seek> RecordingWriter<W> {
    /// Begins a run on any sink; its `flush` decides how safe [`RecordingWriter::sync`] is.
    pub fn begin(sink: W, run: &RunMetadata) -> Result<Self, WriteError> {
        let mut writer = WriteOptions::new()
            .profile("ros2")
            .library(format!("ballbard {}", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            .compression_threads(0)
            .disable_seeking(true)
            .create(sink)?;
        write_json_metadata(&mut writer, RUN_METADATA, run)?;
        let cycle_channel = add_topic(&mut writer, &messages::CYCLE)?;
        let event_channel = add_topic(&mut writer, &messages::EVENT)?;
        let joint_state_channel = add_topic(&mut writer, &messages::JOINT_STATE)?;
        let mut recording = Self {
            writer,
            cycle_channel,
            event_channel,
            joint_state_channel,
            joint_names: run.encoders.iter().map(|encoder| format!("bar_joint_{}", encoder.joint)).collect(),
            joints: run
                .encoders
                .iter()
                .map(|encoder| PlottedJoint { scale: encoder.scale, unwrapper: encoder.scale.unwrapper() })
                .collect(),
            cycles: 0,
            cycles_valid: 0,
            cycles_lost: 0,
            events: 0,
            time_last: run.started,
        };
        // Schemas and channels sit in the first chunk: without it nothing after it can be decoded.
        recording.sync()?;
        Ok(recording)
    }

    /// Appends one bus cycle and its plotted joint state.
    pub fn write_cycle(&mut self, record: &CycleRecord) -> Result<(), WriteError> {
        let sequence = record.cycle as u32;
        let data = messages::encode_cycle(record)?;
        self.write_message(self.cycle_channel, sequence, record.sample_time, &data)?;
        let position_rad: Vec<f64> = self
            .joints
            .iter_mut()
            .zip(record.encoders())
            .map(|(joint, encoder)| {
                if encoder.valid {
                    joint.scale.counts_to_rad(joint.unwrapper.next(encoder.count))
                } else {
                    f64::NAN
                }
            })
            .collect();
        let names = &self.joint_names[..position_rad.len()];
        let data = messages::encode_joint_state(record.sample_time, names, &position_rad)?;
        self.write_message(self.joint_state_channel, sequence, record.sample_time, &data)?;
        self.cycles += 1;
        self.cycles_valid += u64::from(record.is_valid());
        self.cycles_lost += u64::from(record.flags & super::schema::flags::LOST != 0);
        Ok(())
    }

    /// Appends an event.
    pub fn write_event(&mut self, event: &Event) -> Result<(), WriteError> {
        let data = messages::encode_event(event)?;
        self.events = self.events.wrapping_add(1);
        self.write_message(self.event_channel, self.events, event.time, &data)
    }

    /// Cuts the chunk and flushes the sink: with a [`RunFile`] everything so far survives a power cut.
    pub fn sync(&mut self) -> Result<(), WriteError> {
        Ok(self.writer.flush()?)
    }

    /// Cycles written so far.
    pub fn cycles(&self) -> u64 {
        self.cycles
    }

    /// Cycles written so far in which every encoder is valid.
    pub fn cycles_valid(&self) -> u64 {
        self.cycles_valid
    }

    /// Ends the run on any sink: how it ended, summary, footer.
    pub fn end(mut self, cause: &str, ended: UtcNs) -> Result<W, WriteError> {
        let end = RunEnd {
            cause: cause.to_owned(),
            ended,
            cycles: self.cycles,
            cycles_valid: self.cycles_valid,
            cycles_lost: self.cycles_lost,
        };
        write_json_metadata(&mut self.writer, END_METADATA, &end)?;
        self.writer.finish()?;
        Ok(self.writer.into_inner())
    }

    fn write_message(
        &mut self,
        channel_id: u16,
        sequence: u32,
        time: UtcNs,
        data: &[u8],
    ) -> Result<(), WriteError> {
        // Readers sort by log time: it never runs backwards, whatever an estimate does.
        self.time_last = self.time_last.max(time);
        let log_time = self.time_last.0.max(0) as u64;
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        Ok(self.writer.write_to_known_channel(&header, data)?)
    }
}

fn write_json_metadata<W: Write + Seek>(
    writer: &mut Writer<W>,
    name: &str,
    content: &impl Serialize,
) -> Result<(), WriteError> {
    let json = serde_json::to_string(content)?;
    let metadata = BTreeMap::from([(CONTENT_KEY.to_owned(), json)]);
    Ok(writer.write_metadata(&Metadata { name: name.to_owned(), metadata })?)
}

/// Adds schema and channel of a topic, with the QoS profile that `ros2 bag play` asks for.
fn add_topic<W: Write + Seek>(writer: &mut Writer<W>, topic: &Topic) -> Result<u16, WriteError> {
    const QOS: &str = "- history: 1\n  depth: 10\n  reliability: 1\n  durability: 2\n  deadline:\n    sec: 9223372036\n    \
        nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  \
        liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  avoid_ros_namespace_conventions: false";
    let schema = writer.add_schema(topic.schema_name, "ros2msg", topic.schema_text.as_bytes())?;
    let metadata = BTreeMap::from([
        ("offered_qos_profiles".to_owned(), QOS.to_owned()),
        ("topic_type_hash".to_owned(), String::new()),
    ]);
    Ok(writer.add_channel(schema, topic.topic, "cdr", &metadata)?)
}
