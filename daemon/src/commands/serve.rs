//! `ballbard run`: the acquisition service.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Args;
use shared::config::{self, BallBarConfig, DaemonConfig, HomingConfig};
use tokio::net::TcpListener;
use tokio::signal::unix::{SignalKind, signal};

use super::bus_choice;
use crate::control::api;
use crate::control::service::{Service, Settings};
use crate::run::BusChoice;
use crate::segment::faults::FaultWindow;

#[derive(Debug, Args)]
pub struct RunArguments {
    /// `simulated`, or a network interface such as eth1
    #[arg(long, default_value = "simulated")]
    bus: String,
    /// What goes wrong on the simulated bus, such as lost:0.01 or gone:3@10s-15s (an unknown one lists all); may be
    /// repeated
    #[arg(long = "fault", value_name = "FAULT[@FROM[-UNTIL]]")]
    faults: Vec<FaultWindow>,
    /// Directory for the recordings; default: `directory` of daemon.toml
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Port on 127.0.0.1, 0 for any that is free; default: `port` of daemon.toml
    #[arg(long)]
    port: Option<u16>,
    /// Directory with daemon.toml and ball_bar.toml
    #[arg(long, value_name = "DIR", default_value = "config")]
    config: PathBuf,
}

pub fn run(arguments: &RunArguments) -> anyhow::Result<()> {
    let mut daemon: DaemonConfig = config::load(&arguments.config.join("daemon.toml"))?;
    let bar: BallBarConfig = config::load(&arguments.config.join("ball_bar.toml"))?;
    if let Some(directory) = &arguments.out {
        daemon.directory.clone_from(directory);
    }
    let port = arguments.port.unwrap_or(daemon.port);
    let bus = bus_choice(&arguments.bus);
    let faults = arguments.faults.clone();
    if bus != BusChoice::Simulated && !faults.is_empty() {
        bail!(
            "--fault breaks the simulated bus, not {}; leave it out, or use `ballbard segment --fault`",
            arguments.bus
        );
    }
    let homing_file = arguments.config.join(HomingConfig::FILE_NAME);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start the service")?;
    runtime.block_on(serve(port, Settings { bus, faults, daemon, bar, homing_file }))
}

async fn serve(port: u16, settings: Settings) -> anyhow::Result<()> {
    let listener = TcpListener::bind(("127.0.0.1", port)).await.with_context(|| {
        format!(
            "cannot listen on 127.0.0.1:{port}; is another `ballbard run` there? stop it, or choose another port with \
             --port or in daemon.toml"
        )
    })?;
    println!("listening on http://{}", listener.local_addr()?);
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let service = Service::start(settings).context("cannot start the service's thread")?;
    let ending = service.clone();
    let end = async move {
        let name = tokio::select! {
            _ = interrupt.recv() => "Ctrl-C",
            _ = terminate.recv() => "SIGTERM",
        };
        ending.shutdown(&format!("stopped by {name}"));
        // The file comes before the answers: requests are served until it is finished.
        let joining = tokio::task::spawn_blocking(move || ending.join());
        if joining.await.is_err() {
            tracing::error!("the service did not end as it should");
        }
    };
    Ok(api::serve(listener, service, end).await?)
}
