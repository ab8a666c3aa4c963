//! Measures the timing of the cycle on this machine, without and with a load: `cargo bench -p ballbard`.
//!
//! The benchmark prints the lateness of the cycle, and that of `cyclictest` under the same load; the two run alternately. It
//! prints the error of sample times against the true sampling instants of the simulated terminals. It also prints processor
//! time and memory of the daemon, and the highest rate without a lost cycle. All figures come from one run on one machine,
//! so that their ratios are meaningful even if the absolute figures are not.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "a benchmark")]

#[path = "realtime/load.rs"]
mod load;
#[path = "realtime/measure.rs"]
mod measure;
#[path = "realtime/process.rs"]
mod process;
#[path = "../tests/support/mod.rs"]
mod support;

use load::Load;
use measure::{Bus, Distribution, cyclictest, run_cycles};

/// Number of times that the cycle and cyclictest alternate at each rate.
const REPEATS: usize = 7;
const PRIORITY: i32 = 80;

fn main() {
    // `cargo test --benches` runs this program too, but without the argument `--bench`. It then measures nothing.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    println!("{cores} cores; load: {cores} threads that compute, write memory and make system calls\n");
    let veth = process::Veth::new();
    let veth = veth.as_ref().map(|veth| Bus::Veth(veth.ends()));
    if veth.is_none() {
        println!("the segment answers in the cycle's own thread: a veth pair needs root\n");
    }
    lateness(cores, veth.as_ref().unwrap_or(&Bus::InProcess));
    time_stamps(cores, veth.as_ref());
    process::cost(&[100, 1000]);
    highest_rate(cores);
}

fn lateness(cores: usize, bus: &Bus) {
    println!("wake-up lateness [us]              p50      p99    p99.9      max");
    for (rate_hz, seconds) in [(100, 2), (1000, 1)] {
        for loaded in [false, true] {
            let _load = loaded.then(|| Load::start(cores));
            let state = if loaded { "loaded" } else { "quiet" };
            let (mut ours, mut theirs) = (Distribution::default(), Distribution::default());
            let mut ratios: [Vec<f64>; 2] = Default::default();
            for _ in 0..REPEATS {
                let cycles = rate_hz * seconds;
                let measured = run_cycles(bus.clone(), rate_hz, cycles, PRIORITY).lateness;
                if let Some(reference) = cyclictest(rate_hz, cycles, PRIORITY) {
                    for (ratios, part) in ratios.iter_mut().zip([0.5, 0.99]) {
                        ratios.push(measured.quantile_us(part) / reference.quantile_us(part));
                    }
                    theirs.append(reference);
                }
                ours.append(measured);
            }
            println!("{rate_hz:5} Hz {state:7} ballbard    {}", ours.row());
            if !theirs.is_empty() {
                println!("{rate_hz:5} Hz {state:7} cyclictest  {}", theirs.row());
                println!("{rate_hz:5} Hz {state:7} ratio       {}", ours.ratio_row(&theirs));
                // A virtual machine may be stopped for milliseconds. The median of repeats is not affected by this.
                let [p50, p99] = ratios.map(Distribution::range);
                println!(
                    "{rate_hz:5} Hz {state:7} ratio, least, median and most of the repeats: p50 {p50}, p99 {p99}"
                );
            } else {
                println!("cyclictest gives nothing: apt-get install rt-tests, and run as root");
            }
        }
    }
    println!();
}

fn time_stamps(cores: usize, veth: Option<&Bus>) {
    println!(
        "error of sample times [us]         p50      p99    p99.9      max   within 3 sigma   median sigma"
    );
    for bus in [Some(&Bus::InProcess), veth].into_iter().flatten() {
        for (rate_hz, seconds, loaded) in [(100, 4, true), (1000, 2, false), (1000, 3, true)] {
            let _load = loaded.then(|| Load::start(cores));
            let name = if matches!(bus, Bus::InProcess) { "in process" } else { "veth" };
            let measured = run_cycles(bus.clone(), rate_hz, rate_hz * seconds, PRIORITY);
            let state = if loaded { "loaded" } else { "quiet" };
            println!(
                "{rate_hz:5} Hz {state:7} {name:11} {}   {:8.3} %   {:8.1} us",
                measured.errors.row(),
                measured.covered_percent,
                measured.sigma.quantile_us(0.5),
            );
        }
    }
    println!();
}

/// Prints the highest rate that the machine sustains. A cycle that is late by more than half a period comes after the next
/// sample. For cyclictest, wake-ups that are late by more than half a period are therefore counted.
fn highest_rate(cores: usize) {
    println!(
        "highest rate, 4 s each: cycles flagged (none is ever missing)   beside: cyclictest late by half a period"
    );
    for loaded in [false, true] {
        let _load = loaded.then(|| Load::start(cores));
        let state = if loaded { "loaded" } else { "quiet" };
        let mut held = 0;
        for rate_hz in [100, 250, 500, 1000, 2000, 4000] {
            let measured = run_cycles(Bus::InProcess, rate_hz, rate_hz * 4, PRIORITY);
            let reference = cyclictest(rate_hz, rate_hz * 4, PRIORITY);
            let beyond = reference.map_or("-".into(), |late| late.above_us(5e5 / rate_hz as f64).to_string());
            println!("{rate_hz:5} Hz {state:7} {:6} of {:6} {beyond:>20}", measured.flagged, measured.cycles);
            if measured.flagged == 0 {
                held = rate_hz;
            }
        }
        println!("held without one: {held} Hz ({state})");
    }
}
