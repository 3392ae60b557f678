//! The file under a recording: every write that comes through is a sign of life of the writer.
//!
//! In tests, what a disk may do to a program is done here: it takes nothing, or it fails; see [`faults`].

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Arc;

use crate::pulse::Pulse;

/// A file that is being recorded to; others see by its lock that it is in use.
pub(super) struct Disk {
    file: File,
    pulse: Arc<Pulse>,
    #[cfg(test)]
    faults: Arc<faults::Faults>,
}

impl Disk {
    /// Makes a file that does not exist yet: an older recording is never written over.
    pub(super) fn create(path: &Path, pulse: &Arc<Pulse>) -> io::Result<Self> {
        #[cfg(test)]
        let faults = faults::of(path.parent().unwrap_or(path));
        #[cfg(test)]
        faults.pass()?;
        let file = File::create_new(path)?;
        // A file system without locks records as well; there, retention goes by the name alone.
        let _ = file.try_lock();
        Ok(Self {
            file,
            pulse: Arc::clone(pulse),
            #[cfg(test)]
            faults,
        })
    }
}

impl Write for Disk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        #[cfg(test)]
        self.faults.pass()?;
        let written = self.file.write(bytes)?;
        self.pulse.beat();
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for Disk {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

/// Disks that hang and fail, by the folder of the recording.
#[cfg(test)]
pub(crate) mod faults {
    use std::collections::BTreeMap;
    use std::path::PathBuf;
    use std::sync::{Condvar, Mutex};

    use super::*;

    static ALL: Mutex<BTreeMap<PathBuf, Arc<Faults>>> = Mutex::new(BTreeMap::new());

    /// What the disk does to every write.
    #[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
    pub(crate) enum Fault {
        /// It takes it.
        #[default]
        None,
        /// It lets it wait.
        Hangs,
        /// It fails, with the number of the operating system.
        Fails(i32),
    }

    #[derive(Debug, Default)]
    pub(crate) struct Faults {
        /// And whether a write waits.
        now: Mutex<(Fault, bool)>,
        changed: Condvar,
    }

    /// Of the disk under a folder.
    pub(crate) fn of(folder: &Path) -> Arc<Faults> {
        Arc::clone(ALL.lock().unwrap().entry(folder.to_path_buf()).or_default())
    }

    impl Faults {
        pub(crate) fn set(&self, fault: Fault) {
            self.now.lock().unwrap().0 = fault;
            self.changed.notify_all();
        }

        /// Returns when a write waits.
        pub(crate) fn wait_for_write(&self) {
            drop(self.changed.wait_while(self.now.lock().unwrap(), |(_, waits)| !*waits).unwrap());
        }

        pub(super) fn pass(&self) -> io::Result<()> {
            let mut now = self.now.lock().unwrap();
            while now.0 == Fault::Hangs {
                now.1 = true;
                self.changed.notify_all();
                now = self.changed.wait(now).unwrap();
            }
            now.1 = false;
            match now.0 {
                Fault::Fails(number) => Err(io::Error::from_raw_os_error(number)),
                Fault::None | Fault::Hangs => Ok(()),
            }
        }
    }
}
