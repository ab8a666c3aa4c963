//! Independent programs: SOEM is the master of our simulated segment, and Wireshark's dissectors check our frames.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use ballbard::segment::simulated::{Periods, SmoothMotion};
use serde::Deserialize;

use super::namespace::{Ended, Namespace, serve_segment};

const PERIOD_NS: i64 = 10_000_000;
const LINES: u32 = 3600;
const SEED: u64 = 1;

#[derive(Deserialize)]
struct Seen {
    devices: Vec<DeviceSeen>,
    expected_working_counter: u16,
    cycles: Vec<CycleSeen>,
}

#[derive(Deserialize)]
struct DeviceSeen {
    name: String,
    vendor: u32,
    product: u32,
}

#[derive(Deserialize)]
struct CycleSeen {
    dc_ns: i64,
    sent_ns: i64,
    received_ns: i64,
    /// Working counter of the reply; negative if no reply arrived in time.
    working_counter: i32,
    /// Status word and counter of each terminal.
    terminals: Vec<(u16, u32)>,
}

/// The Python interpreter that has `pysoem`.
fn python() -> PathBuf {
    let python = std::env::var_os("BALLBAR_PYTHON").map_or_else(|| "python3".into(), PathBuf::from);
    let found = Command::new(&python).args(["-c", "import pysoem"]).output();
    let help = "pysoem is missing: pip install -r tests/requirements.txt and set BALLBAR_PYTHON";
    assert!(found.is_ok_and(|output| output.status.success()), "{help}");
    python
}

fn run_soem(namespace: &Namespace, python: &Path) -> Seen {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/veth/pysoem_master.py");
    let output = namespace.command(python).arg(script).arg("near").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
#[ignore = "needs root, iproute2, and Python with pysoem"]
fn soem_brings_the_segment_into_op_and_reads_the_counters_of_the_motion() {
    let python = python();
    let namespace = Namespace::new("soem");
    let _segment = serve_segment(&namespace, &["--seed", &SEED.to_string()]);
    let seen = run_soem(&namespace, &python);

    assert!(seen.devices.iter().all(|device| device.vendor == 2));
    let products: Vec<u32> = seen.devices.iter().map(|device| device.product).collect();
    assert_eq!(products, [vec![0x044c_2c52], vec![0x139d_3052; 5]].concat());
    assert_eq!((seen.devices[0].name.as_str(), seen.devices[5].name.as_str()), ("EK1100", "EL5021"));
    assert_eq!(seen.expected_working_counter, 15);
    let whole = seen.cycles.iter().filter(|cycle| cycle.working_counter == 15).count();
    assert!(whole > 190, "{whole} of 200 cycles with all terminals");

    let motion = SmoothMotion::new(5, LINES, SEED);
    let mut compared = 0;
    for pair in seen.cycles.windows(2) {
        let [before, cycle] = pair else { continue };
        assert!(cycle.dc_ns >= before.dc_ns, "the bus clock runs");
        // Cycles are not compared in two cases. If the frame was near a SYNC0, it is uncertain which sample the frame
        // returned. If replies are missing, the cycle is incomplete.
        let phase_ns = cycle.dc_ns.rem_euclid(PERIOD_NS);
        if !(100_000..9_900_000).contains(&phase_ns) || cycle.working_counter != 15 {
            continue;
        }
        let bracket_ns = cycle.received_ns - cycle.sent_ns;
        let sampled_ns = cycle.sent_ns + bracket_ns / 2 - phase_ns;
        // An encoder turns at 0.4 rad/s at most. The instant of the sample is uncertain by half the time between sending and
        // receiving, plus some us of delay on the wire.
        let tolerance = 4.0 + 0.94e-3 * (bracket_ns as f64 / 2.0 + 5_000.0);
        for (joint, (status, counter)) in cycle.terminals.iter().enumerate() {
            assert_eq!(status & 0x4018, 0, "no frequency or amplitude error");
            let turned = motion.angle_rad(joint, sampled_ns) * f64::from(LINES) / TAU;
            let position = motion.start_periods(joint).0 + Periods::from_f64(turned).0;
            let expected = (position >> 20) as u32;
            let off = f64::from(counter.wrapping_sub(expected) as i32);
            assert!(off.abs() < tolerance, "joint {joint}: {off} counts, {tolerance} allowed");
        }
        compared += 1;
    }
    println!("SOEM: {} cycles, {compared} compared", seen.cycles.len());
    assert!(compared > 100);
    let (first, last) = (&seen.cycles[0], &seen.cycles[199]);
    let (bus_ns, host_ns) = (last.dc_ns - first.dc_ns, last.sent_ns - first.sent_ns);
    assert!((bus_ns - host_ns).abs() < host_ns / 100, "{bus_ns} ns on the bus, {host_ns} ns on the host");
}

#[test]
#[ignore = "needs root, iproute2, Python with pysoem, and tshark"]
fn wireshark_finds_no_malformed_frame_in_what_soem_and_the_segment_say() {
    let python = python();
    let namespace = Namespace::new("tshark");
    let _segment = serve_segment(&namespace, &[]);
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("frames.pcapng");
    let mut capture = namespace.command("tshark");
    capture.args(["-i", "near", "-q", "-w"]).arg(&file).stdout(Stdio::null()).stderr(Stdio::null());
    let mut capture = Ended(capture.spawn().expect("tshark"));
    for _ in 0..100 {
        if file.exists() {
            break;
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    run_soem(&namespace, &python);
    // An interrupted tshark writes all packets that it has captured.
    let child = nix::unistd::Pid::from_raw(capture.0.id() as i32);
    nix::sys::signal::kill(child, nix::sys::signal::Signal::SIGINT).unwrap();
    capture.0.wait().unwrap();

    let frames = |filter: &str| {
        let mut read = Command::new("tshark");
        let output = read.arg("-r").arg(&file).args(["-Y", filter]).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8_lossy(&output.stdout).lines().count()
    };
    let (all, malformed) = (frames("ecat"), frames("_ws.malformed"));
    let mailbox = frames("ecat_mailbox");
    println!("tshark: {all} EtherCAT frames, {mailbox} with a mailbox, {malformed} malformed");
    assert!(all > 2000 && mailbox > 10, "{all} frames, {mailbox} with a mailbox");
    assert_eq!(malformed, 0);
    assert_eq!(
        frames("ecat.cmd == 0x0c && eth.src[0] == 12 && ecat.cnt > 15"),
        0,
        "no working counter too high"
    );
}
