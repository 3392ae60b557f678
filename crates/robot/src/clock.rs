//! Time as a controller sees it: monotonic in life, hand-driven in tests.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A clock that never goes back.
///
/// Input: none. Output: the time since an origin of the clock's own; only differences mean anything.
pub trait Clock: Send + Sync {
    /// Time since the origin of this clock.
    fn now(&self) -> Duration;

    /// Waits until `duration` has passed on this clock.
    fn sleep(&self, duration: Duration);
}

/// The clock of life.
#[derive(Debug, Clone, Copy)]
pub struct MonotonicClock {
    origin: Instant,
}

impl MonotonicClock {
    /// A clock whose origin is now.
    pub fn new() -> Self {
        Self { origin: Instant::now() }
    }
}

impl Default for MonotonicClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for MonotonicClock {
    fn now(&self) -> Duration {
        self.origin.elapsed()
    }

    fn sleep(&self, duration: Duration) {
        std::thread::sleep(duration);
    }
}

/// A clock that runs faster than life, for a robot that is not there.
#[derive(Debug, Clone, Copy)]
pub struct ScaledClock {
    origin: Instant,
    rate: f64,
}

impl ScaledClock {
    /// A clock that runs `rate` times as fast as life, 0.01 to 1000; its origin is now. Other rates are brought into that range.
    pub fn new(rate: f64) -> Self {
        let rate = if rate.is_finite() { rate.clamp(0.01, 1000.0) } else { 1.0 };
        Self { origin: Instant::now(), rate }
    }

    /// The time on this clock so long ago in life.
    pub fn ago(&self, life: Duration) -> Duration {
        self.now().saturating_sub(life.mul_f64(self.rate))
    }
}

impl Clock for ScaledClock {
    fn now(&self) -> Duration {
        self.origin.elapsed().mul_f64(self.rate)
    }

    fn sleep(&self, duration: Duration) {
        std::thread::sleep(duration.div_f64(self.rate));
    }
}

/// A clock that stands still until it is driven; clones share the time.
///
/// [`Clock::sleep`] moves it on at once, so that code which waits runs as fast as it can.
#[derive(Debug, Clone, Default)]
pub struct ManualClock {
    nanos: Arc<AtomicU64>,
}

impl ManualClock {
    /// A clock at its origin.
    pub fn new() -> Self {
        Self::default()
    }

    /// Moves the clock on.
    pub fn advance(&self, duration: Duration) {
        // 584 years of nanoseconds: saturating is as good as any other answer.
        let step = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        self.nanos.fetch_add(step, Ordering::SeqCst);
    }
}

impl Clock for ManualClock {
    fn now(&self) -> Duration {
        Duration::from_nanos(self.nanos.load(Ordering::SeqCst))
    }

    fn sleep(&self, duration: Duration) {
        self.advance(duration);
    }
}

impl<C: Clock + ?Sized> Clock for Arc<C> {
    fn now(&self) -> Duration {
        (**self).now()
    }

    fn sleep(&self, duration: Duration) {
        (**self).sleep(duration);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scaled_clock_runs_at_its_rate() {
        let clock = ScaledClock::new(50.0);
        let (start, life) = (clock.now(), Instant::now());
        clock.sleep(Duration::from_millis(500));
        let (passed, life) = (clock.now() - start, life.elapsed());
        assert!(passed >= Duration::from_millis(500));
        // However long the machine let it wait, both clocks saw the same wait.
        assert!((passed.as_secs_f64() / life.as_secs_f64() / 50.0 - 1.0).abs() < 0.2, "{passed:?} in {life:?}");
        assert!(clock.ago(Duration::from_millis(1)) <= clock.now() - Duration::from_millis(49));
        assert_eq!(ScaledClock::new(f64::NAN).rate, 1.0);
    }

    #[test]
    fn manual_clock_moves_only_when_driven_and_clones_share_it() {
        let clock = ManualClock::new();
        let other = clock.clone();
        assert_eq!(other.now(), Duration::ZERO);
        clock.advance(Duration::from_millis(7));
        other.sleep(Duration::from_millis(3));
        assert_eq!(clock.now(), Duration::from_millis(10));
    }
}
