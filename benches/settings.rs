//! How long criterion measures.

use std::time::Duration;

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, SamplingMode};

/// Criterion's settings for all benchmarks; options of the command line override them.
///
/// Every benchmark repeats one frame, since a rotation over frames of different difficulty would spread the times of
/// an iteration and criterion compares their distributions from run to run.
pub(crate) fn criterion() -> Criterion {
    Criterion::default()
        .warm_up_time(Duration::from_millis(500))
        .measurement_time(Duration::from_secs(3))
        .sample_size(20)
        .without_plots()
        .configure_from_args()
}

/// A group whose samples have equally many iterations: an iteration takes milliseconds, and a growing number of them
/// would overrun the time.
pub(crate) fn group<'a>(criterion: &'a mut Criterion, name: &str) -> BenchmarkGroup<'a, WallTime> {
    let mut group = criterion.benchmark_group(name);
    group.sampling_mode(SamplingMode::Flat);
    group
}
