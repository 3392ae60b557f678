#![no_main]

#[path = "../request_entry_points.rs"]
mod entry_points;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| entry_points::request(bytes));
