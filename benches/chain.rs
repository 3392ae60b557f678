//! The whole chain as the daemon runs it: into a scene whose memory is reused.

mod settings;

use std::error::Error;

use criterion::{BenchmarkId, Throughput};
use samsod::{Cell, CellParams, Scene};
use samsod_benches::{Frame, PLAIN_AND_TEXTURED, WIDTHS_PX};

fn main() -> Result<(), Box<dyn Error>> {
    let mut criterion = settings::criterion();
    let mut group = settings::group(&mut criterion, "chain");
    for frame in Frame::load_all(&PLAIN_AND_TEXTURED)? {
        for width in WIDTHS_PX {
            let scaled = frame.at_width(width);
            let view = scaled.view();
            let mut cell = Cell::new(CellParams::default())?;
            let mut scene = Scene::default();
            cell.inspect_into(&view, &mut scene)?;
            group.throughput(Throughput::Elements(scene.partition.labels().len() as u64));
            group.bench_function(BenchmarkId::new(frame.name, width), |bencher| {
                bencher.iter(|| cell.inspect_into(&view, &mut scene));
            });
        }
    }
    group.finish();
    criterion.final_summary();
    Ok(())
}
