#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("config"),
    |bytes: &[u8]| system_tests::fuzzing::run("config", bytes)
);
