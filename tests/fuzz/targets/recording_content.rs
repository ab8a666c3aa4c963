#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("recording_content"),
    |bytes: &[u8]| system_tests::fuzzing::run("recording_content", bytes)
);
