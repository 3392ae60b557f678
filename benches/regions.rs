//! Salient regions of a saliency map at several widths.

mod settings;

use std::error::Error;

use criterion::{BenchmarkId, Throughput};
use samsod::saliency::{Saliency, SaliencyParams, Threshold, salient_regions_into};
use samsod::segment::{SegmentParams, Segmenter};
use samsod_benches::{Frame, PLAIN_AND_TEXTURED, WIDTHS_PX};

fn main() -> Result<(), Box<dyn Error>> {
    let mut criterion = settings::criterion();
    let mut group = settings::group(&mut criterion, "regions");
    for frame in Frame::load_all(&PLAIN_AND_TEXTURED)? {
        for width in WIDTHS_PX {
            let partition = Segmenter::new(SegmentParams::default())?.segment(&frame.at_width(width).view())?;
            let map = Saliency::new(SaliencyParams::default())?.compute(&partition)?;
            let mut regions = Vec::new();
            salient_regions_into(&map, &partition, Threshold::default(), &mut regions)?;
            group.throughput(Throughput::Elements(partition.labels().len() as u64));
            group.bench_function(BenchmarkId::new(frame.name, width), |bencher| {
                bencher.iter(|| salient_regions_into(&map, &partition, Threshold::default(), &mut regions));
            });
        }
    }
    group.finish();
    criterion.final_summary();
    Ok(())
}
