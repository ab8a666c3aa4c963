//! `ballbard home`: determines the reference marks of all encoders while a person turns one joint at a time.

use std::sync::Arc;
use std::time::Duration;

use anyhow::bail;
use clap::Args;
use shared::output::{explained, say};
use shared::recording::SystemDisk;

use super::client::text::SIMULATED;
use super::client::{NoService, ServiceArguments};
use super::configuration::StateDirectory;
use super::{Format, bus_choice, on_signal};
use crate::clock::Clock;
use crate::control::controller::homing::Homing;
use crate::control::status::{Granted, HomeRequest, HomingStatus, Reply, Status, StopRequest};
use crate::run::{self, RunRequest, Setup, Stop, Storage};
use crate::scheduler::{Scheduler, Threads};

/// Period of polling the progress.
const POLL: Duration = Duration::from_millis(200);

#[derive(Debug, Args)]
pub struct HomeArguments {
    /// Home without a service, on the network interface to which the coupler is connected, such as eth1, or on `simulated`,
    /// where the joints turn automatically. Default: home on the bus of the running service
    #[arg(long, help_heading = "Connection", value_name = "INTERFACE", conflicts_with = "service")]
    bus: Option<String>,
    #[command(flatten)]
    state: StateDirectory,
    #[command(flatten)]
    service: ServiceArguments,
}

pub fn run(arguments: HomeArguments) -> anyhow::Result<()> {
    let stop = Stop::default();
    let scheduler = Threads::on(Clock::Real);
    let work = async {
        match &arguments.bus {
            Some(bus) => on_own_bus(&scheduler, bus, &arguments.service, &arguments.state, &stop).await,
            None if arguments.state.is_given() => {
                bail!("--state needs --bus; the running service has its own --state")
            }
            None => by_service(&*scheduler, &arguments.service, &stop).await,
        }
    };
    on_signal(work, |signal| stop.stop(signal))
}

async fn by_service(
    scheduler: &dyn Scheduler,
    service: &ServiceArguments,
    stop: &Stop,
) -> anyhow::Result<()> {
    let reply: Reply = service.post("home", &HomeRequest {}).map_err(|error| {
        if error.is::<NoService>() {
            error.context("to home without a service, add --bus INTERFACE")
        } else {
            error
        }
    })?;
    let is_ours = reply.answer == Granted::Begun;
    if !is_ours && !service.format.json {
        say("another client is homing the encoders already; its progress follows")?;
    }
    let mut printer = Printer::new(service.format, reply.simulated)?;
    let mut stop_requested = false;
    loop {
        let status: Status = service.get("status")?;
        let Some(homing) = status.homing else {
            bail!("the service has no homing any more; was it restarted?")
        };
        // Stop if nothing can be printed, because the person would see no instructions.
        if let Err(error) = printer.print(&homing) {
            stop.stop(&explained(error.as_ref()));
        }
        if homing.is_over {
            return outcome(homing);
        }
        if stop.is_stopped() && !is_ours {
            bail!("{}: the homing of the other client continues; `ballbard stop` ends it", stop.cause());
        }
        if stop.is_stopped() && !stop_requested {
            stop_requested = true;
            let _: Reply = service.post("stop", &StopRequest { cause: Some(stop.cause()) })?;
        }
        scheduler.sleep(POLL).await;
    }
}

async fn on_own_bus(
    scheduler: &Arc<dyn Scheduler>,
    bus: &str,
    service: &ServiceArguments,
    state: &StateDirectory,
    stop: &Stop,
) -> anyhow::Result<()> {
    let configuration = service.configuration();
    let (daemon, bar) = (configuration.daemon()?, configuration.ball_bar()?);
    let marks = configuration.marks_file(state, &daemon);
    if let Some(problem) = marks.problem(&SystemDisk) {
        bail!("{problem}");
    }
    let request = RunRequest { bus: bus_choice(Some(bus))?, ..RunRequest::default() };
    let storage = Storage::new(&daemon, &**scheduler)?;
    let setup = Setup { scheduler: Arc::clone(scheduler), storage, daemon, bar };
    let session = run::open_with_retry(&setup, &request, stop).await?;
    session.log();
    let mut printer = Printer::new(service.format, session.is_simulated())?;
    let mut homing = Homing::begin(&session);
    while !homing.poll(&marks) {
        if let Err(error) = printer.print(homing.status()) {
            stop.stop(&explained(error.as_ref()));
        }
        if stop.is_stopped() {
            homing.stop(&stop.cause());
        }
        scheduler.sleep(POLL).await;
    }
    let printed = printer.print(homing.status());
    session.close().await?;
    printed?;
    outcome(homing.status().clone())
}

fn outcome(status: HomingStatus) -> anyhow::Result<()> {
    match status.error {
        Some(error) => bail!(error),
        None => Ok(()),
    }
}

/// Prints changes of the status: new lines as text for people, or each status as a line of JSON.
struct Printer {
    format: Format,
    printed: HomingStatus,
}

impl Printer {
    fn new(format: Format, is_simulated: bool) -> anyhow::Result<Self> {
        if is_simulated && !format.json {
            say(SIMULATED)?;
        }
        Ok(Self { format, printed: HomingStatus::default() })
    }

    fn print(&mut self, status: &HomingStatus) -> anyhow::Result<()> {
        if *status == self.printed {
            return Ok(());
        }
        let before = std::mem::replace(&mut self.printed, status.clone());
        if self.format.json {
            return Ok(say(serde_json::to_string(status)?)?);
        }
        for line in status.lines.iter().skip(before.lines.len()) {
            say(line)?;
        }
        if let Some(turned_deg) =
            status.turned_deg.filter(|turned_deg| Some(*turned_deg) != before.turned_deg)
        {
            say(format_args!("  turned {turned_deg:+.1} degrees"))?;
        }
        Ok(())
    }
}
