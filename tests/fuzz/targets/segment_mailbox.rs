#![no_main]

libfuzzer_sys::fuzz_target!(
    init: system_tests::fuzzing::unpack("segment_mailbox"),
    |bytes: &[u8]| system_tests::fuzzing::run("segment_mailbox", bytes)
);
