//! `ballbard tune` on files that were recorded from machines.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::fs;
use std::ops::Deref;
use std::time::Duration;

use ballbard::tuning::{Finding, Machine, SettingGrade, findings};

const LIMITS: &str = "Limit                     Soft Limit           Hard Limit           Units     \n\
    Max locked memory         8388608              8388608              bytes     \n\
    Max realtime priority     0                    0                              \n";
const COALESCING: &str = "Coalesce parameters for eth1:\nAdaptive RX: off  TX: off\nstats-block-usecs: n/a\n\
    rx-usecs: 3\nrx-frames: n/a\n\ntx-usecs: 0\n";

/// Period at the usual rate of 100 Hz. A frame may then be late by 5 ms.
const PERIOD: Duration = Duration::from_millis(10);

/// A machine whose system files were copied to a directory of the test.
struct Recorded {
    machine: Machine,
    root: tempfile::TempDir,
}

impl Recorded {
    fn new(core: Option<usize>, cycle_period: Duration, files: &[(&str, &str)]) -> Self {
        let root = tempfile::tempdir().unwrap();
        let (interface, coalescing) = (Some("eth1".into()), Some(COALESCING.into()));
        let machine = Machine::at(root.path(), core, cycle_period, None);
        Self { machine: Machine { interface, coalescing, ..machine }, root }.with(files)
    }

    /// Adds these files (path, text) to the machine, or replaces existing ones.
    fn with(self, files: &[(&str, &str)]) -> Self {
        for (file, text) in files {
            let path = self.root.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        self
    }

    /// The same machine after a change.
    fn but(mut self, change: impl FnOnce(&mut Machine)) -> Self {
        change(&mut self.machine);
        self
    }
}

impl Deref for Recorded {
    type Target = Machine;

    fn deref(&self) -> &Machine {
        &self.machine
    }
}

const LIMITS_FILE: &str = "proc/self/limits";

/// A new machine, on which none of the proposed settings was made. Its cycle has no reserve of time.
fn untuned() -> Recorded {
    let files = [
        ("sys/devices/system/cpu/isolated", "\n"),
        ("sys/devices/system/cpu/nohz_full", "(null)\n"),
        ("sys/devices/system/cpu/online", "0-3\n"),
        ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "powersave\n"),
        ("sys/devices/system/cpu/cpu0/topology/thread_siblings_list", "0,2\n"),
        ("sys/devices/system/cpu/cpuidle/current_driver", "intel_idle\n"),
        ("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet\n"),
        ("proc/sys/kernel/version", "#1 SMP PREEMPT_DYNAMIC Debian 6.1.0\n"),
        ("proc/sys/kernel/sched_rt_runtime_us", "950000\n"),
        (LIMITS_FILE, LIMITS),
        ("proc/self/status", "Name:\tballbard\nCapEff:\t0000000000000000\n"),
        ("proc/swaps", "Filename\tType\tSize\tUsed\tPriority\n/dev/sda2 partition 1 0 -2\n"),
    ];
    Recorded::new(None, Duration::from_millis(1), &files)
}

/// The same machine after all proposed settings were made.
fn tuned() -> Recorded {
    let files = [
        ("sys/devices/system/cpu/isolated", "2-3\n"),
        ("sys/devices/system/cpu/nohz_full", "3\n"),
        ("sys/devices/system/cpu/cpu3/cpufreq/scaling_governor", "performance\n"),
        ("sys/devices/system/cpu/cpu3/topology/thread_siblings_list", "3\n"),
        ("sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc\n"),
        ("sys/kernel/realtime", "1\n"),
        ("dev/cpu_dma_latency", ""),
        ("proc/sys/kernel/version", "#1 SMP PREEMPT_RT Debian 6.1.0\n"),
        ("proc/sys/kernel/sched_rt_runtime_us", "-1\n"),
        ("proc/self/status", "CapEff:\t0000000000806000\n"),
        ("proc/swaps", "Filename\tType\tSize\tUsed\tPriority\n"),
    ];
    untuned().with(&files).but(|machine| {
        (machine.core, machine.cycle_period) = (Some(3), PERIOD);
        machine.coalescing = Some(COALESCING.replace("rx-usecs: 3", "rx-usecs: 0"));
    })
}

fn find(machine: &Machine, subject: &str) -> Finding {
    findings(machine).into_iter().find(|finding| finding.subject == subject).unwrap()
}

#[test]
fn a_tuned_machine_has_nothing_to_type() {
    for finding in findings(&tuned()) {
        assert_eq!((finding.verdict, finding.remedy.as_str()), (SettingGrade::Fine, ""), "{finding}");
    }
}

#[test]
fn every_problem_of_an_untuned_machine_says_what_to_type() {
    for (subject, types) in [
        ("kernel", "linux-image-rt"),
        ("isolated core", "isolcpus=3"),
        ("timer tick", "nohz_full=3"),
        ("hyper-threading", "smt/control"),
        ("frequency", "scaling_governor"),
        ("idle states", "chown \"$USER\" /dev/cpu_dma_latency"),
        ("clock source", "echo tsc"),
        ("priority", "cap_sys_nice"),
        ("locked memory", "cap_ipc_lock"),
        ("swap", "swapoff -a"),
        ("interrupt coalescing", "ethtool -C eth1"),
    ] {
        let finding = find(&untuned(), subject);
        assert_eq!(finding.verdict, SettingGrade::Problem, "{finding}");
        assert!(finding.remedy.contains(types), "{finding}");
    }
}

