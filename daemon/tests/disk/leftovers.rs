//! Injects a fault into each disk call of a recovery. The call fails or transfers a single byte. Or the disk fails from this
//! call on, as if the program were killed there. Afterwards every recording must exist exactly once, complete or unchanged.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ballbard::clock::Clock;
use ballbard::record::Storage;
use ballbard::run::finish_leftovers;
use ballbard::scheduler::Threads;
use shared::recording::schema::CycleRecord;
use shared::recording::{Recording, Recovery, SystemDisk, recover_file_on, recover_leftovers_on};

use crate::support::runs::{daemon_in, in_parallel, leave};
use crate::support::wall::{Call, Fault, Wall};

/// Number of faults that are tested in parallel.
const AT_ONCE: usize = 4;
const CYCLES: u64 = 40;

/// Writes the files that earlier runs may leave into one directory: unfinished, torn, damaged,
/// empty, and already recovered files.
fn fill(directory: &Path) {
    let active = |name: &str| directory.join(format!("{name}.mcap.active"));
    let finished = |name: &str| directory.join(format!("{name}.mcap"));
    for name in ["crashed", "torn", "twice"] {
        leave(directory, name, CYCLES, false);
    }
    for name in ["good", "damaged", "named", "taken"] {
        leave(directory, name, CYCLES, true);
    }
    let torn = std::fs::read(active("torn")).unwrap();
    std::fs::write(active("torn"), &torn[..torn.len() - 5]).unwrap();
    let mut damaged = std::fs::read(finished("damaged")).unwrap();
    let middle = damaged.len() / 2;
    damaged[middle] ^= 1;
    std::fs::write(finished("damaged"), damaged).unwrap();
    std::fs::rename(finished("named"), active("named")).unwrap();
    // This file has already been recovered, but its original has not been removed yet.
    let twice = std::fs::read(active("twice")).unwrap();
    recover_file_on(&SystemDisk, &active("twice")).unwrap();
    std::fs::write(active("twice"), twice).unwrap();
    // Another run already has the name of this file.
    std::fs::copy(finished("good"), active("taken")).unwrap();
    std::fs::write(active("taken"), b"not of that run").unwrap();
    for name in ["empty.mcap.active", ".999999999-0.new"] {
        std::fs::write(directory.join(name), "").unwrap();
    }
}

/// Recovers all unfinished files, as the service does when it starts. Then recovers the damaged
/// file, as `ballbard recover` does.
fn recover(disk: &dyn shared::recording::Disk, directory: &Path) {
    let damaged = directory.join("damaged.mcap");
    let outcomes = recover_leftovers_on(disk, directory).into_iter().map(|leftover| leftover.outcome);
    for outcome in outcomes.chain([recover_file_on(disk, &damaged)]) {
        match outcome {
            Ok(Recovery::Whole { .. }) => {}
            // Every file that is reported must exist and have the reported number of cycles.
            Ok(Recovery::Renamed { file, content } | Recovery::Recovered { file, content, .. }) => {
                assert_eq!(Recording::open(&file).unwrap().cycles.len() as u64, content.cycles, "{file:?}");
            }
            Err(error) => assert!(error.to_string().contains('/'), "no word of which file: {error}"),
        }
    }
}

/// The cycles of each finished recording, by the name of its file.
fn finished(directory: &Path) -> BTreeMap<String, Vec<CycleRecord>> {
    files(directory)
        .into_iter()
        .filter(|path| path.extension().is_some_and(|ending| ending == "mcap"))
        .map(|path| {
            let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
            (name, Recording::open(&path).unwrap_or_else(|error| panic!("{error}")).cycles)
        })
        .collect()
}

fn files(directory: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path()).collect()
}

struct Clean {
    filled: tempfile::TempDir,
    calls: BTreeMap<Call, usize>,
    finished: BTreeMap<String, Vec<CycleRecord>>,
}

