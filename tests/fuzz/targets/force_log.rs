#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("force_log"),
    |bytes: &[u8]| system_tests::fuzzing::run("force_log", bytes)
);
