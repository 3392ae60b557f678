//! Separation of objects from shadows, by both rules, at several widths.

mod settings;

use std::error::Error;

use criterion::{BenchmarkId, Throughput};
use samsod::saliency::{Saliency, SaliencyParams, Threshold, salient_regions};
use samsod::segment::{SegmentParams, Segmenter};
use samsod::shadow::{ObjectSide, ShadowParams, ShadowSeparator};
use samsod_benches::{Frame, PLAIN_AND_TEXTURED, WIDTHS_PX};

fn main() -> Result<(), Box<dyn Error>> {
    let mut criterion = settings::criterion();
    for (name, object_side) in [("shadow evidence", ObjectSide::Evidence), ("shadow paper", ObjectSide::Paper)] {
        let mut group = settings::group(&mut criterion, name);
        for frame in Frame::load_all(&PLAIN_AND_TEXTURED)? {
            for width in WIDTHS_PX {
                let image = frame.at_width(width);
                let partition = Segmenter::new(SegmentParams::default())?.segment(&image.view())?;
                let map = Saliency::new(SaliencyParams::default())?.compute(&partition)?;
                let regions = salient_regions(&map, &partition, Threshold::default())?;
                let mut separator = ShadowSeparator::new(ShadowParams { object_side, ..ShadowParams::default() })?;
                let mut objects = Vec::new();
                group.throughput(Throughput::Elements(partition.labels().len() as u64));
                group.bench_function(BenchmarkId::new(frame.name, width), |bencher| {
                    bencher.iter(|| separator.separate_into(&image.view(), &partition, &map, &regions, &mut objects));
                });
            }
        }
        group.finish();
    }
    criterion.final_summary();
    Ok(())
}
