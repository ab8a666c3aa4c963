//! Runs the fuzz targets on all saved inputs. This test needs no fuzzer.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use system_tests::fuzzing::TARGETS;

fn run_all(name: &str) {
    let target = TARGETS.iter().find(|target| target.name == name).unwrap();
    assert!(!target.archived().unwrap().is_empty(), "no corpus for {name}");
    for (input, bytes) in target.inputs().unwrap() {
        // If the test fails, the last printed name is the input that caused the failure.
        println!("{name}/{input}");
        (target.run)(&bytes);
    }
}

macro_rules! corpora {
    ($($test:ident: $name:literal),* $(,)?) => {
        $(#[test] fn $test() { run_all($name); })*

        #[test]
        fn every_target_has_its_corpus_test_and_its_fuzz_target() {
            assert_eq!(TARGETS.iter().map(|target| target.name).collect::<Vec<_>>(), [$($name),*]);
            let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz");
            for folder in fuzz.join("regressions").read_dir().unwrap() {
                let name = folder.unwrap().file_name();
                assert!(TARGETS.iter().any(|target| *target.name == name), "{name:?} is no target");
            }
            for target in TARGETS {
                let file = fuzz.join(format!("targets/{}.rs", target.name));
                assert!(file.exists(), "{}", file.display());
            }
        }
    };
}

corpora! {
    no_recording_of_the_corpus_breaks_a_promise: "recording",
    no_recorded_content_of_the_corpus_breaks_a_promise: "recording_content",
    no_frame_of_the_corpus_breaks_a_promise: "segment_frames",
    no_mailbox_request_of_the_corpus_breaks_a_promise: "segment_mailbox",
    no_bus_reply_of_the_corpus_breaks_a_promise: "bus_replies",
    no_cyclic_reply_of_the_corpus_breaks_a_promise: "cycle_replies",
    no_configuration_of_the_corpus_breaks_a_promise: "config",
    no_robot_table_of_the_corpus_breaks_a_promise: "robot_log_table",
    no_mcap_bag_of_the_corpus_breaks_a_promise: "robot_log_mcap",
    no_sqlite_bag_of_the_corpus_breaks_a_promise: "robot_log_db3",
    no_egm_capture_of_the_corpus_breaks_a_promise: "robot_log_egm",
    no_rsi_log_of_the_corpus_breaks_a_promise: "robot_log_rsi",
    no_table_of_the_bar_of_the_corpus_breaks_a_promise: "bar_log_table",
    no_bag_of_the_bar_of_the_corpus_breaks_a_promise: "bar_log_bag",
    no_table_of_poses_of_the_corpus_breaks_a_promise: "pose_table",
    no_force_log_of_the_corpus_breaks_a_promise: "force_log",
    no_calibration_of_the_corpus_breaks_a_promise: "calibration",
    no_http_request_of_the_corpus_breaks_a_promise: "api",
}
