#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("pose_table"),
    |bytes: &[u8]| system_tests::fuzzing::run("pose_table", bytes)
);
