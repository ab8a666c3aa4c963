//! Properties of the machine that affect the cycle.

use std::path::Path;

use serde::Serialize;
use shared::config::DaemonConfig;

use crate::tuning::{self, Finding, KERNEL_VERSION, Machine};

/// Kernel, processor, network interface and settings of the machine.
#[derive(Debug, Clone, Serialize)]
pub struct Host {
    /// `uname -r`
    pub kernel: Option<String>,
    /// `uname -v`
    pub kernel_version: Option<String>,
    /// First `model name` of `/proc/cpuinfo`.
    pub processor: Option<String>,
    /// Network interface of the bus; `None` for the simulated bus.
    pub interface: Option<Interface>,
    /// Settings of the machine, as `ballbard tune` checks them.
    pub settings: Vec<Finding>,
}

/// A network interface. Its addresses are not included, because the report is sent to others.
#[derive(Debug, Clone, Serialize)]
pub struct Interface {
    /// Name of the kernel driver; `None` if the interface has no hardware.
    pub driver: Option<String>,
    /// Negotiated speed \[Mbit/s\]. EtherCAT needs 100 Mbit/s.
    pub speed_mbit_s: Option<String>,
}

impl Host {
    /// Reads the properties of this machine and of the interface of the bus.
    pub fn read(daemon: &DaemonConfig, interface: Option<&str>) -> Self {
        let machine = Machine::at(Path::new("/"), daemon.realtime.core, daemon.cycle_period(), interface);
        let processors = machine.text("proc/cpuinfo").unwrap_or_default();
        let model = processors.lines().find(|line| line.starts_with("model name"));
        Self {
            kernel: machine.text("proc/sys/kernel/osrelease"),
            kernel_version: machine.text(KERNEL_VERSION),
            processor: model.and_then(|line| Some(line.split_once(':')?.1.trim().to_owned())),
            interface: interface.map(|name| Interface::read(&machine, name)),
            settings: tuning::findings(&machine),
        }
    }
}

impl Interface {
    fn read(machine: &Machine, name: &str) -> Self {
        let driver =
            std::fs::read_link(machine.root.join(format!("sys/class/net/{name}/device/driver"))).ok();
        let driver = driver.and_then(|path| Some(path.file_name()?.to_str()?.to_owned()));
        Self { driver, speed_mbit_s: machine.text(&format!("sys/class/net/{name}/speed")) }
    }
}
