#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("api"),
    |bytes: &[u8]| system_tests::fuzzing::run("api", bytes)
);
