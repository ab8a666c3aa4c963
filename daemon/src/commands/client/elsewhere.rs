//! Requests to a service on another machine, over TLS and with the token.
//!
//! The certificate of a measurement PC is self-signed, so no certificate authority can confirm it. Instead, the user
//! provides the fingerprint of the certificate. Nothing is sent before the server has proved that it owns the key of the
//! certificate with this fingerprint.
//!
//! `ureq` accepts a custom verifier of certificates only through its module `unversioned`, which minor versions may change.
//! Cargo.toml therefore pins the version.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use anyhow::{Context, bail};
use clap::Args;
use tokio_rustls::rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use tokio_rustls::rustls::crypto::{
    WebPkiSupportedAlgorithms, ring, verify_tls12_signature, verify_tls13_signature,
};
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use tokio_rustls::rustls::{
    self, ClientConfig, ClientConnection, DigitallySignedStruct, SignatureScheme, StreamOwned,
};
use ureq::SendBody;
use ureq::config::ConfigBuilder;
use ureq::http::Request;
use ureq::http::header::{AUTHORIZATION, HeaderValue};
use ureq::http::uri::{Scheme, Uri};
use ureq::middleware::MiddlewareNext;
use ureq::typestate::AgentScope;
use ureq::unversioned::resolver::DefaultResolver;
use ureq::unversioned::transport::{
    Buffers, ConnectionDetails, Connector, LazyBuffers, NextTimeout, TcpConnector, Transport,
    TransportAdapter,
};

use crate::control::api::{Fingerprint, token_in};

/// Options that name a service of another machine.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Connection")]
pub struct ElsewhereArguments {
    /// Use the service of another machine; `ballbard status` on that machine prints its URL, https://HOST:PORT
    #[arg(long, value_name = "URL", requires_all = ["token_file", "fingerprint"], conflicts_with_all = ["port", "config"])]
    service: Option<Address>,
    /// For --service: copy of the file `token` from the state directory of that service
    #[arg(long, value_name = "FILE", requires = "service")]
    token_file: Option<PathBuf>,
    /// For --service: fingerprint of that service's certificate; `ballbard status` on that machine prints it
    #[arg(long, value_name = "SHA256", requires = "service")]
    fingerprint: Option<Fingerprint>,
}

/// A service on another machine, from the command line.
pub struct Elsewhere<'a> {
    address: &'a Address,
    token_file: &'a Path,
    fingerprint: &'a Fingerprint,
}

/// Host and port of a service over TLS.
#[derive(Debug, Clone)]
struct Address(String);

impl ElsewhereArguments {
    /// The service that the options name; `None` for the service of this machine.
    pub fn named(&self) -> Option<Elsewhere<'_>> {
        let (address, token_file) = (self.service.as_ref()?, self.token_file.as_ref()?);
        Some(Elsewhere { address, token_file, fingerprint: self.fingerprint.as_ref()? })
    }
}

impl Elsewhere<'_> {
    pub fn url(&self, path: &str) -> String {
        format!("https://{}/api/{path}", self.address.0)
    }

    /// File with the token of the service.
    pub fn token_file(&self) -> &Path {
        self.token_file
    }

    /// Creates an agent that connects to this service only and sends the token with each request.
    pub fn agent(&self, config: ConfigBuilder<AgentScope>) -> anyhow::Result<ureq::Agent> {
        let mut bearer = HeaderValue::try_from(format!("Bearer {}", self.token()?))?;
        bearer.set_sensitive(true);
        let add_token = move |mut request: Request<SendBody>, next: MiddlewareNext| {
            request.headers_mut().insert(AUTHORIZATION, bearer.clone());
            next.handle(request)
        };
        let config = config.https_only(true).max_redirects(0).middleware(add_token).build();
        let connector = ().chain(TcpConnector::default()).chain(Pinned(self.tls()?));
        Ok(ureq::Agent::with_parts(config, connector, DefaultResolver::default()))
    }

    fn token(&self) -> anyhow::Result<String> {
        let file = self.token_file.display();
        let token = token_in(self.token_file).with_context(|| {
            format!("cannot read {file}; copy the file `token` of the service's state directory to it")
        })?;
        let Some(token) = token else {
            bail!(
                "{file}: invalid token (64 hexadecimal digits, readable by you only); copy the file `token` of the service's \
                 state directory again, then `chmod 600 {file}`"
            )
        };
        Ok(token)
    }

    fn tls(&self) -> anyhow::Result<Arc<ClientConfig>> {
        let provider = Arc::new(ring::default_provider());
        let pin = Pin {
            fingerprint: self.fingerprint.clone(),
            algorithms: provider.signature_verification_algorithms,
        };
        let config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .context("cannot speak TLS")?
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(pin))
            .with_no_client_auth();
        Ok(Arc::new(config))
    }
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let uri = text.parse::<Uri>().ok().filter(|uri| {
            uri.scheme() == Some(&Scheme::HTTPS) && matches!(uri.path(), "" | "/") && uri.query().is_none()
        });
        let authority =
            uri.as_ref().and_then(Uri::authority).filter(|authority| !authority.as_str().contains('@'));
        authority.map(|authority| Self(authority.to_string())).ok_or_else(|| {
            "write https://HOST:PORT as `ballbard status` on that machine prints it; for the service of this machine use \
             --port"
                .into()
        })
    }
}

