//! Access from other machines: over TLS or through a reverse proxy, in both cases with a token.
//!
//! A proxy connects to a separate Unix socket. On the loopback port, requests of a proxy could not be distinguished from
//! those of local programs: a proxy may send any value in the header `Host`, and many proxies send 127.0.0.1 by default.
//!
//! The token consists of 256 random bits and cannot be guessed. Wrong tokens are counted only to limit replies and log
//! lines. No route is accessible without the token. A browser stores the token as a cookie that scripts cannot read and
//! pages of other sites cannot send.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::net::SocketAddr;
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{Html, IntoResponse, Response};
use rand::Rng;
use rcgen::{CertifiedKey, generate_simple_self_signed};
use shared::time::MonoNs;
use subtle::ConstantTimeEq;
use tokio::net::{TcpListener, UnixListener};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, pem};
use tokio_rustls::rustls::{self, ServerConfig};

use super::fingerprint::{Fingerprint, hex};
use super::pairing::Pairing;
use super::refusal;

/// Name of the file with the token, in the state directory.
const TOKEN_FILE: &str = "token";
/// Names of the files with the self-signed certificate and its key.
const OWN_FILES: [&str; 2] = ["certificate.pem", "key.pem"];
const TOKEN_BYTES: usize = 32;
/// Up to this number of wrong tokens within [`WRONG_WITHIN`], the reply is that the token is wrong. For further wrong
/// tokens, the reply asks the client to wait.
const WRONG_MAX: usize = 10;
const WRONG_WITHIN: Duration = Duration::from_secs(60);
/// Name of the cookie. The prefix binds the cookie to this host, this path and TLS.
pub(super) const COOKIE: &str = "__Host-ballbard";
/// How long a browser stores the token, 30 days \[s\].
const COOKIE_AGE_S: u32 = 30 * 86_400;
const FORM: &str = include_str!("../../page/token.html");

/// Configuration of remote access.
#[derive(Debug, Clone, Default)]
pub struct RemoteSettings {
    /// Address and port of the TLS listener.
    pub listen: Option<SocketAddr>,
    /// Files with certificates and key \[PEM\]; `None` to use the self-signed certificate.
    pub certificate: Option<(PathBuf, PathBuf)>,
    /// Path of the Unix socket for a reverse proxy of this machine.
    pub proxy_socket: Option<PathBuf>,
}

