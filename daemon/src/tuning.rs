//! Finds settings of this machine that delay the bus cycle, and the commands that correct these settings.
//!
//! [`Machine`] reads most settings from files of the kernel, and the settings of a network interface
//! from the output of `ethtool`. [`findings`] grades each setting and returns a [`Finding`] with its
//! value, its effect and the command that corrects it. `ballbard tune` and the smoke test show the
//! findings. The cycle thread uses [`Machine`] to check its permissions.

use std::fmt;
use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde::Serialize;

/// Grade of one setting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SettingGrade {
    /// The setting does not delay the cycle.
    Fine,
    /// The setting delays the cycle, but by less than the allowed lateness of a frame.
    Slight,
    /// The setting can delay a frame by more than the allowed lateness.
    Problem,
    /// The setting could not be determined.
    Unknown,
}

/// Result for one setting.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Name of the setting.
    pub subject: &'static str,
    /// Grade of the setting.
    pub verdict: SettingGrade,
    /// Value of the setting and its effect.
    pub says: String,
    /// Command that corrects the setting; empty if nothing needs to be done.
    pub remedy: String,
}

/// The files of a machine, and properties of the cycle that will run on this machine.
#[derive(Debug, Clone, Default)]
pub struct Machine {
    /// Directory that contains the files of the machine, `/` except in tests.
    pub root: PathBuf,
    /// Core that is configured for the cycle thread.
    pub core: Option<usize>,
    /// Time between two cycles.
    pub cycle_period: Duration,
    /// Network interface of the bus.
    pub interface: Option<String>,
    /// Output of `ethtool -c INTERFACE`.
    pub coalescing: Option<String>,
    /// Whether the program was installed from the Debian package. Its service gets its permissions from systemd.
    pub is_package: bool,
}

impl Machine {
    /// Describes the machine whose files are below `root`. The cycle will run on `core` with this
    /// period, on the bus at `interface`.
    pub fn at(root: &Path, core: Option<usize>, cycle_period: Duration, interface: Option<&str>) -> Self {
        Self {
            root: root.to_owned(),
            core,
            cycle_period,
            interface: interface.map(str::to_owned),
            coalescing: interface.and_then(coalescing_of),
            is_package: is_package(root),
        }
    }

    /// Describes this machine, to read the permissions of this process.
    pub fn of_process() -> Self {
        Self { root: "/".into(), ..Self::default() }
    }

    /// Text of a file without leading and trailing white space; `None` if the file cannot be read.
    pub fn text(&self, file: &str) -> Option<String> {
        Some(std::fs::read_to_string(self.root.join(file)).ok()?.trim().to_owned())
    }

    fn of_cores(&self, file: &str) -> Option<String> {
        self.text(&format!("sys/devices/system/cpu/{file}"))
    }

    fn of_core(&self, file: &str) -> Option<String> {
        self.of_cores(&format!("cpu{}/{file}", self.core.unwrap_or(0)))
    }

    /// Allowed lateness of a frame: half a cycle period. A smaller delay has no effect on the samples.
    fn slack(&self) -> Duration {
        self.cycle_period / 2
    }

    /// The core to isolate: the configured core, or the last core if no core or core 0 is configured. Core 0 is never
    /// isolated, because the kernel needs it. `None` on a machine with one core.
    fn core_to_isolate(&self) -> Option<usize> {
        let last = cores(&self.of_cores("online").unwrap_or_default()).last().copied();
        self.core.filter(|core| *core > 0).or(last).filter(|core| *core > 0)
    }

    /// Whether this process may lock all its memory for as long as it runs.
    ///
    /// A finite limit is never sufficient. The kernel compares the limit with the address space instead of the memory in use,
    /// and refuses each allocation beyond it (mm/mlock.c, mm/mmap.c). Such a refusal would end the program during a run.
    pub fn may_lock_memory(&self) -> Result<(), LockError> {
        if self.has_capability(CAP_IPC_LOCK) {
            return Ok(());
        }
        match self.limit("Max locked memory").ok_or(LockError::Unknown)?.parse::<u64>() {
            Ok(bytes) => Err(LockError::Limited { mib: bytes >> 20 }),
            Err(_) => Ok(()),
        }
    }

    fn has_capability(&self, bit: u32) -> bool {
        self.status_bits("CapEff") >> bit & 1 == 1
    }

    /// Reads the bit mask `name` of this process from `/proc/self/status`; 0 if it cannot be read.
    pub fn status_bits(&self, name: &str) -> u64 {
        let status = self.text("proc/self/status").unwrap_or_default();
        let mask = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
        mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
    }

    /// The soft limit with this name in `/proc/self/limits`.
    fn limit(&self, name: &str) -> Option<String> {
        let limits = self.text("proc/self/limits")?;
        let line = limits.lines().find_map(|line| line.strip_prefix(name))?;
        line.split_whitespace().next().map(str::to_owned)
    }
}

