//! Recognition of the objects of bundled frames among 12 of the bundled parts, by every method.

mod settings;

use std::error::Error;

use criterion::{BenchmarkId, Throughput};
use samsod::recognize::{Method, RecognizeParams, Recognizer};
use samsod::{Cell, CellParams};
use samsod_benches::{Frame, OF_TEMPLATE_CAMERA, TWELVE_PARTS, bundled_parts};

fn main() -> Result<(), Box<dyn Error>> {
    let mut criterion = settings::criterion();
    let catalogue = bundled_parts(&TWELVE_PARTS)?;
    let mut cell = Cell::new(CellParams::default())?;
    for (name, method) in
        [("recognize best", Method::Best), ("recognize shape", Method::Shape), ("recognize sift", Method::Sift)]
    {
        let recognizer = Recognizer::new(catalogue.clone(), RecognizeParams { method, ..RecognizeParams::default() })?;
        let mut group = settings::group(&mut criterion, name);
        for frame in Frame::load_all(&OF_TEMPLATE_CAMERA)? {
            let objects = cell.inspect(&frame.view())?.objects;
            group.throughput(Throughput::Elements(objects.len() as u64));
            group.bench_function(BenchmarkId::new(frame.name, objects.len()), |bencher| {
                // Without a camera that of the templates is taken, which is that of these frames.
                bencher.iter(|| recognizer.recognize(&frame.view(), &objects, None));
            });
        }
        group.finish();
    }
    criterion.final_summary();
    Ok(())
}