/// Why remote access cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum RemoteError {
    /// The token or the self-signed certificate can be neither read nor created.
    #[error(
        "{0}: {1}; the service keeps token and certificate there; check the permissions of the directory"
    )]
    State(PathBuf, io::Error),
    /// The token file does not contain a valid token, or other users may read it.
    #[error(
        "{0}: invalid token (64 hexadecimal digits, readable by the owner only); remove it, and the next start makes one"
    )]
    Token(PathBuf),
    /// Certificate or key cannot be read.
    #[error("{0}: {1}; give PEM files that this user may read with --certificate and --key")]
    Pem(PathBuf, pem::Error),
    /// Certificate and key do not match.
    #[error("certificate and key are refused: {0}; give two that belong together")]
    Tls(#[from] rustls::Error),
    /// The self-signed certificate cannot be created.
    #[error("cannot make a certificate: {0}; give one with --certificate and --key")]
    Made(#[from] rcgen::Error),
    /// The address cannot be used.
    #[error("cannot listen on {0}: {1}; choose another address or port with --listen")]
    Listen(SocketAddr, io::Error),
    /// The Unix socket cannot be created.
    #[error("cannot listen on the socket {}: {error}; choose another path with --behind-proxy", path.display())]
    Socket {
        /// Absolute path of the socket.
        path: PathBuf,
        /// Error of the operating system.
        error: io::Error,
    },
}

/// Listeners and access check for other machines.
pub struct Remote {
    pub(super) gate: Gate,
    pub(super) tls: Option<TlsDoor>,
    pub(super) proxy: Option<ProxyDoor>,
    /// Text for people: address, fingerprint of the certificate, and file of the token.
    pub words: String,
}

/// The listener for other machines, and the TLS configuration of its connections.
pub(super) struct TlsDoor {
    pub listener: TcpListener,
    pub acceptor: TlsAcceptor,
}

/// The Unix socket of a reverse proxy. Dropping it removes the file of the socket.
pub(super) struct ProxyDoor {
    pub listener: UnixListener,
    path: PathBuf,
}

impl Remote {
    /// Opens the listeners. If the directory `state` contains no token or no certificate yet, they are created there.
    pub async fn open(settings: RemoteSettings, state: &Path) -> Result<Self, RemoteError> {
        let RemoteSettings { listen, certificate, proxy_socket } = settings;
        let token_file = state.join(TOKEN_FILE);
        let mut gate = Gate { token: token(&token_file)?, pairing: None, wrong: Mutex::default() };
        let mut words = Vec::new();
        let tls = match listen {
            Some(address) => {
                let refused = |error| RemoteError::Listen(address, error);
                let listener = TcpListener::bind(address).await.map_err(refused)?;
                let address = listener.local_addr().map_err(refused)?;
                let (acceptor, fingerprint) = tls(certificate, state)?;
                words.push(format!("https://{address}, certificate SHA-256 {fingerprint}"));
                gate.pairing = Some(Arc::new(Pairing::new(address, fingerprint)));
                Some(TlsDoor { listener, acceptor })
            }
            None => None,
        };
        let open = |path: PathBuf| {
            ProxyDoor::open(path.clone()).map_err(|error| RemoteError::Socket { path, error })
        };
        let proxy = proxy_socket.map(open).transpose()?;
        words.extend(proxy.iter().map(|proxy| format!("a reverse proxy on {}", proxy.path.display())));
        let words = format!("{}; the token is in {}", words.join(", and "), token_file.display());
        Ok(Self { gate, tls, proxy, words })
    }
}

impl ProxyDoor {
    fn open(path: PathBuf) -> io::Result<Self> {
        // A service that was killed leaves the file of its socket behind. Nothing listens on such a
        // socket, so remove the file.
        let is_socket = fs::symlink_metadata(&path).is_ok_and(|file| file.file_type().is_socket());
        if is_socket && UnixStream::connect(&path).is_err() {
            fs::remove_file(&path)?;
        }
        let listener = UnixListener::bind(&path)?;
        // The proxy runs as another user, so everybody may open the socket. Without the token nothing is accessible.
        fs::set_permissions(&path, fs::Permissions::from_mode(0o666))?;
        Ok(Self { listener, path })
    }
}

impl Drop for ProxyDoor {
    fn drop(&mut self) {
        // If the removal fails, the next start removes the file.
        let _ = fs::remove_file(&self.path);
    }
}

/// Checks each request from other machines.
pub(super) struct Gate {
    token: String,
    /// Single-use codes for phones, if the service listens for other machines.
    pub pairing: Option<Arc<Pairing>>,
    /// Times of the latest wrong tokens.
    wrong: Mutex<Vec<MonoNs>>,
}

impl Gate {
    /// Checks a request. Returns `None` if it is admitted. Returns a refusal if the origin is foreign or the token is missing
    /// or wrong. If the request logs a browser in, returns the response that stores the token.
    pub fn refuse(&self, request: &Request, now: MonoNs) -> Option<Response> {
        let headers = request.headers();
        let own_origin = single_value(headers, header::HOST).map(|host| format!("https://{host}"));
        let is_own =
            |origin: &HeaderValue| Some(origin.as_bytes()) == own_origin.as_ref().map(String::as_bytes);
        if own_origin.is_none() || !headers.get_all(header::ORIGIN).iter().all(is_own) {
            return Some(refusal(
                StatusCode::FORBIDDEN,
                "pages of other sites have no access; open the service's own page (a reverse proxy must pass on the browser's `Host`, \
                 in nginx with `proxy_set_header Host $http_host;`)",
            ));
        }
        let asks_for_page = request.method() == Method::GET && request.uri().path() == "/";
        let query = request.uri().query().unwrap_or_default();
        let code = query.split('&').find_map(|pair| pair.strip_prefix("pair=")).filter(|_| asks_for_page);
        if code.zip(self.pairing.as_ref()).is_some_and(|(code, pairing)| pairing.redeem(code, now)) {
            return Some(self.log_in());
        }
        let typed = asks_for_page.then(|| typed_token(query)).flatten();
        match typed.or_else(|| sent_token(headers)) {
            Some(token) if bool::from(token.as_bytes().ct_eq(self.token.as_bytes())) => {
                typed.map(|_| self.log_in())
            }
            sent => Some(self.refused(sent.is_some(), asks_for_page, now)),
        }
    }

    /// Response that stores the token in the browser and then loads the page without the token in the address.
    fn log_in(&self) -> Response {
        let cookie = format!(
            "{COOKIE}={}; Path=/; Max-Age={COOKIE_AGE_S}; Secure; HttpOnly; SameSite=Strict",
            self.token
        );
        // Not a redirection: if the redirection began on another site, the browser would not send the cookie.
        let headers = [
            (header::SET_COOKIE, cookie),
            (header::REFRESH, "0; url=/".into()),
            (header::CACHE_CONTROL, "no-store".into()),
            (header::REFERRER_POLICY, "no-referrer".into()),
        ];
        (headers, Html("<a href=\"/\">The page</a>")).into_response()
    }

    /// Refuses a request whose token is wrong or missing. A browser that requests the page gets a form for the token.
    fn refused(&self, is_wrong: bool, asks_for_page: bool, now: MonoNs) -> Response {
        const TOKEN_PLACE: &str = "it is in the file `token` of the service's state directory (`ballbard status` on its \
             machine shows it); open the page with /?token=TOKEN, or send it as `Authorization: Bearer TOKEN`";
        if is_wrong && self.has_too_many_wrong(now) {
            return refusal(
                StatusCode::TOO_MANY_REQUESTS,
                &format!(
                    "too many wrong tokens within a minute; wait for one, then send the right one: {TOKEN_PLACE}"
                ),
            );
        }
        let error = if is_wrong { "the token is wrong" } else { "the token is missing" };
        let mut response = refusal(StatusCode::UNAUTHORIZED, &format!("{error}; {TOKEN_PLACE}"));
        if asks_for_page {
            // Replace only headers and body, because the log needs the extensions of the response.
            let form = Html(FORM.replace("{error}", error)).into_response();
            let (parts, body) = form.into_parts();
            response.headers_mut().extend(parts.headers);
            response.headers_mut().remove(header::CONTENT_LENGTH);
            *response.body_mut() = body;
            const POLICY: HeaderValue = HeaderValue::from_static(
                "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
            );
            response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, POLICY);
        }
        response.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
        response
    }

    /// Returns whether too many wrong tokens were sent within [`WRONG_WITHIN`]. If not, counts this wrong token.
    fn has_too_many_wrong(&self, now: MonoNs) -> bool {
        let mut wrong = self.wrong.lock().unwrap_or_else(PoisonError::into_inner);
        wrong.retain(|at| now.ns_since(*at) < WRONG_WITHIN.as_nanos() as i64);
        let is_exceeded = wrong.len() >= WRONG_MAX;
        if !is_exceeded {
            wrong.push(now);
        }
        is_exceeded
    }
}

