//! Properties of the machine that affect the cycle.

use std::fs;
use std::path::Path;

use serde::Serialize;
use shared::config::DaemonConfig;

use crate::tuning::{self, Finding, Machine};

/// Kernel, processor, interface and settings.
#[derive(Debug, Clone, Serialize)]
pub struct Host {
    /// `uname -r`
    pub kernel: Option<String>,
    /// `uname -v`
    pub kernel_version: Option<String>,
    /// First `model name` of `/proc/cpuinfo`.
    pub processor: Option<String>,
    /// Network interface of the bus; absent for the simulated one.
    pub interface: Option<Interface>,
    /// Its settings, as `ballbard tune` checks them.
    pub settings: Vec<Finding>,
}

/// A network interface, without its addresses, because the report is sent to others.
#[derive(Debug, Clone, Serialize)]
pub struct Interface {
    /// Kernel driver; absent without hardware.
    pub driver: Option<String>,
    /// Negotiated speed; EtherCAT needs 100 \[Mbit/s\].
    pub speed_mbit_s: Option<String>,
}

impl Host {
    /// This machine, with the interface of the bus.
    pub fn read(daemon: &DaemonConfig, interface: Option<&str>) -> Self {
        let machine = Machine::read(Path::new("/"), daemon.realtime.core, daemon.cycle_period(), interface);
        let processors = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = processors.lines().find(|line| line.starts_with("model name"));
        Self {
            kernel: trimmed_text("/proc/sys/kernel/osrelease"),
            kernel_version: machine.kernel_version.as_deref().map(|version| version.trim().to_owned()),
            processor: model.and_then(|line| Some(line.split_once(':')?.1.trim().to_owned())),
            interface: interface.map(Interface::read),
            settings: tuning::findings(&machine),
        }
    }
}

impl Interface {
    fn read(name: &str) -> Self {
        let driver = fs::read_link(format!("/sys/class/net/{name}/device/driver")).ok();
        let driver = driver.and_then(|path| Some(path.file_name()?.to_str()?.to_owned()));
        Self { driver, speed_mbit_s: trimmed_text(&format!("/sys/class/net/{name}/speed")) }
    }
}

fn trimmed_text(path: &str) -> Option<String> {
    Some(fs::read_to_string(path).ok()?.trim().to_owned())
}
