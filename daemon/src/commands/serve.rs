//! `ballbard run`: starts the acquisition service with its listeners. A signal ends the service after the file of the
//! current run has been finished.

use std::future::Future;
use std::net::SocketAddr;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use shared::output::say;
use tokio::net::TcpListener;

use super::bus_choice;
use super::configuration::{ConfigurationFiles, StateDirectory};
use super::fault::FaultParser;
use super::signals::Signals;
use crate::control::api::{self, Remote, RemoteSettings};
use crate::control::live_tap::LiveTap;
use crate::control::service::{Service, ServiceError, Settings};
use crate::control::status::Status;
use crate::run::BusChoice;
use crate::scheduler::STACK_BYTES;
use crate::segment::faults::FaultWindow;

/// Period of log lines that explain why the service has not ended yet, once its end was requested.
const PATIENCE: Duration = Duration::from_secs(2);
/// Largest number of tokio's threads for blocking work. Two are needed for downloads and one for the line on standard output;
/// the others are a reserve. The number is low, because the memory of these threads is locked permanently.
const BLOCKING_THREADS_MAX: usize = 8;

#[derive(Debug, Args)]
pub struct RunArguments {
    /// Network interface to which the coupler is connected, such as eth1; `simulated` serves generated data without hardware
    #[arg(long, help_heading = "Connection", value_name = "INTERFACE")]
    bus: Option<String>,
    /// Inject a fault into the simulated bus, such as lost:0.01 or gone:3@10s-15s (repeatable; `list` prints all
    /// faults)
    #[arg(long = "fault", help_heading = "Simulation", value_name = "FAULT[@FROM[-UNTIL]]",
        value_parser = FaultParser)]
    faults: Vec<FaultWindow>,
    /// Directory for the recordings; default: `directory` of daemon.toml
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: Option<PathBuf>,
    /// Port on 127.0.0.1; 0 selects a free port; default: `port` of daemon.toml
    #[arg(long, help_heading = "Connection")]
    port: Option<u16>,
    /// Accept remote clients on this address (TLS, token from the state directory)
    #[arg(long, help_heading = "Connection", value_name = "ADDRESS:PORT")]
    listen: Option<SocketAddr>,
    /// Certificate chain for --listen (PEM); default: a self-signed certificate in the state directory
    #[arg(long, help_heading = "Connection", value_name = "FILE", requires_all = ["listen", "key"])]
    certificate: Option<PathBuf>,
    /// Private key of --certificate (PEM)
    #[arg(long, help_heading = "Connection", value_name = "FILE", requires = "certificate")]
    key: Option<PathBuf>,
    /// Accept remote clients through a reverse proxy on this machine. The proxy handles TLS and forwards requests to this
    /// Unix socket (token from the state directory)
    #[arg(long, help_heading = "Connection", value_name = "SOCKET", value_parser = socket_path)]
    behind_proxy: Option<PathBuf>,
    /// Publish runs for Foxglove while they are recorded, at ws://127.0.0.1:PORT/foxglove (wss:// with --listen)
    #[arg(long, help_heading = "Connection")]
    foxglove: bool,
    /// Additional allowed origin for /foxglove, such as https://app.foxglove.dev (repeatable)
    #[arg(long, help_heading = "Connection", value_name = "ORIGIN", requires = "foxglove",
        value_parser = web_origin)]
    foxglove_origin: Vec<String>,
    #[command(flatten)]
    state: StateDirectory,
    #[command(flatten)]
    configuration: ConfigurationFiles,
}

pub fn run(arguments: &RunArguments) -> anyhow::Result<()> {
    let bus = bus_choice(arguments.bus.as_deref())?;
    let (mut daemon, bar) = (arguments.configuration.daemon()?, arguments.configuration.ball_bar()?);
    let marks_file = arguments.configuration.marks_file(&arguments.state, &daemon);
    tracing::info!("configuration: {}", arguments.configuration.origin());
    if let Some(directory) = &arguments.out {
        daemon.directory.clone_from(directory);
    }
    // Make the paths absolute, because they are shown to processes with another working directory.
    for directory in [&mut daemon.directory, &mut daemon.spare_directory] {
        *directory = std::path::absolute(&directory).context("cannot determine the working directory")?;
    }
    let port = arguments.port.unwrap_or(daemon.port);
    let faults = arguments.faults.clone();
    if let (BusChoice::Interface(name), false) = (&bus, faults.is_empty()) {
        bail!("--fault needs the simulated bus, not {name}; omit it, or use `ballbard segment --fault`");
    }
    FaultWindow::ensure_effective(&faults, bar.encoders.len())?;
    let live_tap = arguments.foxglove.then(|| LiveTap::new(arguments.foxglove_origin.clone()));
    let settings = Settings { bus, faults, daemon, bar, marks_file, live_tap };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(BLOCKING_THREADS_MAX)
        .thread_stack_size(STACK_BYTES)
        .build()
        .context("cannot start the service")?;
    let listener = runtime.block_on(listen(port))?;
    let remote = runtime.block_on(arguments.remote())?;
    let signals = runtime.block_on(async { Signals::new() })?;
    let service = Service::start(settings)?;
    let outcome = supervise(&runtime, &service, serve(listener, remote, service.clone(), signals));
    // Do not wait for threads that still read a slow disk for a client that has disconnected.
    runtime.shutdown_background();
    outcome
}

