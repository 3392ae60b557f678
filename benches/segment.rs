//! Mean shift and partitions at several widths.

mod settings;

use std::error::Error;

use criterion::{BenchmarkId, Throughput};
use samsod::segment::{Partition, SegmentParams, Segmenter};
use samsod_benches::{Frame, PLAIN_AND_TEXTURED, WIDTHS_PX};

fn main() -> Result<(), Box<dyn Error>> {
    let mut criterion = settings::criterion();
    let mut group = settings::group(&mut criterion, "segment");
    for frame in Frame::load_all(&PLAIN_AND_TEXTURED)? {
        for width in WIDTHS_PX {
            let scaled = frame.at_width(width);
            let view = scaled.view();
            let mut segmenter = Segmenter::new(SegmentParams::default())?;
            let mut partition = Partition::default();
            segmenter.segment_into(&view, &mut partition)?;
            group.throughput(Throughput::Elements(partition.labels().len() as u64));
            group.bench_function(BenchmarkId::new(frame.name, width), |bencher| {
                bencher.iter(|| segmenter.segment_into(&view, &mut partition));
            });
        }
    }
    group.finish();
    criterion.final_summary();
    Ok(())
}
