//! Processor time and memory of the daemon and of the segment. They are two processes on the ends of a veth pair, in a
//! network namespace that is created here. Needs root and iproute2.

use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const SECONDS: u64 = 14;
const CONFIG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../config");

/// Records at each rate. Prints processor time and memory, and the output of the daemon.
pub fn cost(rates_hz: &[u32]) {
    if !nix::unistd::geteuid().is_root() {
        println!("processor share and memory: skipped, needs root for a network namespace\n");
        return;
    }
    let namespace = format!("ballbard-bench-{}", std::process::id());
    let _removed = Namespace(namespace.clone());
    if !ip(&["netns", "add", &namespace])
        || !ip(&["-n", &namespace, "link", "add", "near", "type", "veth", "peer", "name", "far"])
        || !["near", "far"].iter().all(|end| ip(&["-n", &namespace, "link", "set", end, "up"]))
    {
        println!("processor share and memory: skipped, no network namespace or veth pair\n");
        return;
    }
    rates_hz.iter().for_each(|rate_hz| record(&namespace, *rate_hz));
}

fn record(namespace: &str, rate_hz: u32) {
    println!("processes at {rate_hz} Hz over veth      share of a core   peak memory");
    let out = std::env::temp_dir().join(namespace);
    configure(&out, rate_hz);
    let directory = out.to_string_lossy();
    // The segment has a high priority, because real terminals are not delayed by other load.
    let segment = Ended(ballbard(namespace, &["chrt", "-f", "81"], &["segment", "--interface", "far"]));
    std::thread::sleep(Duration::from_millis(500));
    let duration = format!("{SECONDS}s");
    let mut daemon = Ended(ballbard(
        namespace,
        &[],
        &[
            "record",
            "--bus",
            "near",
            "--name",
            "bench",
            "--duration",
            &duration,
            "--config",
            &directory,
            "--out",
            &directory,
        ],
    ));
    // The bring-up of the bus takes at most three seconds.
    std::thread::sleep(Duration::from_secs(3));
    let (begun, before) = (Instant::now(), [&daemon, &segment].map(|child| cpu_s(child.0.id())));
    std::thread::sleep(Duration::from_secs(SECONDS - 4));
    let elapsed_s = begun.elapsed().as_secs_f64();
    for (name, child, before) in [("daemon", &daemon, before[0]), ("segment", &segment, before[1])] {
        let share = (cpu_s(child.0.id()) - before) / elapsed_s * 100.0;
        println!("{name:10} {share:35.2} %  {:9.1} MB", peak_mb(child.0.id()));
    }
    let mut said = String::new();
    if let Some(mut stdout) = daemon.0.stdout.take() {
        let _ = stdout.read_to_string(&mut said);
    }
    println!("{said}");
    let _ = fs::remove_dir_all(out);
}

/// Writes the shipped configuration with another rate to this directory.
fn configure(directory: &Path, rate_hz: u32) {
    let shipped = |name: &str| fs::read_to_string(Path::new(CONFIG).join(name)).unwrap();
    fs::create_dir_all(directory).unwrap();
    fs::write(directory.join("ball_bar.toml"), shipped("ball_bar.toml")).unwrap();
    let daemon = shipped("daemon.toml").replace("rate_hz = 100", &format!("rate_hz = {rate_hz}"));
    fs::write(directory.join("daemon.toml"), daemon).unwrap();
}

/// A veth pair in the network namespace of this process, whose far end is for a segment in this process.
pub struct Veth(u32);

impl Veth {
    /// Creates the pair. `None` if this process lacks the permission.
    pub fn new() -> Option<Self> {
        let veth = Self(std::process::id());
        let [near, far] = veth.ends();
        let made = nix::unistd::geteuid().is_root()
            && ip(&["link", "add", &near, "type", "veth", "peer", "name", &far])
            && [&near, &far].into_iter().all(|end| ip(&["link", "set", end, "up"]));
        made.then_some(veth)
    }

    /// Names of the near and the far end.
    pub fn ends(&self) -> [String; 2] {
        [format!("bbn{}", self.0), format!("bbf{}", self.0)]
    }
}

impl Drop for Veth {
    fn drop(&mut self) {
        let [near, _] = self.ends();
        ip(&["link", "delete", &near]);
    }
}

struct Namespace(String);

impl Drop for Namespace {
    fn drop(&mut self) {
        ip(&["netns", "delete", &self.0]);
    }
}

/// A child process that is killed when the benchmark ends.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn ip(arguments: &[&str]) -> bool {
    Command::new("ip").args(arguments).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
}

fn ballbard(namespace: &str, under: &[&str], arguments: &[&str]) -> Child {
    let mut command = Command::new("ip");
    command
        .args(["netns", "exec", namespace])
        .args(under)
        .arg(env!("CARGO_BIN_EXE_ballbard"))
        .args(arguments);
    command.env("RUST_LOG", "warn").stdout(Stdio::piped()).spawn().unwrap()
}

/// Processor time that all threads of a process have used up to now \[s\]. The scheduler reports it in ns.
fn cpu_s(pid: u32) -> f64 {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let ran_ns = |text: String| text.split(' ').next().and_then(|field| field.parse::<f64>().ok());
    tasks.filter_map(|task| ran_ns(fs::read_to_string(task.path().join("schedstat")).ok()?)).sum::<f64>()
        * 1e-9
}

fn peak_mb(pid: u32) -> f64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kilobytes.map_or(f64::NAN, |kilobytes| kilobytes * 1024.0 * 1e-6)
}
