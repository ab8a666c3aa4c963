//! `ballbard tune` on recorded texts of machines.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::fs;
use std::time::Duration;

use ballbard::tuning::{Finding, Machine, Verdict, findings};

const LIMITS: &str = "Limit                     Soft Limit           Hard Limit           Units     \n\
    Max locked memory         8388608              8388608              bytes     \n\
    Max realtime priority     0                    0                              \n";
const COALESCING: &str = "Coalesce parameters for eth1:\nAdaptive RX: off  TX: off\nstats-block-usecs: n/a\n\
    rx-usecs: 3\nrx-frames: n/a\n\ntx-usecs: 0\n";

/// At the usual rate, where a frame may be late by 5 ms.
const PERIOD: Duration = Duration::from_millis(10);

/// A new machine without any setting, and a cycle without time reserve.
fn untuned() -> Machine {
    Machine {
        core: None,
        cycle_period: Duration::from_millis(1),
        interface: Some("eth1".into()),
        isolated: Some("\n".into()),
        nohz_full: Some("(null)\n".into()),
        online: Some("0-3\n".into()),
        governor: Some("powersave\n".into()),
        siblings: Some("0,2\n".into()),
        idle_driver: Some("intel_idle\n".into()),
        realtime: None,
        kernel_version: Some("#1 SMP PREEMPT_DYNAMIC Debian 6.1.0\n".into()),
        rt_runtime_us: Some("950000\n".into()),
        limits: Some(LIMITS.into()),
        status: Some("Name:\tballbard\nCapEff:\t0000000000000000\n".into()),
        swaps: Some("Filename\tType\tSize\tUsed\tPriority\n/dev/sda2 partition 1 0 -2\n".into()),
        clock_source: Some("hpet\n".into()),
        coalescing: Some(COALESCING.into()),
        is_package: false,
    }
}

/// The same machine with all proposed settings.
fn tuned() -> Machine {
    Machine {
        core: Some(3),
        cycle_period: PERIOD,
        interface: Some("eth1".into()),
        isolated: Some("2-3\n".into()),
        nohz_full: Some("3\n".into()),
        online: Some("0-3\n".into()),
        governor: Some("performance\n".into()),
        siblings: Some("3\n".into()),
        idle_driver: Some("intel_idle\n".into()),
        realtime: Some("1\n".into()),
        kernel_version: Some("#1 SMP PREEMPT_RT Debian 6.1.0\n".into()),
        rt_runtime_us: Some("-1\n".into()),
        limits: Some(LIMITS.into()),
        status: Some("CapEff:\t0000000000806000\n".into()),
        swaps: Some("Filename\tType\tSize\tUsed\tPriority\n".into()),
        clock_source: Some("tsc\n".into()),
        coalescing: Some(COALESCING.replace("rx-usecs: 3", "rx-usecs: 0")),
        is_package: false,
    }
}

fn find(machine: &Machine, subject: &str) -> Finding {
    findings(machine).into_iter().find(|finding| finding.subject == subject).unwrap()
}

#[test]
fn a_tuned_machine_has_nothing_to_type() {
    for finding in findings(&tuned()) {
        assert_eq!((finding.verdict, finding.remedy.as_str()), (Verdict::Fine, ""), "{finding}");
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
        ("clock source", "echo tsc"),
        ("priority", "cap_sys_nice"),
        ("locked memory", "cap_ipc_lock"),
        ("swap", "swapoff -a"),
        ("interrupt coalescing", "ethtool -C eth1"),
    ] {
        let finding = find(&untuned(), subject);
        assert_eq!(finding.verdict, Verdict::Problem, "{finding}");
        assert!(finding.remedy.contains(types), "{finding}");
    }
}

/// The package's service runs with fewer capabilities than a program with these has, so it could not start.
#[test]
fn the_program_of_the_package_is_given_no_capabilities() {
    let installed = Machine { is_package: true, ..untuned() };
    for subject in ["priority", "locked memory"] {
        let finding = find(&installed, subject);
        assert_eq!(finding.verdict, Verdict::Problem, "{finding}");
        assert!(finding.remedy.starts_with("sudo systemctl stop ballbard && sudo ballbard"), "{finding}");
    }
}

#[test]
fn a_usual_kernel_is_good_enough_for_a_usual_cycle() {
    let finding = find(&Machine { cycle_period: PERIOD, ..untuned() }, "kernel");
    assert_eq!((finding.verdict, finding.remedy.as_str()), (Verdict::Fine, ""), "{finding}");
}

