//! Memory in `/dev/shm`: whether there is room for what a publisher may need, and taking all of it at once.
//!
//! A file in `/dev/shm` gets its pages as they are written to. On a full file system that is no error but a signal (SIGBUS) that
//! ends the process, at any frame. So a publisher looks for room first, and then takes its pages before its first frame.

use std::ffi::c_void;
use std::fs;
use std::io;
use std::path::Path;

use rustix::mm::{Advice, madvise};

/// Where shared memory lies.
const SHARED_MEMORY: &str = "/dev/shm";

/// Bytes beside the payload of a slot that are certainly enough for its headers.
const SLOT_OVERHEAD: usize = 256;

/// Bytes that `slots` payloads of so many bytes take in shared memory.
pub(crate) fn needed_bytes(slots: usize, payload_bytes: usize) -> u64 {
    (slots as u64).saturating_mul(payload_bytes.saturating_add(SLOT_OVERHEAD) as u64)
}

/// Free bytes of the file system of shared memory; none if it cannot tell.
pub(crate) fn free_bytes() -> Option<u64> {
    rustix::fs::statvfs(Path::new(SHARED_MEMORY)).ok().map(|s| s.f_bavail.saturating_mul(s.f_frsize))
}

/// Takes every page of the mapping that `address` lies in.
///
/// # Errors
/// What the system says when they are not to be had; a kernel before Linux 5.14 cannot do this, which is no error.
pub(crate) fn take_mapping(address: *const c_void) -> io::Result<()> {
    let maps = fs::read_to_string("/proc/self/maps")?;
    let Some((start, end)) = maps.lines().filter_map(range).find(|range| contains(*range, address as usize)) else {
        return Ok(());
    };
    // SAFETY: the range is one whole mapping of this process, writable and shared. Taking its pages neither changes nor moves
    // what lies in them; that it is not unmapped meanwhile is up to the caller, who holds a slot in it.
    match unsafe { madvise(start as *mut c_void, end - start, Advice::LinuxPopulateWrite) } {
        Err(rustix::io::Errno::INVAL) | Ok(()) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// The addresses at the beginning of a line of `/proc/self/maps`.
fn range(line: &str) -> Option<(usize, usize)> {
    let (start, end) = line.split_whitespace().next()?.split_once('-')?;
    Some((usize::from_str_radix(start, 16).ok()?, usize::from_str_radix(end, 16).ok()?))
}

fn contains((start, end): (usize, usize), address: usize) -> bool {
    (start..end).contains(&address)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_the_map_are_read() {
        assert_eq!(range("7f00-7fff rw-s 00000000 00:1a 12 /dev/shm/x"), Some((0x7f00, 0x7fff)));
        assert_eq!(range("no map"), None);
        assert!(contains((16, 32), 16) && !contains((16, 32), 32));
        assert_eq!(needed_bytes(2, 1000), 2512);
    }

    #[test]
    fn memory_of_this_process_can_be_taken() {
        let page = vec![1_u8; 1 << 16];
        take_mapping(page.as_ptr().cast()).unwrap();
        assert!(page.iter().all(|byte| *byte == 1), "what lies there stays");
        take_mapping(std::ptr::null()).unwrap();
        assert!(free_bytes().is_some());
    }
}
