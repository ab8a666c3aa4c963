//! Downloads of recordings, as files or as tables.
//!
//! Each download has a thread that reads the disk and waits for the client. The number of downloads is limited, and only a
//! few pieces are buffered for a slow client.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use percent_encoding::{NON_ALPHANUMERIC, utf8_percent_encode};
use shared::output::explained;
use shared::recording::{Disk, OpenFile};
use tokio::sync::{Semaphore, mpsc};

use super::refusal;

/// Largest number of concurrent downloads. The limit is low, because the memory of each thread is locked.
pub(super) const DOWNLOADS_MAX: usize = 2;
/// Capacity of the queue of a client, in pieces of [`PIECE_BYTES`].
const PIECES_MAX: usize = 4;
const PIECE_BYTES: usize = 64 << 10;

/// Limits the number of concurrent downloads. Clones share the limit.
#[derive(Clone)]
pub(super) struct Downloads(pub Arc<Semaphore>);

/// Description of a download.
pub(super) struct Download {
    /// File name that is suggested to the client.
    pub file_name: String,
    pub media_type: &'static str,
    /// Length, if known \[bytes\].
    pub length: Option<u64>,
}

impl Downloads {
    /// Sends the output of `write` to the client. If `write` fails before its end, the connection is aborted, so that the
    /// client notices that the file is incomplete.
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
                let error = explained(error.as_ref());
                // If the client has disconnected, the error is not needed.
                if pieces.blocking_send(Err(io::Error::other(error.clone()))).is_ok() {
                    tracing::warn!("a download was aborted: {error}");
                }
            }
            drop(permit);
        });
        let body = stream::unfold(taken, async |mut taken| Some((taken.recv().await?, taken)));
        let mut response = Body::from_stream(body).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, header::HeaderValue::from_static(what.media_type));
        if let Ok(value) = disposition(&what.file_name).parse() {
            headers.insert(header::CONTENT_DISPOSITION, value);
        }
        if let Some(length) = what.length {
            headers.insert(header::CONTENT_LENGTH, length.into());
        }
        response
    }

    /// Sends an unchanged file.
    pub fn send_file(&self, disk: Arc<dyn Disk>, file: File, file_name: String, length: u64) -> Response {
        let media_type = "application/octet-stream";
        let what = Download { file_name, media_type, length: Some(length) };
        self.send(&what, move |mut sink| {
            // Send at most the announced length, even if the file grows in the meantime.
            let copied = io::copy(&mut io::Read::take(OpenFile::new(&*disk, &file), length), &mut sink)?;
            anyhow::ensure!(copied == length, "the file has become shorter");
            Ok(())
        })
    }
}

/// Value of the header that suggests a file name (RFC 6266). Clients that do not know the second form use the first.
fn disposition(name: &str) -> String {
    let encoded = utf8_percent_encode(name, NON_ALPHANUMERIC);
    format!("attachment; filename=\"{}\"; filename*=UTF-8''{encoded}", plain(name))
}

/// Replaces characters, so that a file name is safe in a header and on every operating system.
fn plain(name: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_+.".contains(c);
    name.chars().map(|c| if is_plain(c) { c } else { '_' }).collect()
}

/// Sends what is written to the queue of the client.
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

#[cfg(test)]
mod tests {
    use super::disposition;

    #[test]
    fn letters_of_every_language_stay_in_the_name_of_a_download() {
        let expected = "attachment; filename=\"Pr_fling_1.mcap\"; filename*=UTF-8''Pr%C3%BCfling%201%2Emcap";
        assert_eq!(disposition("Prüfling 1.mcap"), expected);
    }
}