/// The value of a header; `None` unless the header occurs exactly once.
fn single_value(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    let mut values = headers.get_all(name).iter();
    let value = values.next()?.to_str().ok()?;
    values.next().is_none().then_some(value)
}

fn typed_token(query: &str) -> Option<&str> {
    query.split('&').find_map(|pair| pair.strip_prefix("token="))
}

fn sent_token(headers: &HeaderMap) -> Option<&str> {
    let bearer = single_value(headers, header::AUTHORIZATION).and_then(|value| value.split_once(' '));
    let bearer = bearer.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer")).map(|(_, token)| token);
    let cookies = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
    let mut cookies =
        cookies.flat_map(|value| value.split(';')).filter_map(|pair| pair.trim().split_once('='));
    bearer.or_else(|| cookies.find_map(|(name, value)| (name == COOKIE).then_some(value)))
}

/// Reads the token, or creates it if the file does not exist.
fn token(file: &Path) -> Result<String, RemoteError> {
    let failed = |error| RemoteError::State(file.into(), error);
    if !file.try_exists().map_err(failed)? {
        let bytes: [u8; TOKEN_BYTES] = rand::rng().random();
        write_private(file, &hex(&bytes, "")).map_err(failed)?;
    }
    token_in(file).map_err(failed)?.ok_or_else(|| RemoteError::Token(file.into()))
}