/// Why memory cannot be locked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LockError {
    /// The limit of locked memory is finite.
    #[error("at most {mib} MiB may be locked; only an unlimited process can lock its memory safely")]
    Limited {
        /// The limit \[MiB\].
        mib: u64,
    },
    /// Neither capabilities nor limits could be read.
    #[error("limits cannot be read")]
    Unknown,
}

/// Whether this program was installed from the Debian package.
pub fn is_package(root: &Path) -> bool {
    let program = std::env::current_exe();
    program.is_ok_and(|program| program == root.join("usr/bin/ballbard"))
        && root.join("etc/default/ballbard").exists()
}

fn coalescing_of(interface: &str) -> Option<String> {
    let output = Command::new("ethtool").args(["-c", interface]).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Grades all settings, the most important first.
pub fn findings(machine: &Machine) -> Vec<Finding> {
    // Entries: name, flag, finding. The flag is true if the delay that the setting causes is always shorter than
    // `KERNEL_DELAY`. If frames may be later than `KERNEL_DELAY`, such a setting is graded `Slight` instead of `Problem`.
    let settings = [
        ("kernel", false, kernel(machine)),
        ("isolated core", true, isolated_core(machine)),
        ("timer tick", true, tickless_core(machine)),
        ("hyper-threading", true, siblings(machine)),
        ("frequency", true, governor(machine)),
        ("idle states", true, idle_states(machine)),
        ("clock source", true, clock_source(machine)),
        ("priority", false, priority(machine)),
        ("locked memory", false, locked_memory(machine)),
        ("throttling", false, throttling(machine)),
        ("swap", false, swap(machine)),
        ("interrupt coalescing", true, coalescing(machine)),
    ];
    let has_time = machine.slack() > KERNEL_DELAY;
    let named = |(subject, is_bounded, finding): (_, _, Finding)| {
        let is_slight = finding.verdict == SettingGrade::Problem && is_bounded && has_time;
        Finding {
            subject,
            verdict: if is_slight { SettingGrade::Slight } else { finding.verdict },
            ..finding
        }
    };
    settings.into_iter().map(named).collect()
}

impl Finding {
    /// Creates a result without a name. [`findings`] adds the name.
    fn new(verdict: SettingGrade, says: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { subject: "", verdict, says: says.into(), remedy: remedy.into() }
    }
}

fn fine(says: impl Into<String>) -> Finding {
    Finding::new(SettingGrade::Fine, says, "")
}

fn problem(says: impl Into<String>, remedy: impl Into<String>) -> Finding {
    Finding::new(SettingGrade::Problem, says, remedy)
}

fn unknown(says: impl Into<String>, remedy: impl Into<String>) -> Finding {
    Finding::new(SettingGrade::Unknown, says, remedy)
}

/// Longest delay of a real-time thread on a kernel without PREEMPT_RT. It occurs while the kernel executes code that cannot
/// be preempted. The settings of cores, clocks and interrupts cause smaller delays.
const KERNEL_DELAY: Duration = Duration::from_millis(2);

/// File with the text that `uname -v` prints.
pub const KERNEL_VERSION: &str = "proc/sys/kernel/version";

fn kernel(machine: &Machine) -> Finding {
    let says_realtime = machine.text("sys/kernel/realtime").is_some_and(|text| text == "1");
    let version = machine.text(KERNEL_VERSION).unwrap_or_default();
    if says_realtime || version.contains("PREEMPT_RT") || version.contains("PREEMPT RT") {
        return fine("PREEMPT_RT");
    }
    let remedy = "sudo apt-get install linux-image-rt-amd64 && sudo reboot";
    if version.is_empty() {
        return unknown("cannot be read; a PREEMPT_RT kernel bounds every delay", remedy);
    }
    let slack = machine.slack();
    if slack > KERNEL_DELAY {
        return fine(format!(
            "{version}: its delays are below the {} ms that a frame may be late",
            slack.as_millis()
        ));
    }
    problem(format!("{version}: not PREEMPT_RT, so drivers may delay the cycle by milliseconds"), remedy)
}

/// Instruction to add options to the command line of the kernel, which Debian and Ubuntu store in /etc/default/grub.
fn boot_option(options: &str) -> String {
    format!(
        "add `{options}` to GRUB_CMDLINE_LINUX in /etc/default/grub, then: sudo update-grub && sudo reboot"
    )
}

fn isolated_core(machine: &Machine) -> Finding {
    let Some(isolated) = machine.of_cores("isolated").as_deref().map(cores) else {
        return unknown("cannot be read", "");
    };
    match (machine.core, isolated.first()) {
        (Some(core), _) if isolated.contains(&core) => {
            return fine(format!("core {core} is isolated"));
        }
        (None, Some(unused)) => {
            return problem(
                format!("core {unused} is isolated, but daemon.toml gives the cycle none"),
                format!("write `core = {unused}` under [realtime] in daemon.toml"),
            );
        }
        _ => {}
    }
    let Some(core) = machine.core_to_isolate() else {
        return fine("none: this machine has one core, which all programs share");
    };
    let options = format!("isolcpus={core} nohz_full={core} rcu_nocbs={core} irqaffinity=0");
    let boot = boot_option(&options);
    if machine.core == Some(core) {
        return problem(
            format!("core {core} of daemon.toml is not isolated: other programs run on it"),
            boot,
        );
    }
    problem(
        "none: the cycle shares its core with all other programs",
        format!("{boot}; write `core = {core}` under [realtime] in daemon.toml"),
    )
}

fn tickless_core(machine: &Machine) -> Finding {
    let Some(tickless) = machine.of_cores("nohz_full").as_deref().map(cores) else {
        return unknown("this kernel does not support nohz_full", "");
    };
    match machine.core_to_isolate() {
        None => fine("periodic; a machine with one core needs it"),
        Some(core) if tickless.contains(&core) => fine(format!("core {core} has none")),
        Some(core) => problem(
            format!("core {core} has a periodic tick, which costs some microseconds"),
            boot_option(&format!("nohz_full={core}")),
        ),
    }
}

fn siblings(machine: &Machine) -> Finding {
    let Some(siblings) = machine.of_core("topology/thread_siblings_list").as_deref().map(cores) else {
        return unknown("cannot be read", "");
    };
    let shared = machine.core.and_then(|core| Some((core, *siblings.iter().find(|other| **other != core)?)));
    match shared {
        Some((core, sibling)) => problem(
            format!("core {sibling} shares the execution units of core {core} and slows it down"),
            format!("echo 0 | sudo tee /sys/devices/system/cpu/cpu{sibling}/online"),
        ),
        None if machine.core.is_none() && siblings.len() > 1 => problem(
            "cores share execution units in pairs, which slows them down",
            "echo off | sudo tee /sys/devices/system/cpu/smt/control",
        ),
        None => fine("no sibling shares the core"),
    }
}

fn governor(machine: &Machine) -> Finding {
    match machine.of_core("cpufreq/scaling_governor").as_deref() {
        Some("performance") => fine("governor performance"),
        Some(other) => problem(
            format!("governor {other}: a core at low frequency wakes up slowly"),
            "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
        ),
        None => unknown("not under this kernel's control (virtual machine or firmware)", ""),
    }
}

fn idle_states(machine: &Machine) -> Finding {
    match machine.of_cores("cpuidle/current_driver").as_deref() {
        Some("none") => fine("no idle driver, so no deep idle states"),
        // The cycle thread will write a latency limit to this file (`stay_awake`). Here the file is only opened to test the
        // permission, which changes nothing as long as no limit is written.
        Some(driver) => match OpenOptions::new().write(true).open(machine.root.join("dev/cpu_dma_latency")) {
            Ok(_) => {
                fine(format!("{driver}; ballbard keeps /dev/cpu_dma_latency at 0, which prevents deep ones"))
            }
            Err(error) => problem(
                format!(
                    "{driver}; deep ones delay the cycle, because /dev/cpu_dma_latency cannot be opened ({error})"
                ),
                if machine.is_package { grant(true) } else { "sudo chown \"$USER\" /dev/cpu_dma_latency" },
            ),
        },
        None => unknown("not under this kernel's control (virtual machine or firmware)", ""),
    }
}

fn clock_source(machine: &Machine) -> Finding {
    match machine.text("sys/devices/system/clocksource/clocksource0/current_clocksource").as_deref() {
        Some(source @ ("tsc" | "kvm-clock" | "arch_sys_counter")) => fine(source),
        Some(source) => problem(
            format!("{source}: reading the time takes microseconds"),
            "echo tsc | sudo tee /sys/devices/system/clocksource/clocksource0/current_clocksource",
        ),
        None => unknown("cannot be read", ""),
    }
}

/// Bit numbers of the effective capabilities (linux/capability.h).
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;

/// Command that gives the program the permissions of the cycle. The systemd unit of the Debian package limits the service to
/// one capability. If `setcap` gave the program file more capabilities, the kernel would refuse to start it in that unit. So
/// `setcap` must not be used for the package.
pub fn grant(is_package: bool) -> &'static str {
    if is_package {
        "sudo systemctl stop ballbard && sudo ballbard .. (without sudo, only the package's service has the rights)"
    } else {
        "sudo setcap cap_net_raw,cap_sys_nice,cap_ipc_lock+ep \"$(command -v ballbard)\""
    }
}

