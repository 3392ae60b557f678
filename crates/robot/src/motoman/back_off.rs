//! How long to wait between attempts to connect: longer after each that failed.

use std::time::Duration;

/// Doubles the wait from attempt to attempt.
#[derive(Debug, Clone)]
pub(crate) struct BackOff {
    least: Duration,
    most: Duration,
    wait: Duration,
    not_before: Duration,
}

impl BackOff {
    pub(crate) fn new(least: Duration, most: Duration) -> Self {
        Self { least, most, wait: least, not_before: Duration::ZERO }
    }

    /// Time that is still to be waited at `now`.
    pub(crate) fn remaining(&self, now: Duration) -> Duration {
        self.not_before.saturating_sub(now)
    }

    /// An attempt failed at `now`.
    pub(crate) fn failed(&mut self, now: Duration) {
        self.not_before = now + self.wait;
        self.wait = (self.wait * 2).min(self.most);
    }

    /// The connection has served a command. That it could be made alone is not enough: something that accepts and
    /// closes would be called without end.
    pub(crate) fn served(&mut self) {
        self.wait = self.least;
        self.not_before = Duration::ZERO;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_double_up_to_the_greatest_and_begin_anew_after_a_served_command() {
        let mut back_off = BackOff::new(Duration::from_millis(250), Duration::from_secs(5));
        let mut now = Duration::ZERO;
        assert_eq!(back_off.remaining(now), Duration::ZERO, "the first attempt is free");
        for wait_ms in [250, 500, 1000, 2000, 4000, 5000, 5000] {
            back_off.failed(now);
            assert_eq!(back_off.remaining(now), Duration::from_millis(wait_ms));
            now += Duration::from_millis(wait_ms);
            assert_eq!(back_off.remaining(now), Duration::ZERO);
        }
        back_off.failed(now);
        back_off.served();
        assert_eq!(back_off.remaining(now), Duration::ZERO);
        back_off.failed(now);
        assert_eq!(back_off.remaining(now), Duration::from_millis(250));
    }
}
