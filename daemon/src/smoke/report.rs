//! Report of a smoke test, which the user sends to the developers as a file, and its figures as text.

use std::fmt;

use serde::Serialize;
use shared::config::{DaemonConfig, EncoderConfig};
use shared::recording::schema::DeviceInfo;

use super::check::Check;
use super::config::SmokeConfig;
use super::cycles::{EventFigures, Figures};
use super::host::Host;

/// Configuration, devices and figures of a smoke test.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// Name and version of the program.
    pub software: String,
    /// Start of the test, UTC.
    pub started: String,
    /// Network interface, or `simulated`.
    pub bus: String,
    /// Machine on which the test ran.
    pub host: Host,
    /// Configuration of the checks.
    pub smoke: SmokeConfig,
    /// Configuration of the cycles. The rate in it is not used.
    pub daemon: DaemonConfig,
    /// The terminals that were expected.
    pub encoders: Vec<EncoderConfig>,
    /// The devices that identified themselves, in bus order.
    pub devices: Vec<DeviceInfo>,
    /// The checks, in the order in which they were done.
    pub checks: Vec<Check>,
    /// Figures of the cycles at each rate.
    pub cycles: Vec<Figures>,
    /// Figures of the cycles while the cable was pulled.
    pub pulled_cable: Option<Figures>,
}

impl Report {
    /// Whether every enabled check passed.
    pub fn is_good(&self) -> bool {
        self.bad_checks() == 0
    }

    /// Number of checks that failed or could not be done.
    pub fn bad_checks(&self) -> usize {
        self.checks.iter().filter(|check| !check.is_good()).count()
    }
}

/// Text with machine, devices and figures. The checks are omitted, because each is printed when it ends.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Host { kernel, kernel_version, processor, interface, .. } = &self.host;
        let known = |text: &Option<String>| text.clone().unwrap_or_else(|| "unknown".into());
        writeln!(f, "program   {}", self.software)?;
        writeln!(f, "kernel    {} {}", known(kernel), known(kernel_version))?;
        writeln!(f, "processor {}", known(processor))?;
        if let Some(interface) = interface {
            let (driver, speed) = (known(&interface.driver), known(&interface.speed_mbit_s));
            writeln!(f, "interface {}, driver {driver}, {speed} Mbit/s", self.bus)?;
        }
        for DeviceInfo { position, name, vendor_id, product_code, revision, serial } in &self.devices {
            writeln!(
                f,
                "device {position:2} {name}: vendor {vendor_id:#x}, product {product_code:#010x}, revision \
                 {revision:#010x}, serial {serial}"
            )?;
        }
        for figures in self.cycles.iter().chain(&self.pulled_cable) {
            let Figures { rate_hz, cycles, cycles_valid, realtime, timing, events, .. } = figures;
            let realtime = realtime.as_deref().unwrap_or("on virtual time");
            writeln!(f, "{rate_hz} Hz: {cycles_valid} of {cycles} cycles valid; cycle {realtime}")?;
            for (code, EventFigures { count, first }) in events {
                writeln!(f, "  {code} ({count}): {first}")?;
            }
            if let Some(timing) = timing {
                let lines = [("wake-up late", &timing.lateness), ("round trip", &timing.round_trip)];
                writeln!(
                    f,
                    "{:15} {:>10} {:>10} {:>10} {:>10}",
                    "  time [us]", "p50", "p99", "p99.9", "max"
                )?;
                for (name, durations) in lines {
                    writeln!(f, "  {name:13} {durations}")?;
                }
            }
        }
        Ok(())
    }
}
