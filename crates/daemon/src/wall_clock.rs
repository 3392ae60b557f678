//! Steps of this machine's clock: times of frames and of the recording are told by it, so a step is told, too.
//!
//! Nothing that the service waits for is measured by it. Of a frame that was under way over a step the age is wrong or unknown;
//! see [`frame_clients`](crate::frame_clients).

use std::time::{Duration, Instant, SystemTime};

/// What a clock that is corrected gently is off between two looks, at most.
const LEAST_STEP: Duration = Duration::from_millis(500);

/// Compares the clock of the wall with one that never steps.
#[derive(Debug, Clone, Copy)]
pub(crate) struct WallClock {
    last: (Instant, SystemTime),
}

impl WallClock {
    pub(crate) fn new(now: Instant, wall: SystemTime) -> Self {
        Self { last: (now, wall) }
    }

    /// By how much the clock has stepped since the last look, ms, forward if positive; none if it has not.
    pub(crate) fn step_ms(&mut self, now: Instant, wall: SystemTime) -> Option<i64> {
        let (last_now, last_wall) = std::mem::replace(&mut self.last, (now, wall));
        let expected = last_wall + now.saturating_duration_since(last_now);
        let (step, sign) = match wall.duration_since(expected) {
            Ok(ahead) => (ahead, 1),
            Err(behind) => (behind.duration(), -1),
        };
        (step >= LEAST_STEP).then(|| sign * i64::try_from(step.as_millis()).unwrap_or(i64::MAX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_told_once_and_drift_is_none() {
        let (now, wall) = (Instant::now(), SystemTime::now());
        let (second, hour) = (Duration::from_secs(1), Duration::from_secs(3600));
        let mut clock = WallClock::new(now, wall);
        assert_eq!(clock.step_ms(now + second, wall + second + Duration::from_millis(499)), None);
        assert_eq!(clock.step_ms(now + 2 * second, wall + 2 * second + hour), Some(3_599_501));
        assert_eq!(clock.step_ms(now + 3 * second, wall + 3 * second + hour), None);
        assert_eq!(clock.step_ms(now + 4 * second, wall + 4 * second), Some(-3_600_000));
        assert_eq!(clock.step_ms(now + 5 * second, wall + 5 * second), None);
    }
}