impl Clean {
    fn new() -> Self {
        let (filled, directory) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        fill(filled.path());
        copy(filled.path(), directory.path());
        let wall = Wall::new(directory.path(), None);
        recover(&wall, directory.path());
        Self { filled, calls: wall.calls(), finished: finished(directory.path()) }
    }

    fn cases(&self) -> Vec<(Call, usize, Fault)> {
        let faults = [Fault::Fails, Fault::DiesEverywhere, Fault::CutsShort];
        let of = |(call, count): (&Call, &usize)| {
            let call = *call;
            (0..*count).flat_map(move |nth| faults.map(|fault| (call, nth, fault)))
        };
        let cases = self.calls.iter().flat_map(of);
        cases.filter(|(call, _, fault)| *fault != Fault::CutsShort || call.moves_bytes()).collect()
    }

    /// Recovers the files on a disk with the given fault. Then recovers them again on a disk without faults, as the next
    /// start of the service does.
    fn check(&self, fault: (Call, usize, Fault)) {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        copy(self.filled.path(), directory);
        recover(&Wall::new(directory, Some(fault)), directory);
        recover(&SystemDisk, directory);
        let now = finished(directory);
        assert!(now.keys().eq(self.finished.keys()), "{:?}", now.keys());
        for (name, cycles) in &self.finished {
            // The first recovery may have renamed this file. It may contain cycles that the disk did
            // not return at that time.
            let torn = directory.join(format!("{name}.mcap.torn"));
            let is_kept = || {
                [format!("{name}.mcap.active"), format!("{name}.mcap")].iter().any(|original| {
                    let original = std::fs::read(self.filled.path().join(original));
                    original.is_ok_and(|bytes| std::fs::read(&torn).is_ok_and(|torn| torn == bytes))
                })
            };
            assert!(now[name] == *cycles || is_kept(), "{name}: cycles are lost");
        }
        let taken = std::fs::read(directory.join("taken.mcap.active"));
        let taken = taken.or_else(|_| std::fs::read(directory.join("taken.mcap.torn")));
        assert_eq!(taken.unwrap(), b"not of that run");
        for file in files(directory) {
            let name = file.file_name().unwrap().to_str().unwrap();
            assert!(
                !name.contains("recovering") && !name.contains("empty") && !name.starts_with('.'),
                "{name}"
            );
        }
    }
}

fn copy(from: &Path, to: &Path) {
    for file in files(from) {
        std::fs::copy(&file, to.join(file.file_name().unwrap())).unwrap();
    }
}

#[test]
#[ignore = "takes half a minute"]
fn whichever_call_of_a_recovery_goes_wrong_nothing_is_lost_and_the_next_one_finishes_it() {
    let clean = Clean::new();
    let cases = clean.cases();
    in_parallel(&cases, AT_ONCE, |case| clean.check(*case));
    println!("{} calls, {} cases, 0 failures", clean.calls.values().sum::<usize>(), cases.len());
}

#[test]
fn the_beginning_of_a_run_that_has_moved_is_not_a_second_recording_of_its_name() {
    let directory = tempfile::tempdir().unwrap();
    let daemon = daemon_in(directory.path());
    let [home, spare] = daemon.directories();
    for place in [&home, &spare] {
        std::fs::create_dir(place).unwrap();
    }
    leave(&home, "crashed", 20, false);
    leave(&home, "moved", 20, false);
    leave(&spare, "moved", CYCLES, true);
    let storage = Storage::new(&daemon, &*Threads::on(Clock::Real)).unwrap();
    assert_eq!(finish_leftovers(&storage), [home.join("crashed.mcap")]);
    assert_eq!(finished(&home).into_keys().collect::<Vec<_>>(), ["crashed"]);
    assert_eq!(finished(&spare)["moved"].len() as u64, CYCLES);
    // The beginning is kept under the name of a file that is not a recording.
    assert!(home.join("moved.mcap.torn").exists());
}