fn priority(machine: &Machine) -> Finding {
    if machine.has_capability(CAP_SYS_NICE) {
        return fine("SCHED_FIFO is permitted (CAP_SYS_NICE)");
    }
    match machine.limit("Max realtime priority").map(|limit| limit.parse::<u32>()) {
        Some(Ok(0)) => {
            problem("SCHED_FIFO is not permitted: any program may delay the cycle", grant(machine.is_package))
        }
        Some(Ok(highest)) => fine(format!("SCHED_FIFO is permitted up to {highest}")),
        Some(Err(_)) => fine("SCHED_FIFO is permitted without limit"),
        None => unknown("limits cannot be read", grant(machine.is_package)),
    }
}

fn locked_memory(machine: &Machine) -> Finding {
    match machine.may_lock_memory() {
        Ok(()) => fine("permitted"),
        Err(error @ LockError::Limited { .. }) => {
            problem(format!("{error}: a page fault may delay the cycle"), grant(machine.is_package))
        }
        Err(error @ LockError::Unknown) => unknown(error.to_string(), grant(machine.is_package)),
    }
}

fn throttling(machine: &Machine) -> Finding {
    match machine.text("proc/sys/kernel/sched_rt_runtime_us").map(|text| text.parse::<i64>()) {
        Some(Ok(-1)) => fine("real-time threads are never throttled"),
        // By default, 5 % of the time of a core is reserved for other threads. The cycle thread sleeps most of the time, so
        // this limit does not affect it.
        Some(Ok(runtime_us)) if runtime_us >= 900_000 => {
            fine(format!("real-time threads may take {} % of a core", runtime_us / 10_000))
        }
        Some(Ok(runtime_us)) => problem(
            format!("real-time threads are stopped after {runtime_us} us of each second"),
            "sudo sysctl kernel.sched_rt_runtime_us=950000",
        ),
        _ => unknown("cannot be read", ""),
    }
}

