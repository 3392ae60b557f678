//! Quantiles of a stream of durations in constant memory.
//!
//! Input: durations, one after another, for as long as the service runs. Output: count, median, 99th percentile and
//! greatest value. A quantile is the middle of its bucket and off by at most 1/64 of the value; the greatest value is exact.

use std::time::Duration;

/// Buckets for each power of two.
const STEPS: u64 = 32;
const STEP_BITS: u32 = STEPS.ilog2();
const BUCKETS: usize = (64 - STEP_BITS as usize + 1) * STEPS as usize;

/// Counts of durations in buckets whose width grows with the value.
#[derive(Debug, Clone)]
pub(crate) struct Durations {
    buckets: Box<[u64]>,
    count: u64,
    max_ns: u64,
}

impl Default for Durations {
    fn default() -> Self {
        Self { buckets: vec![0; BUCKETS].into_boxed_slice(), count: 0, max_ns: 0 }
    }
}

impl Durations {
    pub(crate) fn add(&mut self, duration: Duration) {
        let ns = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        self.buckets[bucket(ns)] += 1;
        self.count += 1;
        self.max_ns = self.max_ns.max(ns);
    }

    pub(crate) fn count(&self) -> u64 {
        self.count
    }

    pub(crate) fn max(&self) -> Duration {
        Duration::from_nanos(self.max_ns)
    }

    /// The value that a share of `quantile`, in [0, 1], does not exceed; zero when there are no values.
    pub(crate) fn quantile(&self, quantile: f64) -> Duration {
        let rank = ((self.count as f64 * quantile).ceil() as u64).clamp(1, self.count.max(1));
        let mut below = 0;
        for (index, n) in self.buckets.iter().enumerate() {
            below += n;
            if below >= rank {
                return Duration::from_nanos(middle(index).min(self.max_ns));
            }
        }
        Duration::ZERO
    }
}

fn bucket(ns: u64) -> usize {
    if ns < STEPS {
        return ns as usize;
    }
    let shift = ns.ilog2() - STEP_BITS;
    (u64::from(shift + 1) * STEPS + (ns >> shift) - STEPS) as usize
}

fn middle(bucket: usize) -> u64 {
    let bucket = bucket as u64;
    let Some(shift) = (bucket / STEPS).checked_sub(1) else { return bucket };
    let start = (STEPS + bucket % STEPS) << shift;
    start + ((1 << shift) >> 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_follow_each_other_and_hold_their_middle() {
        let mut last = 0;
        for ns in (0..100_000).chain([u64::MAX / 3, u64::MAX - 1, u64::MAX]) {
            let b = bucket(ns);
            assert!(b < BUCKETS && (b == last || b == last + 1 || ns > 100_000), "{ns}");
            assert_eq!(bucket(middle(b)), b);
            assert!(middle(b).abs_diff(ns) <= ns / 64 + 1, "{ns}");
            last = b;
        }
    }

    #[test]
    fn quantiles() {
        let mut d = Durations::default();
        assert_eq!((d.count(), d.quantile(0.5), d.max()), (0, Duration::ZERO, Duration::ZERO));
        for ms in 1..=1000 {
            d.add(Duration::from_millis(ms));
        }
        for (quantile, ms) in [(0.0, 1.0), (0.5, 500.0), (0.99, 990.0), (1.0, 1000.0)] {
            let got = d.quantile(quantile).as_secs_f64() * 1e3;
            assert!((got / ms - 1.0).abs() < 1.0 / 64.0, "{quantile}: {got} ms");
        }
        assert_eq!(d.max(), Duration::from_secs(1));
    }
}