#[test]
fn what_costs_less_than_a_frame_may_be_late_is_no_problem_of_a_usual_cycle() {
    let usual = Machine { cycle_period: PERIOD, ..untuned() };
    for finding in findings(&usual) {
        let unbounded = ["priority", "locked memory", "swap"].contains(&finding.subject);
        assert_eq!(finding.verdict == Verdict::Problem, unbounded, "{finding}");
    }
    let finding = find(&usual, "isolated core");
    assert!(finding.verdict == Verdict::Slight && finding.remedy.contains("isolcpus=3"), "{finding}");
}

#[test]
fn no_machine_is_told_to_isolate_its_only_core_or_its_first() {
    let one = Machine { online: Some("0\n".into()), siblings: Some("0\n".into()), ..untuned() };
    for core in [None, Some(0)] {
        for subject in ["isolated core", "timer tick"] {
            let finding = find(&Machine { core, ..one.clone() }, subject);
            assert_eq!((finding.verdict, finding.remedy.as_str()), (Verdict::Fine, ""), "{finding}");
        }
    }
    let first = Machine { core: Some(0), ..untuned() };
    for subject in ["isolated core", "timer tick"] {
        let finding = find(&first, subject);
        assert!(finding.remedy.contains("nohz_full=3"), "{finding}");
    }
    assert!(find(&first, "isolated core").remedy.contains("core = 3"));
}

#[test]
fn a_machine_that_says_nothing_is_unknown_not_fine() {
    for finding in findings(&Machine::default()) {
        assert_eq!(finding.verdict, Verdict::Unknown, "{finding}");
    }
}

#[test]
fn a_core_of_the_configuration_is_checked_against_the_kernel() {
    let elsewhere = Machine { core: Some(1), cycle_period: Duration::from_millis(1), ..tuned() };
    let finding = find(&elsewhere, "isolated core");
    assert!(finding.verdict == Verdict::Problem && finding.remedy.contains("isolcpus=1"), "{finding}");
    let unused = Machine { core: None, ..tuned() };
    assert!(find(&unused, "isolated core").remedy.contains("core = 2"));
    let paired = Machine { siblings: Some("1,3\n".into()), ..tuned() };
    assert!(find(&paired, "hyper-threading").remedy.contains("cpu1/online"));
}

#[test]
fn limits_without_capabilities_count() {
    let limits = LIMITS.replace("priority     0 ", "priority     95").replace("8388608  ", "unlimited");
    let machine = Machine { limits: Some(limits), ..untuned() };
    assert_eq!(find(&machine, "priority").verdict, Verdict::Fine);
    assert_eq!(find(&machine, "locked memory").verdict, Verdict::Fine);
}

#[test]
fn any_limit_of_locked_memory_is_too_low() {
    let limits = LIMITS.replace("8388608  ", "68719476736");
    let finding = find(&Machine { limits: Some(limits), ..untuned() }, "locked memory");
    assert!(finding.verdict == Verdict::Problem && finding.says.contains("65536 MiB"), "{finding}");
}

#[test]
fn adaptive_coalescing_and_throttling_are_problems() {
    let adaptive = COALESCING.replace("RX: off", "RX: on").replace("rx-usecs: 3", "rx-usecs: 0");
    let (coalescing, rt_runtime_us) = (Some(adaptive), Some("500000".into()));
    let machine = Machine { coalescing, rt_runtime_us, cycle_period: Duration::from_millis(1), ..tuned() };
    assert_eq!(find(&machine, "interrupt coalescing").verdict, Verdict::Problem);
    assert_eq!(find(&machine, "throttling").verdict, Verdict::Problem);
}

#[test]
fn the_files_of_a_machine_are_read_where_the_kernel_has_them() {
    let root = tempfile::tempdir().unwrap();
    for (file, text) in [
        ("sys/devices/system/cpu/isolated", "3\n"),
        ("sys/devices/system/cpu/cpu3/cpufreq/scaling_governor", "performance\n"),
        ("sys/devices/system/cpu/cpu3/topology/thread_siblings_list", "3\n"),
        ("proc/sys/kernel/version", "#1 SMP PREEMPT_RT\n"),
        ("proc/swaps", "Filename\n"),
    ] {
        let path = root.path().join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    let machine = Machine::read(root.path(), Some(3), PERIOD, None);
    for subject in ["kernel", "isolated core", "hyper-threading", "frequency", "swap"] {
        assert_eq!(find(&machine, subject).verdict, Verdict::Fine, "{subject}");
    }
    assert_eq!(find(&machine, "priority").verdict, Verdict::Unknown);
}
