#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("bar_log_bag"),
    |bytes: &[u8]| system_tests::fuzzing::run("bar_log_bag", bytes)
);
