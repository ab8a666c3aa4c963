//! Tests of the page in a real browser.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;

use tokio::sync::oneshot;

use crate::clock::Clock;
use crate::control::api::{self, Remote, RemoteSettings};
use crate::control::service::tests::settings;
use crate::control::service::{Service, Settings};
use crate::homing::MarksFile;
use crate::run::{self, Setup, Storage};
use crate::scheduler::Threads;
use crate::segment::InProcessWire;
use crate::segment::faults::{FaultHandle, FaultSwitch, FaultySegment};
use crate::segment::simulated::{Hand, HandTurned, SegmentConfig, SimulatedSegment, SmoothMotion};

/// A service on a simulated bus. The test switches its faults and turns its joints.
struct Bench {
    service: Service,
    bus: Arc<Mutex<Option<(FaultHandle, Hand)>>>,
    directory: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let state = directory.path().join("state");
        let settings = Settings { marks_file: MarksFile::new(state, None), ..settings(directory.path()) };
        let scheduler = Threads::on(Clock::Real);
        let storage = Storage::new(&settings.daemon, &*scheduler).unwrap();
        let bus = Arc::new(Mutex::new(None));
        let (by_hand, daemon, bar) = (Arc::clone(&bus), settings.daemon.clone(), settings.bar.clone());
        let setup = Setup { scheduler: Arc::clone(&scheduler), storage: storage.clone(), daemon, bar };
        let connect = move || {
            let motion = SmoothMotion::new(setup.bar.encoders.len(), 3600, 1);
            let (turned, hand) = HandTurned::new(motion);
            let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(turned));
            let (segment, faults) = FaultySegment::new(segment, 1);
            *by_hand.lock().unwrap() = Some((faults, hand));
            let wire = InProcessWire::with_faults(segment, Clock::Real);
            run::open_on_wire(Box::new(wire), &setup)
        };
        Self {
            service: Service::start_with(scheduler, settings, storage, Arc::new(connect)).unwrap(),
            bus,
            directory,
        }
    }

    /// Executes a command of the browser script: it turns a joint, makes the state directory unusable, damages a copy of a
    /// recording, or switches a fault.
    fn handle(&self, asked: &str) {
        if let Some(name) = asked.strip_prefix("damage a copy of ") {
            let mut bytes = std::fs::read(self.directory.path().join(format!("{name}.mcap"))).unwrap();
            let middle = bytes.len() / 2;
            bytes[middle] ^= 0x10;
            return std::fs::write(self.directory.path().join("damaged.mcap"), bytes).unwrap();
        }
        let bus = self.bus.lock().unwrap();
        let (faults, hand) = bus.as_ref().unwrap();
        let state = self.directory.path().join("state");
        match asked {
            "hold" => hand.hold(),
            "let go" => hand.let_go(),
            "state in the way" => std::fs::write(state, "").unwrap(),
            "state free" => std::fs::remove_file(state).unwrap(),
            _ => match asked.strip_prefix("turn joint ") {
                Some(joint) => hand.turn(joint.parse::<usize>().unwrap() - 1),
                None => {
                    let FaultSwitch { fault, on } = asked.parse().unwrap();
                    if on { faults.begin(fault) } else { faults.end(fault) }
                }
            },
        }
    }

    /// Serves until the sender is dropped. Returns the addresses for this machine and for other machines.
    fn serve(&self) -> ([String; 2], oneshot::Sender<()>) {
        let (end, ended) = oneshot::channel::<()>();
        let (address, at) = std::sync::mpsc::channel();
        let (service, state) = (self.service.clone(), self.directory.path().join("remote"));
        thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                let listener = tokio::net::TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
                let here = format!("http://{}/", listener.local_addr().unwrap());
                let listen = Some(([127, 0, 0, 1], 0).into());
                let remote = Remote::open(RemoteSettings { listen, ..RemoteSettings::default() }, &state)
                    .await
                    .unwrap();
                let elsewhere = remote.words.split(',').next().unwrap().to_owned();
                address.send([here, elsewhere]).unwrap();
                api::serve(listener, Some(remote), service, async { drop(ended.await) }).await;
            });
        });
        (at.recv().unwrap(), end)
    }
}

/// Path of an installed program.
fn find_program(names: &[&str]) -> Option<PathBuf> {
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let at =
        |name: &&str| std::env::split_paths(&paths).map(|path| path.join(name)).find(|path| path.is_file());
    names.iter().find_map(at)
}

#[test]
#[ignore = "needs chromium, and Python with tests/requirements.txt"]
fn a_technician_records_finds_a_fault_and_downloads_the_file() {
    let chromium = find_program(&["chromium", "chromium-browser", "google-chrome"]);
    let chromium = chromium.expect("chromium is missing: apt-get install chromium");
    let python = std::env::var_os("BALLBAR_PYTHON").unwrap_or_else(|| "python3".into());
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let bench = Bench::new();
    let (urls, end) = bench.serve();
    // The environment variable sets the directory for the pictures.
    let pictures =
        std::env::var_os("BALLBAR_PICTURES").map_or_else(|| bench.directory.path().into(), PathBuf::from);
    std::fs::create_dir_all(&pictures).unwrap();
    let mut story = Command::new(python)
        .arg(tests.join("tests/page_story.py"))
        .arg(chromium)
        .args(urls)
        .args([bench.directory.path().join("remote/token"), pictures, tests.join("../tests")])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut replies = story.stdin.take().unwrap();
    let mut end = Some(end);
    for line in BufReader::new(story.stdout.take().unwrap()).lines().map_while(Result::ok) {
        match line.strip_prefix("> ") {
            Some("end") => drop(end.take()),
            Some(asked) => bench.handle(asked),
            None => {
                println!("{line}");
                continue;
            }
        }
        writeln!(replies, "done").unwrap();
    }
    assert!(story.wait().unwrap().success(), "the story above went wrong");
    bench.service.shutdown("test over");
    bench.service.join().unwrap();
}
