#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| greybox_fuzz::mcap(bytes));