/// The token in a file; `None` if the token is incomplete or the file is readable for others than its owner.
pub fn token_in(file: &Path) -> io::Result<Option<String>> {
    let text = fs::read_to_string(file)?;
    let mode = fs::metadata(file)?.permissions().mode();
    let token = text.trim();
    let is_whole = token.len() == 2 * TOKEN_BYTES && token.bytes().all(|byte| byte.is_ascii_hexdigit());
    Ok((is_whole && mode & 0o077 == 0).then(|| token.into()))
}

/// Returns the TLS configuration and the fingerprint of its certificate.
fn tls(
    certificate: Option<(PathBuf, PathBuf)>,
    state: &Path,
) -> Result<(TlsAcceptor, Fingerprint), RemoteError> {
    let (certificate_file, key_file) = match certificate {
        Some(files) => files,
        None => own_certificate(state)?,
    };
    let unread = |file: &Path, error| RemoteError::Pem(file.into(), error);
    let certificates = CertificateDer::pem_file_iter(&certificate_file)
        .and_then(Iterator::collect::<Result<Vec<_>, _>>)
        .map_err(|error| unread(&certificate_file, error))?;
    let first = certificates.first().ok_or_else(|| unread(&certificate_file, pem::Error::NoItemsFound))?;
    let fingerprint = Fingerprint::from_certificate(first);
    let key = PrivateKeyDer::from_pem_file(&key_file).map_err(|error| unread(&key_file, error))?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()?
        .with_no_client_auth()
        .with_single_cert(certificates, key)?;
    Ok((TlsAcceptor::from(Arc::new(config)), fingerprint))
}

/// Returns the files of the self-signed certificate and its key. They are created only once, so that
/// people recognise the fingerprint.
fn own_certificate(state: &Path) -> Result<(PathBuf, PathBuf), RemoteError> {
    let [certificate, key] = OWN_FILES.map(|name| state.join(name));
    let failed = |file: &Path| {
        let file = file.to_owned();
        move |error| RemoteError::State(file, error)
    };
    // The key is written first, so the key exists if the certificate exists.
    if !certificate.try_exists().map_err(failed(&certificate))? {
        let CertifiedKey { cert, signing_key } = generate_simple_self_signed(["ballbard".to_owned()])?;
        write_private(&key, &signing_key.serialize_pem()).map_err(failed(&key))?;
        write_private(&certificate, &cert.pem()).map_err(failed(&certificate))?;
    }
    Ok((certificate, key))
}

/// Writes a file that only its owner may read. The file is written completely or not at all.
fn write_private(file: &Path, text: &str) -> io::Result<()> {
    if let Some(directory) = file.parent() {
        fs::create_dir_all(directory)?;
    }
    let temporary = file.with_extension("new");
    // Remove the temporary file of an earlier start that was killed while writing.
    match fs::remove_file(&temporary) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut open = OpenOptions::new();
    let mut written = open.write(true).create_new(true).mode(0o600).open(&temporary)?;
    written.write_all(text.as_bytes())?;
    written.sync_all()?;
    fs::rename(&temporary, file)
}

#[cfg(test)]
mod tests {
    use axum::body::Body;
    use shared::time::NS_PER_S;

    use super::*;

    #[test]
    fn ten_wrong_tokens_within_a_minute_are_called_wrong_and_further_ones_must_wait() {
        let gate = Gate { token: "right".into(), pairing: None, wrong: Mutex::default() };
        let answered = |seconds: i64, token: &str| {
            let request = Request::builder().uri("/api/status").header(header::HOST, "cell:7312");
            let request = request.header(header::AUTHORIZATION, format!("Bearer {token}"));
            let now = MonoNs(seconds * NS_PER_S);
            gate.refuse(&request.body(Body::empty()).unwrap(), now).map(|response| response.status())
        };
        let wrong = |seconds| answered(seconds, "wrong");
        assert!((0..10).all(|second| wrong(second) == Some(StatusCode::UNAUTHORIZED)));
        assert_eq!([wrong(10), wrong(59)], [Some(StatusCode::TOO_MANY_REQUESTS); 2]);
        assert_eq!(answered(59, "right"), None);
        // The first wrong token is a minute old, the second is more recent.
        assert_eq!(wrong(60), Some(StatusCode::UNAUTHORIZED));
        assert_eq!(wrong(60), Some(StatusCode::TOO_MANY_REQUESTS));
    }
}
