//! Commands that use a running service, on this machine over HTTP or on another machine over TLS ([`elsewhere`]).
//! [`ServiceArguments`] contains the address of the service, sends a request, and reads the reply or the refusal.

mod elsewhere;
pub mod export;
pub mod requests;
pub mod text;

use std::io::Read;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use serde::Serialize;
use serde::de::DeserializeOwned;
use shared::config::DaemonConfig;
use shared::recording::SystemDisk;
use ureq::http::StatusCode;

use super::Format;
use super::configuration::ConfigurationFiles;
use crate::control::recordings::runs::{self, RunLine};
use crate::control::status::Refusal;
use elsewhere::ElsewhereArguments;

/// Time limit of a request. It is longer than the service takes to finish a file on a slow disk.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Address of the service.
#[derive(Debug, Args)]
pub struct ServiceArguments {
    #[command(flatten)]
    configuration: ConfigurationFiles,
    /// Port of the service; default: `port` of daemon.toml
    #[arg(long, help_heading = "Connection")]
    port: Option<u16>,
    #[command(flatten)]
    elsewhere: ElsewhereArguments,
    #[command(flatten)]
    pub format: Format,
}

/// Lists the recordings of this directory, which must exist, and of the spare directory.
fn listed_in(directory: &Path, spare: Option<&Path>) -> anyhow::Result<Vec<RunLine>> {
    let directories: Vec<_> = std::iter::once(directory).chain(spare).map(Path::to_owned).collect();
    std::fs::read_dir(directory)
        .and_then(|_| runs::list(&SystemDisk, &directories))
        .with_context(|| format!("cannot list recordings in {}", directory.display()))
}

/// No service replies at the address.
#[derive(Debug, thiserror::Error)]
#[error("no answer from {url} ({why}); {remedy}")]
pub struct NoService {
    url: String,
    why: ureq::Error,
    remedy: String,
}

impl ServiceArguments {
    /// Where the configuration comes from.
    pub fn configuration(&self) -> &ConfigurationFiles {
        &self.configuration
    }

    /// Recordings of the running service. If no service is running, those of the configured directory.
    pub fn runs(&self) -> anyhow::Result<Vec<RunLine>> {
        match self.get("runs") {
            Err(error) if self.is_default() && error.is::<NoService>() => {
                let DaemonConfig { directory, spare_directory, .. } = self.configuration.daemon()?;
                listed_in(&directory, Some(&spare_directory))
            }
            outcome => outcome,
        }
    }

    /// Sends a request that changes nothing.
    pub fn get<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        self.answer(path, |agent, url| agent.get(url).call(), read_json)
    }

    /// Fetches a file from a service on another machine. Local files are read directly instead.
    pub fn fetch<T>(
        &self,
        path: &str,
        read: impl FnOnce(&mut dyn Read) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let get = |agent: &ureq::Agent, url: &str| {
            // Limit the duration of pauses instead of the total time, because a file may be large.
            agent.get(url).config().timeout_global(None).timeout_per_read(Some(TIMEOUT)).build().call()
        };
        self.answer(path, get, |mut response| {
            read(&mut response.body_mut().with_config().limit(u64::MAX).reader())
        })
    }

    /// Sends a request that changes something.
    pub fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> anyhow::Result<T> {
        self.answer(path, |agent, url| agent.post(url).send_json(body), read_json)
    }

    /// Whether the service is on another machine.
    pub fn is_elsewhere(&self) -> bool {
        self.elsewhere.named().is_some()
    }

    /// Whether the command line names neither a port nor a service on another machine.
    fn is_default(&self) -> bool {
        self.port.is_none() && !self.is_elsewhere()
    }

    /// Sends a request. If it was granted, reads the reply, otherwise returns the refusal as an error.
    fn answer<T>(
        &self,
        path: &str,
        ask: impl FnOnce(&ureq::Agent, &str) -> Result<Response, ureq::Error>,
        read: impl FnOnce(Response) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let (agent, url) = self.agent_and_url(path)?;
        let mut response = match ask(&agent, &url) {
            Ok(response) => response,
            Err(ureq::Error::Other(why)) => bail!("{url}: {why}"),
            Err(why) => return Err(NoService { url, why, remedy: self.remedy() }.into()),
        };
        let status = response.status();
        if status.is_success() {
            return read(response);
        }
        let refused = response.body_mut().read_json::<Refusal>();
        let error = refused.map_or_else(|_| format!("the service replied {status}"), |refusal| refusal.error);
        match self.elsewhere.named() {
            Some(elsewhere) if status == StatusCode::UNAUTHORIZED => {
                bail!("{url} refuses the token in {}: {error}", elsewhere.token_file().display())
            }
            _ => bail!(error),
        }
    }

    fn agent_and_url(&self, path: &str) -> anyhow::Result<(ureq::Agent, String)> {
        let config = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .proxy(None)
            .timeout_global(Some(TIMEOUT));
        if let Some(elsewhere) = self.elsewhere.named() {
            return Ok((elsewhere.agent(config)?, elsewhere.url(path)));
        }
        let port = match self.port {
            Some(port) => port,
            None => self.configuration.daemon()?.port,
        };
        Ok((config.build().into(), format!("http://127.0.0.1:{port}/api/{path}")))
    }

    /// Advice for the user if no service replies at the address.
    fn remedy(&self) -> String {
        if self.is_elsewhere() {
            return "check that `ballbard run --listen` is running there, that its `ballbard status` prints this address, and the \
                    network in between"
                .into();
        }
        let start = "is the service running? start it with `ballbard run --bus INTERFACE";
        match self.port {
            Some(port) => format!("{start} --port {port}`, or correct --port"),
            None => format!(
                "{start}` (port of {}; --port sets another, --service another machine)",
                self.configuration.origin()
            ),
        }
    }
}

type Response = ureq::http::Response<ureq::Body>;

fn read_json<T: DeserializeOwned>(mut response: Response) -> anyhow::Result<T> {
    let answer = response.body_mut().read_json();
    answer.context("the service's reply is invalid; are both programs of the same version?")
}
