#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("calibration"),
    |bytes: &[u8]| system_tests::fuzzing::run("calibration", bytes)
);
