#![no_main]

#[path = "../reply_entry_points.rs"]
mod entry_points;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| entry_points::reply(bytes));
