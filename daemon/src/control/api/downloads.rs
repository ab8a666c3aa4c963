//! Downloads of recordings, as files or as tables.
//!
//! Each has a thread that reads the disk and waits for the client. Few run at a time, and little is buffered for a slow client.

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

/// Downloads at a time: the memory of each thread is locked.
pub(super) const DOWNLOADS_MAX: usize = 2;
/// Pieces in the queue of a client.
const PIECES_MAX: usize = 4;
const PIECE_BYTES: usize = 64 << 10;

/// Limits the downloads. Clones share the limit.
#[derive(Clone)]
pub(super) struct Downloads(pub Arc<Semaphore>);

/// Description of a download.
pub(super) struct Download {
    /// File name that the client is offered.
    pub file_name: String,
    pub media_type: &'static str,
    /// Length, if known \[bytes\].
    pub length: Option<u64>,
}

impl Downloads {
    /// Sends the output of `write`. If that fails half-way the connection is aborted, so that no client mistakes a part for all.
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
                // The client may have disconnected.
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
    pub fn send_file(&self, disk: Arc<dyn Disk>, file: File, file_name: String, length: u64) -> Response {
        let media_type = "application/octet-stream";
        let what = Download { file_name, media_type, length: Some(length) };
        self.send(&what, move |mut sink| {
            // Never more than the announced length, even if the file changes.
            let copied = io::copy(&mut io::Read::take(OpenFile::new(&*disk, &file), length), &mut sink)?;
            anyhow::ensure!(copied == length, "the file has become shorter");
            Ok(())
        })
    }
}

/// A file name that is safe in a header and on every system.
fn plain(name: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_+.".contains(c);
    name.chars().map(|c| if is_plain(c) { c } else { '_' }).collect()
}

/// Sends pieces to the client.
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