/// The service in the package limits its capabilities. If the program file had more capabilities than the service permits,
/// the service could not start the program.
#[test]
fn the_program_of_the_package_is_given_no_capabilities() {
    let installed = untuned().but(|machine| machine.is_package = true);
    for subject in ["priority", "locked memory"] {
        let finding = find(&installed, subject);
        assert_eq!(finding.verdict, SettingGrade::Problem, "{finding}");
        assert!(finding.remedy.starts_with("sudo systemctl stop ballbard && sudo ballbard"), "{finding}");
    }
}

#[test]
fn a_usual_kernel_is_good_enough_for_a_usual_cycle() {
    let finding = find(&untuned().but(|machine| machine.cycle_period = PERIOD), "kernel");
    assert_eq!((finding.verdict, finding.remedy.as_str()), (SettingGrade::Fine, ""), "{finding}");
}

#[test]
fn what_costs_less_than_a_frame_may_be_late_is_no_problem_of_a_usual_cycle() {
    let usual = untuned().but(|machine| machine.cycle_period = PERIOD);
    for finding in findings(&usual) {
        let unbounded = ["priority", "locked memory", "swap"].contains(&finding.subject);
        assert_eq!(finding.verdict == SettingGrade::Problem, unbounded, "{finding}");
    }
    let finding = find(&usual, "isolated core");
    assert!(finding.verdict == SettingGrade::Slight && finding.remedy.contains("isolcpus=3"), "{finding}");
}

#[test]
fn no_machine_is_told_to_isolate_its_only_core_or_its_first() {
    let mut one = untuned().with(&[("sys/devices/system/cpu/online", "0\n")]);
    for core in [None, Some(0)] {
        one.machine.core = core;
        for subject in ["isolated core", "timer tick"] {
            let finding = find(&one, subject);
            assert_eq!((finding.verdict, finding.remedy.as_str()), (SettingGrade::Fine, ""), "{finding}");
        }
    }
    let first = untuned().but(|machine| machine.core = Some(0));
    for subject in ["isolated core", "timer tick"] {
        let finding = find(&first, subject);
        assert!(finding.remedy.contains("nohz_full=3"), "{finding}");
    }
    assert!(find(&first, "isolated core").remedy.contains("core = 3"));
}

#[test]
fn a_machine_that_says_nothing_is_unknown_not_fine() {
    for finding in findings(&Machine::default()) {
        assert_eq!(finding.verdict, SettingGrade::Unknown, "{finding}");
    }
}

#[test]
fn a_core_of_the_configuration_is_checked_against_the_kernel() {
    let elsewhere =
        tuned().but(|machine| (machine.core, machine.cycle_period) = (Some(1), Duration::from_millis(1)));
    let finding = find(&elsewhere, "isolated core");
    assert!(finding.verdict == SettingGrade::Problem && finding.remedy.contains("isolcpus=1"), "{finding}");
    let unused = tuned().but(|machine| machine.core = None);
    assert!(find(&unused, "isolated core").remedy.contains("core = 2"));
    let paired = tuned().with(&[("sys/devices/system/cpu/cpu3/topology/thread_siblings_list", "1,3\n")]);
    assert!(find(&paired, "hyper-threading").remedy.contains("cpu1/online"));
}

#[test]
fn limits_without_capabilities_count() {
    let limits = LIMITS.replace("priority     0 ", "priority     95").replace("8388608  ", "unlimited");
    let machine = untuned().with(&[(LIMITS_FILE, &limits)]);
    assert_eq!(find(&machine, "priority").verdict, SettingGrade::Fine);
    assert_eq!(find(&machine, "locked memory").verdict, SettingGrade::Fine);
}

#[test]
fn any_limit_of_locked_memory_is_too_low() {
    let limits = LIMITS.replace("8388608  ", "68719476736");
    let finding = find(&untuned().with(&[(LIMITS_FILE, &limits)]), "locked memory");
    assert!(finding.verdict == SettingGrade::Problem && finding.says.contains("65536 MiB"), "{finding}");
}

#[test]
fn adaptive_coalescing_and_throttling_are_problems() {
    let adaptive = COALESCING.replace("RX: off", "RX: on").replace("rx-usecs: 3", "rx-usecs: 0");
    let machine = tuned().with(&[("proc/sys/kernel/sched_rt_runtime_us", "500000")]).but(|machine| {
        (machine.coalescing, machine.cycle_period) = (Some(adaptive), Duration::from_millis(1));
    });
    assert_eq!(find(&machine, "interrupt coalescing").verdict, SettingGrade::Problem);
    assert_eq!(find(&machine, "throttling").verdict, SettingGrade::Problem);
}
