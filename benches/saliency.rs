//! Saliency of a partition, fast at several widths and exact at the smaller ones.

mod settings;

use std::error::Error;
use std::time::Duration;

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, BenchmarkId, Throughput};
use samsod::saliency::{Method, Saliency, SaliencyMap, SaliencyParams};
use samsod::segment::{SegmentParams, Segmenter};
use samsod_benches::{Frame, PLAIN_AND_TEXTURED, WIDTHS_PX};

/// Widths for the exact method, px, and how long ten samples of it take, s.
const EXACT: [(u32, u64); 2] = [(256, 4), (512, 25)];

fn main() -> Result<(), Box<dyn Error>> {
    let mut criterion = settings::criterion();
    let frames = Frame::load_all(&PLAIN_AND_TEXTURED)?;

    let mut group = settings::group(&mut criterion, "saliency fast");
    for frame in &frames {
        for width in WIDTHS_PX {
            measure(&mut group, Method::Fast, &frame.at_width(width))?;
        }
    }
    group.finish();

    let mut group = settings::group(&mut criterion, "saliency exact");
    group.sample_size(10);
    for (width, seconds) in EXACT {
        group.measurement_time(Duration::from_secs(seconds));
        for frame in &frames {
            measure(&mut group, Method::Exact, &frame.at_width(width))?;
        }
    }
    group.finish();
    criterion.final_summary();
    Ok(())
}

fn measure(group: &mut BenchmarkGroup<'_, WallTime>, method: Method, frame: &Frame) -> Result<(), Box<dyn Error>> {
    let partition = Segmenter::new(SegmentParams::default())?.segment(&frame.view())?;
    let mut saliency = Saliency::new(SaliencyParams { method, ..SaliencyParams::default() })?;
    let mut map = SaliencyMap::default();
    saliency.compute_into(&partition, &mut map)?;
    group.throughput(Throughput::Elements(partition.labels().len() as u64));
    group.bench_function(BenchmarkId::new(frame.name, frame.image.width()), |bencher| {
        bencher.iter(|| saliency.compute_into(&partition, &mut map));
    });
    Ok(())
}
