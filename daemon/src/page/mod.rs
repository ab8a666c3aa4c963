//! The technician's web page, which is compiled into the program. It needs no network access and no build tool.

use std::io::Write;
use std::sync::Arc;

use axum::Router;
use axum::body::Bytes;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use flate2::Compression;
use flate2::write::GzEncoder;
use sha2::{Digest, Sha256};
use shared::config::BallBarConfig;
use shared::drawing;

/// Length of the digest with which a browser identifies its cached version of a file \[bytes\].
const TAG_BYTES: usize = 16;

/// Path, media type and content of each file.
const FILES: [(&str, &str, &str); 9] = [
    ("/", HTML, include_str!("index.html")),
    ("/style.css", CSS, include_str!("style.css")),
    ("/app.js", SCRIPT, include_str!("app.js")),
    ("/live.js", SCRIPT, include_str!("live.js")),
    ("/charts.js", SCRIPT, include_str!("charts.js")),
    ("/runs.js", SCRIPT, include_str!("runs.js")),
    ("/dialogs.js", SCRIPT, include_str!("dialogs.js")),
    ("/uplot/uPlot.iife.min.js", SCRIPT, include_str!("uplot/uPlot.iife.min.js")),
    ("/uplot/uPlot.min.css", CSS, include_str!("uplot/uPlot.min.css")),
];
const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// Text in the page that is replaced by the drawing of the bar.
const DRAWING_PLACEHOLDER: &str = "<!-- drawing of the bar -->";

/// Content security policy. It forbids content from other sites, inline scripts, and frames around the page.
const POLICY: HeaderValue = HeaderValue::from_static(
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self'; img-src 'self' data:; \
     base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
);

/// Creates a route for each file. The page contains a drawing of `bar`. With `no-cache`, a browser checks at each use whether
/// its cached file is still current, so a new version of the program is visible at once.
pub fn routes<S: Clone + Send + Sync + 'static>(bar: &BallBarConfig) -> Router<S> {
    let drawing = drawing::ball_bar(bar);
    FILES.iter().fold(Router::new(), |router, (path, media_type, text)| {
        let file = Arc::new(File::new(media_type, text.replace(DRAWING_PLACEHOLDER, &drawing)));
        router.route(path, get(move |headers: HeaderMap| async move { file.answer(&headers) }))
    })
}

/// One file of the page, with a compressed version.
struct File {
    media_type: &'static str,
    plain: Bytes,
    /// Empty if compression failed.
    compressed: Bytes,
    /// Weak, because both versions have the same tag (RFC 9110, section 8.8.1).
    tag: Option<HeaderValue>,
}

impl File {
    fn new(media_type: &'static str, plain: String) -> Self {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        let compressed = encoder.write_all(plain.as_bytes()).and_then(|()| encoder.finish());
        let digest = Sha256::digest(plain.as_bytes());
        let tag: String = digest.iter().take(TAG_BYTES).map(|byte| format!("{byte:02x}")).collect();
        Self {
            media_type,
            plain: plain.into(),
            compressed: compressed.unwrap_or_default().into(),
            tag: HeaderValue::from_str(&format!("W/\"{tag}\"")).ok(),
        }
    }

    fn answer(&self, request: &HeaderMap) -> Response {
        // Whether the list in a header of the request contains an item.
        let lists = |name: HeaderName, wanted: &[u8]| {
            let values = request.get_all(name).iter();
            let mut items = values.flat_map(|value| value.as_bytes().split(|byte| *byte == b','));
            items.any(|item| item.trim_ascii() == wanted)
        };
        let is_cached = self.tag.as_ref().is_some_and(|tag| lists(header::IF_NONE_MATCH, tag.as_bytes()));
        let is_compressed = !self.compressed.is_empty() && lists(header::ACCEPT_ENCODING, b"gzip");
        let headers = [
            (header::CONTENT_TYPE, HeaderValue::from_static(self.media_type)),
            (header::CONTENT_SECURITY_POLICY, POLICY),
            (header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
            (header::REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
            (header::CACHE_CONTROL, HeaderValue::from_static("no-cache")),
            (header::VARY, HeaderValue::from_static("accept-encoding")),
        ];
        let mut response = match (is_cached, is_compressed) {
            (true, _) => (StatusCode::NOT_MODIFIED, headers).into_response(),
            (_, true) => {
                let encoding = [(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"))];
                (headers, encoding, self.compressed.clone()).into_response()
            }
            _ => (headers, self.plain.clone()).into_response(),
        };
        response.headers_mut().extend(self.tag.clone().map(|tag| (header::ETAG, tag)));
        response
    }
}

#[cfg(test)]
mod tests;
