//! Clients that send half a request or no request. Also far too many clients at the same time.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use rand::{Rng, SeedableRng, rngs::StdRng};
use serde_json::json;

use super::rig::Running;
use crate::support::assert_bad_cycles_have_reasons;

/// Longest time until the service has ended: two seconds, plus a delay for a busy machine.
const END_WITHIN: Duration = Duration::from_secs(4);

fn connect(service: &Running) -> TcpStream {
    TcpStream::connect(format!("127.0.0.1:{}", service.port)).unwrap()
}

fn sent(service: &Running, bytes: &str) -> TcpStream {
    let mut stream = connect(service);
    stream.write_all(bytes.as_bytes()).unwrap();
    stream
}

fn head(service: &Running, first: &str, length: usize) -> String {
    let host = format!("Host: 127.0.0.1:{}\r\nContent-Type: application/json\r\n", service.port);
    format!("{first} HTTP/1.1\r\n{host}Content-Length: {length}\r\n\r\n")
}

/// Waits until the service closes the connection. Returns how long this took.
fn closed_after(mut stream: &TcpStream) -> Duration {
    let begun = Instant::now();
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let mut rest = Vec::new();
    // A reset of the connection is also accepted as its end.
    let read = stream.read_to_end(&mut rest);
    assert!(!read.is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock), "it is never closed");
    begun.elapsed()
}

#[test]
fn half_a_request_keeps_no_service_from_its_end() {
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "half"}));
    service.wait_for("writing");
    let _held = [
        connect(&service),
        sent(&service, "G"),
        sent(&service, "GET /api/status HTTP/1.1\r\nHost: 127"),
        sent(&service, &format!("{}{{", head(&service, "POST /api/start", 100))),
        // This client never reads its answer.
        sent(&service, &head(&service, "GET /api/runs", 0)),
    ];
    std::thread::sleep(Duration::from_millis(300));
    service.signal(Signal::SIGTERM);
    assert!(service.ended(END_WITHIN).success());
    assert!(service.recording("half").end.cause.contains("SIGTERM"));
}

#[test]
fn a_client_that_does_not_say_what_it_wants_is_sent_away() {
    let service = Running::start();
    let silent = [
        connect(&service),
        sent(&service, "GET /api/status HTTP/1.1\r\nHost: 127"),
        sent(&service, &format!("{}{{", head(&service, "POST /api/start", 100))),
    ];
    // This client sends single bytes until the service closes the connection.
    let mut slow = connect(&service);
    let begun = Instant::now();
    while slow.write_all(b"x").is_ok() {
        assert!(begun.elapsed() < Duration::from_secs(20), "a slow client is served for ever");
        std::thread::sleep(Duration::from_millis(100));
    }
    for stream in &silent {
        assert!(closed_after(stream) < Duration::from_secs(10));
    }
    service.wait_for("waiting");
}

#[test]
#[ignore = "takes more than four seconds"]
fn more_clients_than_a_process_has_files_for_change_nothing_for_a_run() {
    const FILES: u64 = 256;
    // The kernel can keep all of these connections waiting. If the kernel refused a connection, the client would try again
    // only after a second or more.
    const CLIENTS: u64 = FILES + 80;
    let mut service = Running::start();
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "crowded"}));
    service.wait_for("writing");
    let (pid, files) = (service.child.id().to_string(), format!("--nofile={FILES}:{FILES}"));
    let limit = std::process::Command::new("prlimit").args([&files, "--pid", &pid]).status();
    assert!(limit.unwrap().success(), "prlimit of util-linux");
    let crowd: Vec<TcpStream> = (0..CLIENTS).map(|_| sent(&service, "GET /api/status HTT")).collect();
    // Connections that the service has not accepted yet are waiting in the kernel.
    std::thread::sleep(Duration::from_millis(300));
    let open = std::fs::read_dir(format!("/proc/{}/fd", service.child.id())).unwrap().count();
    assert!(open < 200, "{open} files are open");
    assert_eq!(service.granted("mark", &json!({"text": "crowded"})).run.as_deref(), Some("crowded"));
    service.wait_for_cycles(50);
    let last = service.granted("stop", &json!({})).last.unwrap();
    assert!(last.cycles >= 50 && last.file.is_some(), "{last:?}");
    assert_eq!(service.recording("crowded").cycles.len() as u64, last.cycles);
    service.granted("start", &json!({"name": "next"}));
    service.wait_for("writing");
    service.signal(Signal::SIGTERM);
    assert!(service.ended(END_WITHIN).success());
    assert!(!service.recording("next").end.recovered);
    drop(crowd);
}

/// Resident memory of a process \[kB\].
fn resident_kb(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim_end_matches("kB").trim().parse().unwrap()
}

/// Command-line arguments for a service: random faults of the bus during these seconds. Each fault
/// ends after a limited time.
fn faults(seed: u64, seconds: Range<f64>) -> Vec<String> {
    let mut random = StdRng::seed_from_u64(seed);
    let mut arguments = Vec::new();
    let mut from_s = seconds.start;
    loop {
        let until_s = from_s + random.random_range(0.1..3.0);
        if until_s > seconds.end {
            return arguments;
        }
        let position = random.random_range(1..=5);
        let share = random.random_range(0.01..1.0);
        let fault = match random.random_range(0..13) {
            0 => format!("lost:{share}"),
            1 => format!("late:{share},{}ms", random.random_range(0..40)),
            2 => format!("duplicated:{share}"),
            3 => format!("corrupted:{share}"),
            4 => format!("short:{share},3"),
            5 => format!("noise:{position},{share}"),
            6 => format!("gone:{position}"),
            7 => format!("safe-op:{position},0x001a"),
            8 => format!("no-signal:{position}"),
            9 => format!("abort:{position},0x06090011"),
            10 => format!("silent:{position}"),
            11 => "link-down".into(),
            _ => format!("clock-step:{}ms", random.random_range(-2000..2000)),
        };
        arguments.push("--fault".into());
        arguments.push(format!("{fault}@{from_s:.3}s-{until_s:.3}s"));
        from_s = until_s + random.random_range(1.0..8.0);
    }
}