/// Parses an absolute path. The path must be absolute, because the proxy has another working directory. This also detects a
/// host name that was given by mistake.
fn socket_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    if path.is_absolute() {
        Ok(path)
    } else {
        Err("give an absolute path, such as /run/ballbard/proxy.sock".into())
    }
}

/// Parses a web origin in the form in which browsers send it. Any other text would never admit a page.
fn web_origin(text: &str) -> Result<String, String> {
    let is_allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "+-._:[]".contains(c);
    let is_part = |part: &str| !part.is_empty() && part.chars().all(is_allowed);
    if text.split_once("://").is_some_and(|(scheme, host)| is_part(scheme) && is_part(host)) {
        Ok(text.to_owned())
    } else {
        Err("give scheme and host in lower case without a path, such as https://app.foxglove.dev".into())
    }
}

impl RunArguments {
    /// Opens the access for other machines; `None` if it was not requested.
    async fn remote(&self) -> anyhow::Result<Option<Remote>> {
        if self.listen.is_none() && self.behind_proxy.is_none() {
            return Ok(None);
        }
        let certificate = self.certificate.clone().zip(self.key.clone());
        let settings =
            RemoteSettings { listen: self.listen, certificate, proxy_socket: self.behind_proxy.clone() };
        let remote = Remote::open(settings, &self.state.directory()).await?;
        tracing::info!("remote access: {}", remote.words);
        Ok(Some(remote))
    }
}

async fn listen(port: u16) -> anyhow::Result<TcpListener> {
    let listener = TcpListener::bind(("127.0.0.1", port)).await.with_context(|| {
        format!(
            "cannot listen on 127.0.0.1:{port}; is another `ballbard run` active? stop it, or choose another port with \
             --port or in daemon.toml"
        )
    })?;
    let address = listener.local_addr()?;
    // Print in another thread, because the standard output may block and the service must not wait for it.
    tokio::task::spawn_blocking(move || {
        if let Err(error) = say(format_args!("listening on http://{address}")) {
            tracing::warn!("{error}");
        }
    });
    Ok(listener)
}

/// Serves clients until the service has ended, because of a signal or a failure.
async fn serve(listener: TcpListener, remote: Option<Remote>, service: Service, mut signals: Signals) {
    tokio::spawn(super::systemd::notify(service.clone()));
    let ending = service.clone();
    let end = async move {
        tokio::select! {
            () = ending.ended() => return,
            name = signals.next() => ending.shutdown(&format!("stopped by {name}")),
        }
        // The program ends only when the file is finished. Clients are served until then.
        while tokio::time::timeout(PATIENCE, ending.ended()).await.is_err() {
            let Status { run, reason, .. } = ending.status();
            let what = run.map_or("the bus is closed".into(), |run| {
                format!("run `{}` is on disk, so far {} cycles", run.name, run.cycles)
            });
            tracing::warn!("not ended yet: waiting until {what}; {}", reason.unwrap_or_default());
        }
    };
    api::serve(listener, remote, service, end).await;
}

/// Runs `serving`. If a thread dies, the file of the run is still finished, and the program ends with an
/// error, so that a service manager restarts it.
fn supervise(
    runtime: &tokio::runtime::Runtime,
    service: &Service,
    serving: impl Future<Output = ()>,
) -> anyhow::Result<()> {
    let served = catch_unwind(AssertUnwindSafe(|| runtime.block_on(serving)));
    if served.is_err() {
        service.shutdown("the thread that answers requests has ended; the log shows why");
    }
    service.join()?;
    served.map_err(|_| ServiceError::Died.into())
}

#[cfg(test)]
mod tests {
    use shared::recording::Recording;

    use super::*;
    use crate::control::service::tests::{record, simulated};

    #[test]
    fn an_origin_that_no_browser_sends_is_refused() {
        for origin in ["https://app.foxglove.dev", "http://127.0.0.1:8080", "http://[::1]:8080"] {
            assert_eq!(web_origin(origin).as_deref(), Ok(origin));
        }
        let page = "https://app.foxglove.dev/";
        for text in ["", "foo bar", "app.foxglove.dev", "https://", "https://a b", "HTTPS://App.dev", page] {
            assert!(web_origin(text).is_err(), "{text}");
        }
    }

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
    }

    #[test]
    fn when_the_thread_that_answers_dies_the_file_is_finished_and_the_program_fails() {
        let directory = tempfile::tempdir().unwrap();
        let (service, _) = simulated(directory.path());
        record(&service, "cut");
        assert!(supervise(&runtime(), &service, async { panic!("the test ends this thread") }).is_err());
        let recording = Recording::open(&directory.path().join("cut.mcap")).unwrap();
        assert!(recording.end.cause.contains("thread that answers"), "{}", recording.end.cause);
    }

    #[test]
    fn when_the_control_dies_serving_ends_and_the_program_fails() {
        let directory = tempfile::tempdir().unwrap();
        let (service, _) = simulated(directory.path());
        record(&service, "cut");
        let runtime = runtime();
        let listener = runtime.block_on(TcpListener::bind(("127.0.0.1", 0))).unwrap();
        let signals = runtime.block_on(async { Signals::new() }).unwrap();
        service.kill_control();
        assert!(supervise(&runtime, &service, serve(listener, None, service.clone(), signals)).is_err());
        assert!(directory.path().join("cut.mcap").exists());
    }
}
