//! Writes a recording. If the process is killed, at most the data since the last [`RecordingWriter::cut`] are lost. A power
//! cut loses at most the data since the last [`RecordingWriter::sync`].
//!
//! Messages are collected in a chunk, the unit of MCAP that is compressed and has a checksum. To *cut* a chunk is
//! to end it and begin a new one. Each chunk is built in memory, and appended to the file only when its header is
//! final (`disable_seeking`). An interrupted file therefore ends after a chunk or within one, and never contains a
//! header with a wrong length.
//!
//! The writer passes the bytes to a *sink*, usually the [`RunFile`]. Bytes that the sink refuses stay in memory. When the
//! sink has been repaired or replaced, the recording continues without a gap.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};

use super::content::{END_METADATA, LIBRARY_NAME, TIMING_METADATA, metadata_of, metadata_of_run};
use super::digest::{Digest, Flagged};
use super::disk::{Disk, SystemDisk};
use super::messages::{self, MessageError, Topic};
use super::run_file::RunFile;
use super::schema::{CycleRecord, Event, PortCounts, RunEnd, RunMetadata, flags};
use super::shown::Shown;
use super::timing::TimingSummary;
use crate::time::UtcNs;
use crate::version::version;

/// Why a recording cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The name of the run is not a plain file name.
    #[error(
        "run name `{0}` is not usable as a file name; use up to 120 bytes of letters, digits, `-`, `_`, `+` and `.`, \
         neither `.` nor `-` first, and no ending such as .mcap"
    )]
    Name(String),
    /// A file of that name exists.
    #[error("{} exists already and is never overwritten; choose another run name or directory", .0.display())]
    Exists(PathBuf),
    /// A system call failed.
    #[error("cannot write {}: {source}; check free space and permissions", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The run's file was removed, replaced or moved, or its file system is gone.
    #[error("{}: the run's file is not there any more; it was removed or moved, or its disk is gone", .0.display())]
    Lost(PathBuf),
    /// The sink refused bytes. They are kept in memory, and will be written before all later bytes.
    #[error("cannot write the recording: {0}; check free space and permissions")]
    Sink(#[from] io::Error),
    /// The MCAP layer refused a record.
    #[error("cannot build the recording: {0}")]
    Container(#[from] McapError),
    /// A record could not be encoded.
    #[error("cannot encode a record: {0}")]
    Message(#[from] MessageError),
    /// Metadata could not be encoded.
    #[error("cannot encode the run's metadata: {0}")]
    Metadata(#[from] serde_json::Error),
}

/// A function that receives each message that is written: topic, log time \[ns since 1970\], CDR bytes. Writing continues
/// only when the function has returned.
pub type Tap = Box<dyn FnMut(&'static Topic, u64, &[u8]) + Send>;

/// A topic with the number of its channel in this file.
#[derive(Clone, Copy)]
struct Channel {
    id: u16,
    topic: &'static Topic,
}

/// Bytes of the file that the MCAP writer has built and the sink has not accepted yet.
#[derive(Clone, Default)]
struct Spool(Arc<Mutex<Vec<u8>>>);

impl Spool {
    fn bytes(&self) -> MutexGuard<'_, Vec<u8>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Write for Spool {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.bytes().extend_from_slice(buffer);
        Ok(buffer.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Writes one run. Calls wait for the disk, so the real-time thread must not make them.
///
/// If a call returns [`WriteError::Sink`], its record was still accepted. When the sink has been repaired or replaced,
/// [`RecordingWriter::write_out`] continues with the first byte that was not accepted.
pub struct RecordingWriter<W: Write> {
    writer: Writer<NoSeek<Spool>>,
    spool: Spool,
    sink: W,
    cycle_channel: Channel,
    event_channel: Channel,
    joint_state_channel: Channel,
    log_channel: Channel,
    diagnostics_channel: Channel,
    shown: Shown,
    digest: Digest,
    started: UtcNs,
    cycles: u64,
    cycles_valid: u64,
    cycles_lost: u64,
    events: u32,
    /// Latest log time of all messages.
    time_last: UtcNs,
    /// The run's metadata, until the second copy has been written.
    run_copy: Option<Metadata>,
    tap: Option<Tap>,
}

impl RecordingWriter<RunFile> {
    /// Begins a run in a directory. When this returns, metadata and schemas are on disk.
    pub fn create(directory: &Path, run: &RunMetadata) -> Result<Self, WriteError> {
        Self::create_on(Arc::new(SystemDisk), directory, run)
    }

    /// [`create`](Self::create) on another disk. After an error no file is left.
    pub fn create_on(disk: Arc<dyn Disk>, directory: &Path, run: &RunMetadata) -> Result<Self, WriteError> {
        let file = RunFile::create(disk, directory, &run.name)?;
        let place = file.place().clone();
        Self::begin(file, run).inspect_err(|_| place.remove())
    }

    /// Ends the run and gives the file its final name. Returns the path.
    pub fn finish(self, cause: &str, ended: UtcNs) -> Result<PathBuf, WriteError> {
        let mut file = self.end(cause, ended)?;
        file.publish()
    }
}

impl<W: Write> RecordingWriter<W> {
    /// Begins a run on any sink. The `flush` of the sink determines what [`RecordingWriter::sync`] protects against.
    pub fn begin(sink: W, run: &RunMetadata) -> Result<Self, WriteError> {
        let spool = Spool::default();
        let mut writer = WriteOptions::new()
            .profile("ros2")
            .library(format!("{LIBRARY_NAME}{}", version()))
            .compression(Some(Compression::Zstd))
            .compression_threads(0)
            .disable_seeking(true)
            .create(NoSeek::new(spool.clone()))?;
        let run_metadata = metadata_of_run(run)?;
        writer.write_metadata(&run_metadata)?;
        attach_configuration(&mut writer, run)?;
        let mut recording = Self {
            cycle_channel: add_topic(&mut writer, &messages::CYCLE)?,
            event_channel: add_topic(&mut writer, &messages::EVENT)?,
            joint_state_channel: add_topic(&mut writer, &messages::JOINT_STATE)?,
            log_channel: add_topic(&mut writer, &messages::LOG)?,
            diagnostics_channel: add_topic(&mut writer, &messages::DIAGNOSTICS)?,
            writer,
            spool,
            sink,
            shown: Shown::new(run),
            digest: Digest::default(),
            started: run.started,
            cycles: 0,
            cycles_valid: 0,
            cycles_lost: 0,
            events: 0,
            time_last: run.started,
            run_copy: Some(run_metadata),
            tap: None,
        };
        // The first chunk contains schemas and channels. No later chunk can be decoded without it.
        recording.sync()?;
        Ok(recording)
    }

    /// Appends a bus cycle. Also appends the joint states and the diagnostics for other programs.
    pub fn write_cycle(&mut self, record: &CycleRecord) -> Result<(), WriteError> {
        let sequence = record.cycle as u32;
        let data = messages::encode_cycle(record)?;
        self.add_message(self.cycle_channel, sequence, record.sample_time, &data)?;
        let data = self.shown.joint_state(record)?;
        self.add_message(self.joint_state_channel, sequence, record.sample_time, &data)?;
        if let Some(data) = self.shown.diagnostics(record) {
            self.add_message(self.diagnostics_channel, sequence, record.sample_time, &data?)?;
        }
        self.digest.take_cycle(record);
        self.cycles += 1;
        self.cycles_valid += u64::from(record.is_valid());
        self.cycles_lost += u64::from(record.flags & flags::LOST != 0);
        self.write_out()
    }

    /// Sets a function that receives each later message, too.
    pub fn set_tap(&mut self, tap: Tap) {
        self.tap = Some(tap);
    }

    /// Sets the error counts of a port for the diagnostics of later cycles.
    pub fn set_port_counts(&mut self, counts: PortCounts) {
        self.shown.set_port_counts(counts);
    }

    /// Appends an event. Also appends it as a line of the log.
    pub fn write_event(&mut self, event: &Event) -> Result<(), WriteError> {
        let data = messages::encode_event(event)?;
        self.digest.take_event(event, self.started);
        self.events = self.events.wrapping_add(1);
        self.add_message(self.event_channel, self.events, event.time, &data)?;
        self.add_message(self.log_channel, self.events, event.time, &messages::encode_log(event)?)?;
        self.write_out()
    }

    /// Appends the timing of the loop so far, and cuts the chunk. Readers use the last timing in the file.
    pub fn write_timing(&mut self, timing: &TimingSummary) -> Result<(), WriteError> {
        self.writer.write_metadata(&metadata_of(TIMING_METADATA, timing)?)?;
        self.write_out()
    }

    /// Cuts the chunk and passes it to the sink. If the sink is a [`RunFile`], all data so far survive
    /// a kill of the process.
    pub fn cut(&mut self) -> Result<(), WriteError> {
        if self.cycles > 0 {
            self.repeat_run()?;
        }
        self.writer.flush()?;
        self.write_out()
    }

    /// Cuts the chunk, passes it to the sink and flushes the sink. If the sink is a [`RunFile`], all data so
    /// far survive a power cut.
    pub fn sync(&mut self) -> Result<(), WriteError> {
        self.cut()?;
        Ok(self.sink.flush()?)
    }

    /// Passes all bytes that the sink has not accepted yet to the sink.
    pub fn write_out(&mut self) -> Result<(), WriteError> {
        let mut bytes = self.spool.bytes();
        while !bytes.is_empty() {
            match self.sink.write(&bytes) {
                Ok(0) => return Err(io::Error::from(io::ErrorKind::WriteZero).into()),
                Ok(count) => drop(bytes.drain(..count)),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// The sink that receives the bytes of the file.
    pub fn sink(&self) -> &W {
        &self.sink
    }

    /// The sink, so that it can be repaired or replaced.
    pub fn sink_mut(&mut self) -> &mut W {
        &mut self.sink
    }

    /// Writes the second copy of the run's metadata after the first cycles. Later calls do nothing. One contiguous segment
    /// of damage can destroy both copies only if it also destroys the cycles between them.
    fn repeat_run(&mut self) -> Result<(), WriteError> {
        Ok(self.run_copy.take().map_or(Ok(()), |run| self.writer.write_metadata(&run))?)
    }

    /// Cycles written so far.
    pub fn cycles(&self) -> u64 {
        self.cycles
    }

    /// Number of cycles written so far in which every encoder is valid.
    pub fn cycles_valid(&self) -> u64 {
        self.cycles_valid
    }

    /// Cycles written so far that are not valid, grouped by joint and reason.
    pub fn flagged(&self) -> Vec<Flagged> {
        self.digest.flagged()
    }

    /// Ends the run: writes the end record, the summary and the footer. Returns the sink.
    pub fn end(mut self, cause: &str, ended: UtcNs) -> Result<W, WriteError> {
        self.close(cause, ended)?;
        Ok(self.sink)
    }

    /// Like [`end`](Self::end), but can be used with a sink that refuses bytes until it is repaired.
    /// Nothing can be appended afterwards.
    pub fn close(&mut self, cause: &str, ended: UtcNs) -> Result<(), WriteError> {
        let end = self.end_record(cause, ended);
        self.close_with(&end)
    }

    /// The end record of a run that ends now.
    pub(super) fn end_record(&self, cause: &str, ended: UtcNs) -> RunEnd {
        RunEnd {
            cause: cause.to_owned(),
            ended,
            cycles: self.cycles,
            cycles_valid: self.cycles_valid,
            cycles_lost: self.cycles_lost,
            recovered: false,
            turned_deg: self.shown.turned_deg(),
            marks: self.digest.marks(),
            flagged: self.digest.flagged(),
        }
    }

    pub(super) fn end_with(mut self, end: &RunEnd) -> Result<W, WriteError> {
        self.close_with(end)?;
        Ok(self.sink)
    }

    fn close_with(&mut self, end: &RunEnd) -> Result<(), WriteError> {
        self.repeat_run()?;
        self.writer.write_metadata(&metadata_of(END_METADATA, end)?)?;
        self.writer.finish()?;
        self.write_out()
    }

    fn add_message(
        &mut self,
        channel: Channel,
        sequence: u32,
        time: UtcNs,
        data: &[u8],
    ) -> Result<(), WriteError> {
        // Readers sort messages by log time. The log time must not decrease, even if the estimated sample time does.
        self.time_last = self.time_last.max(time);
        let log_time = self.time_last.0.max(0) as u64;
        if let Some(tap) = &mut self.tap {
            tap(channel.topic, log_time, data);
        }
        let header = MessageHeader { channel_id: channel.id, sequence, log_time, publish_time: log_time };
        Ok(self.writer.write_to_known_channel(&header, data)?)
    }
}

/// Attaches the configuration of the run as files. Any MCAP program can extract them.
fn attach_configuration(writer: &mut Writer<NoSeek<Spool>>, run: &RunMetadata) -> Result<(), WriteError> {
    let time = run.started.0.max(0) as u64;
    for (name, text) in [("daemon.toml", &run.daemon_config), ("ball_bar.toml", &run.ball_bar_config)] {
        if !text.is_empty() {
            writer.attach(&Attachment {
                log_time: time,
                create_time: time,
                name: name.into(),
                media_type: "application/toml".into(),
                data: text.as_bytes().into(),
            })?;
        }
    }
    Ok(())
}

/// Adds a topic with its schema and channel. The channel has the QoS profile that `ros2 bag play` needs.
fn add_topic(writer: &mut Writer<NoSeek<Spool>>, topic: &'static Topic) -> Result<Channel, McapError> {
    const QOS: &str = "- history: 1\n  depth: 10\n  reliability: 1\n  durability: 2\n  deadline:\n    sec: 9223372036\n    \
        nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  \
        liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  avoid_ros_namespace_conventions: false";
    let schema = writer.add_schema(topic.schema_name, "ros2msg", topic.schema_text.as_bytes())?;
    let metadata = BTreeMap::from([
        ("offered_qos_profiles".to_owned(), QOS.to_owned()),
        ("topic_type_hash".to_owned(), String::new()),
    ]);
    Ok(Channel { id: writer.add_channel(schema, topic.topic, "cdr", &metadata)?, topic })
}
