//! Recordings on their way to a client, as they are or as a table.
//!
//! A thread for each reads the disk and waits for the client; few may go on at a time, and nothing is held in memory for a
//! client that is slow.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use shared::output::explained;
use shared::recording::{Disk, OpenFile};
use tokio::sync::{Semaphore, mpsc};

use super::refusal;

/// Downloads at a time: each has a thread, whose memory is locked.
const DOWNLOADS_MAX: usize = 2;
/// Pieces that wait for the client.
const PIECES_MAX: usize = 4;
const PIECE_BYTES: usize = 64 << 10;

/// Those that may go on. Clones are the same.
#[derive(Clone)]
pub(super) struct Downloads(Arc<Semaphore>);

impl Default for Downloads {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(DOWNLOADS_MAX)))
    }
}

/// What is sent.
pub(super) struct Download {
    /// What the client is to call it.
    pub file_name: String,
    /// Its kind.
    pub media_type: &'static str,
    /// Its length, where it is known \[bytes\].
    pub length: Option<u64>,
}

impl Downloads {
    /// Sends what `write` gives. If that fails half-way the connection is cut, so that no client takes a part for all.
    pub fn send(
        &self,
        what: &Download,
        write: impl FnOnce(&mut dyn Write) -> anyhow::Result<()> + Send + 'static,
    ) -> Response {
        let Ok(permit) = Arc::clone(&self.0).try_acquire_owned() else {
            return refusal(
                StatusCode::SERVICE_UNAVAILABLE,
                "other recordings are being downloaded; try again when they are done",
            );
        };
        let (pieces, taken) = mpsc::channel(PIECES_MAX);
        tokio::task::spawn_blocking(move || {
            let mut sink = BufWriter::with_capacity(PIECE_BYTES, Pipe(pieces.clone()));
            let written = write(&mut sink).and_then(|()| Ok(sink.flush()?));
            if let Err(error) = written {
                // Nobody is there to be told where the client has gone.
                let _ = pieces.blocking_send(Err(io::Error::other(explained(error.as_ref()))));
            }
            drop(permit);
        });
        let body = stream::unfold(taken, async |mut taken| Some((taken.recv().await?, taken)));
        let mut response = Body::from_stream(body).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, header::HeaderValue::from_static(what.media_type));
        let disposition = format!("attachment; filename=\"{}\"", plain(&what.file_name));
        if let Ok(value) = disposition.parse() {
            headers.insert(header::CONTENT_DISPOSITION, value);
        }
        if let Some(length) = what.length {
            headers.insert(header::CONTENT_LENGTH, length.into());
        }
        response
    }

    /// Sends a file as it is.
    pub fn send_file(&self, disk: Arc<dyn Disk>, file: File, what: &Download, length: u64) -> Response {
        self.send(what, move |mut sink| {
            // Never more than was promised, whatever happens to the file.
            let copied = io::copy(&mut io::Read::take(OpenFile::new(&*disk, &file), length), &mut sink)?;
            anyhow::ensure!(copied == length, "the file has become shorter");
            Ok(())
        })
    }
}

/// A name that no client takes for anything but a name.
fn plain(name: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_+.".contains(c);
    name.chars().map(|c| if is_plain(c) { c } else { '_' }).collect()
}

/// To the client, piece by piece.
struct Pipe(mpsc::Sender<io::Result<Bytes>>);

impl Write for Pipe {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        let sent = self.0.blocking_send(Ok(Bytes::copy_from_slice(buffer)));
        sent.map(|()| buffer.len()).map_err(|_| io::ErrorKind::BrokenPipe.into())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