#[test]
#[ignore = "takes 30 seconds, or as many more as BALLBAR_SOAK_S says"]
fn fifty_stuck_and_fifty_fast_clients_and_a_faulty_bus_cost_a_run_no_cycle_and_the_service_no_memory() {
    const CLIENTS: usize = 50;
    /// After this time, the buffers and threads for the first clients have been allocated.
    const WARM_UP: Duration = Duration::from_secs(8);
    /// Time without faults at the end. The service recovers from the last fault during this time.
    const QUIET: Duration = Duration::from_secs(8);
    /// Largest growth of memory \[kB\]. A leak in one of a thousand answers would cause a larger growth.
    const GROWTH_KB_MAX: u64 = 16 << 10;
    const LOOKS: u32 = 12;
    let soak_s = std::env::var("BALLBAR_SOAK_S").ok().and_then(|text| text.parse().ok()).unwrap_or(15);
    let soak = Duration::from_secs(soak_s);
    let faults = faults(soak_s, 4.0..(WARM_UP + soak).as_secs_f64());
    let faults: Vec<&str> = faults.iter().map(String::as_str).collect();
    println!("{} faults", faults.len() / 2);
    let mut service = Running::with_arguments(&faults);
    service.wait_for("waiting");
    service.granted("start", &json!({"name": "soaked"}));
    service.wait_for("writing");
    let begun = Instant::now();
    let over = AtomicBool::new(false);
    let answers = AtomicU64::new(0);
    std::thread::scope(|scope| {
        for number in 0..2 * CLIENTS {
            let (service, over, answers) = (&service, &over, &answers);
            scope.spawn(move || {
                while !over.load(Ordering::Relaxed) {
                    let first =
                        ["GET /api/events", "GET /api/runs", "GET /api/live", "GET /api/st"][number % 4];
                    let asked = if number % 8 == 3 { first.into() } else { head(service, first, 0) };
                    let mut stream = connect(service);
                    // If a client is refused, it tries again later.
                    let _ = stream.write_all(asked.as_bytes());
                    if number < CLIENTS {
                        std::thread::sleep(Duration::from_secs(3));
                        continue;
                    }
                    stream.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
                    let mut answer = [0; 4096];
                    if stream
                        .read(&mut answer)
                        .is_ok_and(|length| answer[..length].starts_with(b"HTTP/1.1 200"))
                    {
                        answers.fetch_add(1, Ordering::Relaxed);
                    }
                    std::thread::sleep(Duration::from_millis(100));
                }
            });
        }
        std::thread::sleep(WARM_UP);
        let before_kb = resident_kb(service.child.id());
        println!("{before_kb} kB");
        for look in 1..=LOOKS {
            std::thread::sleep(soak / LOOKS);
            let now_kb = resident_kb(service.child.id());
            println!("{look}/{LOOKS}: {} answers, {now_kb} kB", answers.load(Ordering::Relaxed));
            assert!(now_kb < before_kb + GROWTH_KB_MAX, "{before_kb} kB became {now_kb} kB");
        }
        std::thread::sleep(QUIET);
        over.store(true, Ordering::Relaxed);
    });
    assert!(answers.load(Ordering::Relaxed) > 100, "fast clients are not served");
    let due = begun.elapsed().as_millis() as u64 / 10;
    let last = service.granted("stop", &json!({})).last.unwrap();
    assert_eq!(last.cycles_lost, 0);
    let recording = service.recording("soaked");
    let cycles = &recording.cycles;
    let valid = cycles.iter().filter(|cycle| cycle.is_valid()).count();
    println!("{} cycles, {valid} valid, {due} due", cycles.len());
    assert_eq!(cycles.len() as u64, last.cycles);
    for pair in cycles.windows(2) {
        assert_eq!(pair[1].cycle, pair[0].cycle + 1);
    }
    assert!(last.cycles >= due, "{} cycles of {due}", last.cycles);
    assert_bad_cycles_have_reasons(cycles);
    let last_four_seconds = &cycles[cycles.len() - 400..];
    assert!(last_four_seconds.iter().any(|cycle| cycle.is_valid()), "the bus did not come back");
    service.signal(Signal::SIGTERM);
    assert!(service.ended(END_WITHIN).success());
}

#[test]
#[ignore = "takes 12 seconds: so long a client may take nothing"]
fn a_client_that_takes_nothing_of_its_download_loses_its_place() {
    let service = Running::start();
    service.wait_for("waiting");
    // The file is far larger than the buffers of the sockets.
    let big = std::fs::File::create(service.directory.path().join("big.mcap")).unwrap();
    big.set_len(100 << 20).unwrap();
    let ask = || sent(&service, &head(&service, "GET /api/runs/big/mcap", 0));
    let first_line = |mut stream: TcpStream| {
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    };
    let begun = Instant::now();
    let _stuck = [ask(), ask()];
    std::thread::sleep(Duration::from_secs(1));
    assert_eq!(first_line(ask()), "HTTP/1.1 503");
    while first_line(ask()) != "HTTP/1.1 200" {
        assert!(begun.elapsed() < Duration::from_secs(20), "who takes nothing keeps its place for ever");
        std::thread::sleep(Duration::from_millis(200));
    }
}
