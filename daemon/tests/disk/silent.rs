//! A disk that does not answer, in real time: the watch has threads of its own.

use std::io::{self, Write};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ballbard::record::Storage;
use shared::config::DaemonConfig;

use crate::support::wall::{Call, Fault, Wall};

/// Longer than a look at the disk may take.
const HANG: Duration = Duration::from_secs(3);

#[test]
fn a_disk_that_does_not_answer_is_reported_within_a_second_to_who_asks_and_in_the_log() {
    let log = Arc::<Mutex<Vec<u8>>>::default();
    let lines = Arc::clone(&log);
    let subscriber = tracing_subscriber::fmt().with_writer(move || Log(Arc::clone(&lines))).finish();
    tracing::subscriber::set_global_default(subscriber).unwrap();
    let directory = tempfile::tempdir().unwrap();
    let daemon = DaemonConfig { directory: directory.path().to_owned(), ..DaemonConfig::default() };
    let wall = Arc::new(Wall::new(directory.path(), Some((Call::Space, 3, Fault::Hangs(HANG)))));
    let storage = Storage::on(wall.clone(), &daemon).unwrap();
    let struck = loop {
        if let Some(struck) = wall.struck() {
            break struck;
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    let text = format!("the disk of {} has not answered for", directory.path().display());
    let is_logged = || String::from_utf8_lossy(&log.lock().unwrap()).contains(&text);
    while !is_logged() || !storage.problem().is_some_and(|problem| problem.text.contains(&text)) {
        assert!(struck.elapsed() < Duration::from_secs(1), "nobody is told");
        std::thread::sleep(Duration::from_millis(5));
    }
    println!("reported after {:.2} s", struck.elapsed().as_secs_f64());
}

/// What is logged.
struct Log(Arc<Mutex<Vec<u8>>>);

impl Write for Log {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(line)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