/// Accepts only the certificate with this fingerprint, whatever names and dates it contains.
#[derive(Debug)]
struct Pin {
    fingerprint: Fingerprint,
    algorithms: WebPkiSupportedAlgorithms,
}

impl ServerCertVerifier for Pin {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let shown = Fingerprint::from_certificate(end_entity);
        if shown == self.fingerprint {
            return Ok(ServerCertVerified::assertion());
        }
        Err(rustls::Error::General(format!(
            "the certificate has the fingerprint {shown}, not {}, so nothing was sent; compare it with `ballbard status` on the \
             service's machine, and if it differs there, too, find out which machine answers here",
            self.fingerprint
        )))
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls12_signature(message, certificate, signed, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls13_signature(message, certificate, signed, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

/// Wraps a connection in TLS and accepts only the pinned certificate. The TLS of `ureq` cannot do this, because it checks
/// certificates only by authorities.
#[derive(Debug)]
struct Pinned(Arc<ClientConfig>);

impl<In: Transport> Connector<In> for Pinned {
    type Out = OverTls<In>;

    fn connect(
        &self,
        details: &ConnectionDetails,
        chained: Option<In>,
    ) -> Result<Option<OverTls<In>>, ureq::Error> {
        let Some(transport) = chained else { return Ok(None) };
        let tls_failed = |error: rustls::Error| ureq::Error::Other(tls_problem(&error).into());
        let host = details.uri.host().unwrap_or_default().trim_matches(['[', ']']).to_owned();
        let name = ServerName::try_from(host).map_err(|error| ureq::Error::Other(error.into()))?;
        let mut connection = ClientConnection::new(Arc::clone(&self.0), name).map_err(tls_failed)?;
        let mut socket = TransportAdapter::new(transport, Arc::clone(&details.current_time));
        socket.set_timeout(details.timeout);
        connection.complete_io(&mut socket).map_err(|error| {
            match error.get_ref().and_then(|inner| inner.downcast_ref()) {
                Some(inner) => ureq::Error::Other(tls_problem(inner).into()),
                None => error.into(),
            }
        })?;
        let config = details.config;
        let buffers = LazyBuffers::new(config.input_buffer_size(), config.output_buffer_size());
        Ok(Some(OverTls { buffers, stream: StreamOwned::new(connection, socket) }))
    }
}

/// Why the TLS connection failed.
fn tls_problem(error: &rustls::Error) -> String {
    match error {
        rustls::Error::General(text) => text.clone(),
        rustls::Error::InvalidMessage(_) => "the server does not use TLS; give the port of --listen".into(),
        error => error.to_string(),
    }
}

/// A connection over TLS, as `ureq` uses it.
struct OverTls<T: Transport> {
    buffers: LazyBuffers,
    stream: StreamOwned<ClientConnection, TransportAdapter<T>>,
}

impl<T: Transport> Transport for OverTls<T> {
    fn buffers(&mut self) -> &mut dyn Buffers {
        &mut self.buffers
    }

    fn transmit_output(&mut self, amount: usize, timeout: NextTimeout) -> Result<(), ureq::Error> {
        self.stream.get_mut().set_timeout(timeout);
        Ok(io::Write::write_all(&mut self.stream, &self.buffers.output()[..amount])?)
    }

    fn await_input(&mut self, timeout: NextTimeout) -> Result<bool, ureq::Error> {
        self.stream.get_mut().set_timeout(timeout);
        let amount = io::Read::read(&mut self.stream, self.buffers.input_append_buf())?;
        self.buffers.input_appended(amount);
        Ok(amount > 0)
    }

    fn is_open(&mut self) -> bool {
        self.stream.get_mut().get_mut().is_open()
    }

    fn is_tls(&self) -> bool {
        true
    }
}

impl<T: Transport> fmt::Debug for OverTls<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("OverTls").finish_non_exhaustive()
    }
}
