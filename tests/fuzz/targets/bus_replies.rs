#![no_main]

libfuzzer_sys::fuzz_target!(
    init: {
        system_tests::fuzzing::unpack("bus_replies");
        // The bus catches panics of ethercrab, but the panic hook of the fuzzer would abort the process first. An uncaught
        // panic still ends the fuzzer.
        std::panic::set_hook(Box::new(|_| {}));
    },
    |bytes: &[u8]| system_tests::fuzzing::run("bus_replies", bytes)
);
