#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("robot_log_db3"),
    |bytes: &[u8]| system_tests::fuzzing::run("robot_log_db3", bytes)
);