fn swap(machine: &Machine) -> Finding {
    match machine.text("proc/swaps").map(|text| text.lines().skip(1).count()) {
        Some(0) => fine("none"),
        Some(areas) => problem(
            format!("{areas} swap areas in use: swapping of other programs delays the disk"),
            "sudo swapoff -a",
        ),
        None => unknown("cannot be read", ""),
    }
}

fn coalescing(machine: &Machine) -> Finding {
    let Some(interface) = machine.interface.as_deref() else {
        return unknown("no interface given", "ballbard tune --interface eth1");
    };
    let Some(text) = machine.coalescing.as_deref() else {
        return unknown(
            format!("ethtool has no data of {interface}: not installed, or a virtual interface"),
            format!("sudo apt-get install ethtool && ethtool -c {interface}"),
        );
    };
    let delays = ["rx-usecs", "tx-usecs"].map(|name| (name, setting(text, name)));
    let late: Vec<String> = delays
        .iter()
        .filter_map(|(name, us)| us.filter(|us| *us > 0).map(|us| format!("{name} {us}")))
        .collect();
    let adaptive = text.lines().any(|line| line.starts_with("Adaptive") && line.contains(" on"));
    if late.is_empty() && !adaptive {
        return fine(format!("{interface} interrupts at once"));
    }
    let found = if adaptive { "adaptive".to_owned() } else { late.join(", ") };
    problem(
        format!("{interface} delays replies ({found})"),
        format!("sudo ethtool -C {interface} adaptive-rx off adaptive-tx off rx-usecs 0 tx-usecs 0"),
    )
}

/// Value in a line `name: value` that ethtool printed; `None` for `n/a`.
fn setting(text: &str, name: &str) -> Option<u32> {
    let line = text.lines().find_map(|line| line.trim().strip_prefix(name)?.strip_prefix(':'))?;
    line.trim().parse().ok()
}

/// Parses a list of cores: `0-2,5` contains the cores 0, 1, 2, 5. Other text gives an empty list.
fn cores(list: &str) -> Vec<usize> {
    const CORES_MAX: usize = 4096;
    let range = |part: &str| {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        Some(first.trim().parse::<usize>().ok()?..=last.trim().parse::<usize>().ok()?.min(CORES_MAX))
    };
    list.trim().split(',').filter_map(range).flatten().collect()
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = match self.verdict {
            SettingGrade::Fine => "ok",
            SettingGrade::Slight => "slight",
            SettingGrade::Problem => "PROBLEM",
            SettingGrade::Unknown => "unknown",
        };
        write!(f, "{verdict:8} {:21} {}", self.subject, self.says)?;
        if self.remedy.is_empty() { Ok(()) } else { write!(f, "\n{:31}type: {}", "", self.remedy) }
    }
}
