//! The pulse of a part of the service: when it last gave a sign of life, without a lock.
//!
//! A part beats whenever it gets round its loop. Between two beats it may rest, which is to sleep until another part has
//! something for it, or until it looks about by itself, at least each second. What neither rests nor beats is stuck; what has
//! ended beats no more.

use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::time::{Duration, Instant};

const WORKS: u8 = 0;
const RESTS: u8 = 1;
const ENDED: u8 = 2;

/// The pulse of one part.
#[derive(Debug)]
pub(crate) struct Pulse {
    epoch: Instant,
    /// Since the epoch, ms.
    beat_ms: AtomicU64,
    state: AtomicU8,
}

/// What a pulse shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sign {
    /// It works, and has given a sign of life in time.
    Works,
    /// It waits for others.
    Rests,
    /// It works, and has given no sign of life for too long.
    Stuck,
    /// It will give none any more.
    Ended,
}

impl Pulse {
    /// Of a part that begins now.
    pub(crate) fn new() -> Self {
        Self { epoch: Instant::now(), beat_ms: AtomicU64::new(0), state: AtomicU8::new(WORKS) }
    }

    /// A sign of life of a part that works.
    pub(crate) fn beat(&self) {
        self.set(WORKS);
    }

    /// A sign of life of a part that will wait for others.
    pub(crate) fn rest(&self) {
        self.set(RESTS);
    }

    /// The part is no more.
    pub(crate) fn end(&self) {
        self.set(ENDED);
    }

    fn set(&self, state: u8) {
        self.beat_ms.store(self.epoch.elapsed().as_millis() as u64, Ordering::SeqCst);
        self.state.store(state, Ordering::SeqCst);
    }

    /// Since the last sign of life.
    pub(crate) fn age(&self) -> Duration {
        let beat = Duration::from_millis(self.beat_ms.load(Ordering::SeqCst));
        self.epoch.elapsed().saturating_sub(beat)
    }

    /// What it shows; a part that works may take `patience` from one beat to the next.
    pub(crate) fn sign(&self, patience: Duration) -> Sign {
        match self.state.load(Ordering::SeqCst) {
            RESTS => Sign::Rests,
            ENDED => Sign::Ended,
            _ if self.age() > patience => Sign::Stuck,
            _ => Sign::Works,
        }
    }
}

/// Ends a pulse when its thread does, however that comes about.
#[derive(Debug)]
pub(crate) struct EndsWith<'a>(pub(crate) &'a Pulse);

impl Drop for EndsWith<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_works_can_be_stuck_and_a_thread_that_panics_has_ended() {
        let pulse = Pulse::new();
        let (no_patience, patience) = (Duration::ZERO, Duration::from_secs(3600));
        assert_eq!(pulse.sign(patience), Sign::Works);
        while pulse.age() < Duration::from_millis(2) {
            std::hint::spin_loop();
        }
        assert_eq!(pulse.sign(no_patience), Sign::Stuck);
        pulse.rest();
        assert_eq!(pulse.sign(no_patience), Sign::Rests);
        pulse.beat();
        assert_eq!(pulse.sign(patience), Sign::Works);
        let panics = std::thread::scope(|scope| {
            let work = scope.spawn(|| {
                let _ends = EndsWith(&pulse);
                assert!(pulse.age() > patience, "a panic on purpose");
            });
            work.join().is_err()
        });
        assert!(panics);
        assert_eq!(pulse.sign(no_patience), Sign::Ended);
    }
}
