//! The figures that samsod must reach, beside their bars, in one run: against OpenCV, stage times of a steady stream,
//! scaling, memory, recognition, fast against exact saliency. Ends with a table in Markdown.

mod machine;

use std::collections::{BTreeMap, BTreeSet};
use std::error::Error;
use std::time::{Duration, Instant};

use opencv::core::{Mat, Vec3b};
use opencv::{core, imgproc};
use samsod::recognize::{self, RecognizeParams, Recognizer};
use samsod::saliency::{Method, Saliency, SaliencyMap, SaliencyParams, Scales, Threshold, salient_regions};
use samsod::segment::{Partition, SegmentParams, Segmenter};
use samsod::{Cell, CellParams, Scene};
use samsod_benches::{ALL, FULLEST, Frame, OF_TEMPLATE_CAMERA, TWELVE_PARTS, WIDTHS_PX, bundled_parts};

type Outcome<T = ()> = Result<T, Box<dyn Error>>;

fn main() -> Outcome {
    let description = machine::description();
    println!("{description}");
    let frames = Frame::load_all(&ALL)?;
    let mut table = Table::default();
    // Memory first, before OpenCV and large frames leave theirs with the process.
    steady_stream(&frames, &mut table)?;
    against_opencv(&frames, &mut table)?;
    // After OpenCV was measured with its own number of threads: the recognition sets it to one for the process.
    recognition(&mut table)?;
    scaling(&frames, &mut table)?;
    fast_against_exact(&frames, &mut table)?;
    table.print(&description);
    Ok(())
}

/// Stage times and resident memory of frames that come one after the other into the same scene.
fn steady_stream(frames: &[Frame], table: &mut Table) -> Outcome {
    const LENGTH: usize = 200;
    const FLAT_KIB: i64 = 1024;
    println!("\nsteady stream: {LENGTH} frames, the bundled ones in rotation");
    let at_start = machine::resident_kib();
    let mut cell = Cell::new(CellParams::default())?;
    let mut scene = Scene::default();
    for frame in frames {
        cell.inspect_into(&frame.view(), &mut scene)?;
    }
    let before = machine::resident_kib();
    let mut times = Vec::with_capacity(LENGTH);
    for frame in frames.iter().cycle().take(LENGTH) {
        cell.inspect_into(&frame.view(), &mut scene)?;
        times.push(scene.times);
    }
    let after = machine::resident_kib();

    for (i, frame) in frames.iter().enumerate() {
        let of_frame: Vec<_> = times.iter().skip(i).step_by(frames.len()).map(|t| ms(t.total())).collect();
        println!("  {}: whole chain {:.1} ms", frame.name, median(&of_frame));
    }
    let size = size_of(&frames[0]);
    for (stage, (name, _)) in scene.times.stages().into_iter().enumerate() {
        let of_stage: Vec<_> = times.iter().map(|t| ms(t.stages()[stage].1)).collect();
        if name != "shadow" {
            table.figure(format!("{name}, {size}"), median_and_p90(&of_stage));
        }
    }
    let totals: Vec<_> = times.iter().map(|t| ms(t.total())).collect();
    table.figure(format!("whole chain, {size}"), median_and_p90(&totals));
    let shadow: Vec<_> = times.iter().map(|t| ms(t.shadow)).collect();
    table.bar(format!("shadow, {size}"), median_and_p90(&shadow), "median at most 4 ms", median(&shadow) <= 4.0);
    let to_regions: Vec<_> = times.iter().map(|t| ms(t.segment + t.saliency + t.regions)).collect();
    table.bar(
        format!("segment + saliency + regions, {size}"),
        median_and_p90(&to_regions),
        "median at most 45 ms",
        median(&to_regions) <= 45.0,
    );
    if let (Some(at_start), Some(before), Some(after)) = (at_start, before, after) {
        let mib = |kib: i64| kib as f64 / 1024.0;
        table.bar(
            format!("resident memory, growth over {LENGTH} frames"),
            format!(
                "{:+.1} MiB ({:.1} after loading, {:.1} after the first {}, {:.1} at the end)",
                mib(after - before),
                mib(at_start),
                mib(before),
                frames.len(),
                mib(after)
            ),
            "flat: at most 1 MiB",
            after - before <= FLAT_KIB,
        );
    }
    Ok(())
}

/// The chain with a catalogue of 12 parts, and its two matchers beside themselves run over the whole frame.
fn recognition(table: &mut Table) -> Outcome {
    const ROUNDS: usize = 15;
    const CONVENTIONAL_ROUNDS: usize = 3;
    const METHODS: [(&str, recognize::Method); 3] =
        [("best", recognize::Method::Best), ("shape", recognize::Method::Shape), ("sift", recognize::Method::Sift)];
    println!("\nrecognition among {} parts", TWELVE_PARTS.len());
    let catalogue = bundled_parts(&TWELVE_PARTS)?;
    let frames = Frame::load_all(&OF_TEMPLATE_CAMERA)?;
    let full = frames.iter().position(|frame| frame.name == FULLEST).ok_or("the fullest frame is not among them")?;
    let pixels = f64::from(frames[full].image.width() * frames[full].image.height());
    let size = size_of(&frames[full]);
    let mut totals = BTreeMap::new();
    for (method, kind) in METHODS {
        let recognize = RecognizeParams { method: kind, ..RecognizeParams::default() };
        let mut cell = Cell::with_catalogue(CellParams { recognize, ..CellParams::default() }, catalogue.clone())?;
        let mut scene = Scene::default();
        for (i, frame) in frames.iter().enumerate() {
            let (mut whole, mut stage) = (Vec::new(), Vec::new());
            for round in 0..=ROUNDS {
                cell.inspect_into(&frame.view(), &mut scene)?;
                // The first round touches memory that later rounds have already.
                if round > 0 {
                    whole.push(ms(scene.times.total()));
                    stage.push(ms(scene.times.recognize));
                }
            }
            let named = scene.detections.iter().filter(|d| d.name.is_some()).count();
            let objects = scene.objects.len();
            println!(
                "  {} {method}: {objects} objects, {named} named; recognition {:.1} ms, whole chain {:.1} ms",
                frame.name,
                median(&stage),
                median(&whole)
            );
            if i == full {
                let of = format!("{FULLEST}, {objects} objects, {size}");
                table.figure(format!("recognize by {method}, {of}"), median_and_p90(&stage));
                let what = format!("whole chain with recognition by {method}, {of}");
                if kind == recognize::Method::Best {
                    let reached = median(&whole) <= 100.0;
                    table.bar(what, median_and_p90(&whole), "median at most 100 ms", reached);
                } else {
                    table.figure(what, median_and_p90(&whole));
                }
                totals.insert(method, median(&whole));
            }
        }
    }
    let recognizer = Recognizer::new(catalogue, RecognizeParams::default())?;
    let view = frames[full].view();
    let (mut sift, mut shape) = (Vec::new(), Vec::new());
    for _ in 0..CONVENTIONAL_ROUNDS {
        let start = Instant::now();
        recognizer.conventional_sift(&view, None)?;
        sift.push(ms(start.elapsed()));
        let start = Instant::now();
        recognizer.conventional_shape(&view, None)?;
        shape.push(ms(start.elapsed()));
    }
    // Time a pixel and ratios to the conventional methods, ours over theirs, as in table 9 of the paper.
    for (method, conventional, paper_ms, paper_ratio) in
        [("sift", &sift, 0.176, 0.36), ("shape", &shape, 0.266, 0.0038)]
    {
        let (ours, theirs) = (totals.get(method).copied().unwrap_or(f64::NAN), median(conventional));
        println!("  {FULLEST} conventional {method}: {theirs:.0} ms, {:.4} : 1", ours / theirs);
        table.figure(
            format!("whole chain with recognition by {method}, a pixel (the paper: {paper_ms} ms)"),
            format!("{:.6} ms", ours / pixels),
        );
        table.figure(format!("conventional {method} over the whole frame {FULLEST}"), median_and_p90(conventional));
        table.figure(
            format!("whole chain with recognition by {method} : conventional {method} (the paper: {paper_ratio} : 1)"),
            format!("{:.4} : 1", ours / theirs),
        );
    }
    Ok(())
}

/// Our segmentation and OpenCV's filter in turns on the same pixels.
fn against_opencv(frames: &[Frame], table: &mut Table) -> Outcome {
    const ROUNDS: usize = 3;
    const LEVELS: [i32; 2] = [0, 1];
    const LEAST_RATIO: f64 = 40.0;
    println!("\nOpenCV {}, {} threads", core::get_version_string()?, core::get_num_threads()?);
    let mut segmenter = Segmenter::new(SegmentParams::default())?;
    let mut partition = Partition::default();
    segmenter.segment_into(&frames[0].view(), &mut partition)?;
    let mut ours = Vec::new();
    let mut theirs = LEVELS.map(|_| Vec::new());
    for frame in frames {
        let view = frame.view();
        let (width, height) = view.dimensions();
        let mat = Mat::new_rows_cols_with_bytes::<Vec3b>(height as i32, width as i32, frame.image.as_raw())?;
        let mut filtered = Mat::default();
        let mut ours_here = Measured::default();
        let mut theirs_here = LEVELS.map(|_| Measured::default());
        for _ in 0..ROUNDS {
            for (level, theirs) in LEVELS.into_iter().zip(&mut theirs_here) {
                ours_here.measure(|| segmenter.segment_into(&view, &mut partition))?;
                theirs.measure(|| filter(&mat, level, &mut filtered))?;
                ours_here.measure(|| segmenter.segment_into(&view, &mut partition))?;
            }
        }
        println!(
            "  {}: segment {:.1} ms, {} partitions; OpenCV {:.0} ms at max_level 0, {:.0} ms at 1",
            frame.name,
            median(&ours_here.ms),
            partition.len(),
            median(&theirs_here[0].ms),
            median(&theirs_here[1].ms),
        );
        ours.push(ours_here);
        theirs.iter_mut().zip(theirs_here).for_each(|(all, here)| all.push(here));
    }
    let size = size_of(&frames[0]);
    let all = |measured: &[Measured]| measured.iter().flat_map(|m| m.ms.iter().copied()).collect::<Vec<_>>();
    let medians = |measured: &[Measured]| measured.iter().map(|m| median(&m.ms)).collect::<Vec<_>>();
    table.figure(format!("segment, {size}, in turns with OpenCV"), median_and_p90(&all(&ours)));
    for (level, theirs) in LEVELS.into_iter().zip(&theirs) {
        let call = format!("pyrMeanShiftFiltering(8, 16, {level})");
        table.figure(format!("OpenCV {call}, {size}"), median_and_p90(&all(theirs)));
        let ratio = median(&all(theirs)) / median(&all(&ours));
        table.bar(
            format!("times faster than OpenCV, max_level {level}: medians"),
            format!("{ratio:.1}"),
            "at least 40",
            ratio >= LEAST_RATIO,
        );
        let (theirs_ms, ours_ms) = (medians(theirs), medians(&ours));
        let ratios: Vec<_> = theirs_ms.iter().zip(&ours_ms).map(|(t, o)| t / o).collect();
        table.figure(
            format!("times faster than OpenCV, max_level {level}: all frames together"),
            format!(
                "{:.1} (single frames {:.1} to {:.1})",
                theirs_ms.iter().sum::<f64>() / ours_ms.iter().sum::<f64>(),
                quantile(&ratios, 0.0),
                quantile(&ratios, 1.0)
            ),
        );
        let processor_ms = |measured: &[Measured]| {
            let of_frames: Option<Vec<_>> = measured.iter().map(Measured::mean_processor_ms).collect();
            of_frames.map(|m| m.iter().sum::<f64>() / m.len() as f64)
        };
        if let (Some(theirs), Some(ours)) = (processor_ms(theirs), processor_ms(&ours)) {
            table.figure(
                format!("times less processor time than OpenCV, max_level {level}"),
                format!("{:.1} ({theirs:.0} ms over {ours:.1} ms)", theirs / ours),
            );
        }
    }
    Ok(())
}

/// OpenCV's filter with the termination that is its default.
fn filter(image: &impl core::ToInputArray, max_level: i32, filtered: &mut Mat) -> opencv::Result<()> {
    const SPATIAL_RADIUS: f64 = 8.0;
    const COLOUR_RADIUS: f64 = 16.0;
    let kind = core::TermCriteria_Type::COUNT as i32 + core::TermCriteria_Type::EPS as i32;
    let termination = core::TermCriteria::new(kind, 5, 1.0)?;
    imgproc::pyr_mean_shift_filtering(image, filtered, SPATIAL_RADIUS, COLOUR_RADIUS, max_level, termination)
}

/// The whole chain at 1, 4 and 16 times the pixels: the same scene from a finer camera, and a larger scene.
fn scaling(frames: &[Frame], table: &mut Table) -> Outcome {
    println!("\nscaling");
    let enlarge = |frame: &Frame, times| frame.at_width(frame.image.width() * times);
    scaling_of("enlarged", frames, &CellParams::default(), enlarge, table)?;
    // Tiles hold objects of the same size in pixels, so the lengths are those of one tile.
    let (width, height) = frames[0].image.dimensions();
    let longer = width.max(height) as f32;
    let bandwidth = longer / 90.0;
    let params = CellParams {
        segment: SegmentParams {
            spatial_bandwidth_px: Some(bandwidth),
            min_area_px: Some((bandwidth * bandwidth * 0.75) as u32),
            ..SegmentParams::default()
        },
        saliency: SaliencyParams {
            scales: Scales::Pixels {
                center_px: [3.0, 5.0, 7.0].map(|s| s * longer / 256.0).to_vec(),
                surround_px: [19.0, 23.0, 29.0].map(|s| s * longer / 256.0).to_vec(),
            },
            ..SaliencyParams::default()
        },
        ..CellParams::default()
    };
    scaling_of("tiled", frames, &params, Frame::tiled, table)
}

/// The chain at every size in turns.
fn scaling_of(
    kind: &str,
    frames: &[Frame],
    params: &CellParams,
    larger: impl Fn(&Frame, u32) -> Frame,
    table: &mut Table,
) -> Outcome {
    const ROUNDS: usize = 2;
    const TIMES_THE_SIDE: [u32; 3] = [1, 2, 4];
    let mut cells = Vec::new();
    for _ in TIMES_THE_SIDE {
        cells.push((Cell::new(params.clone())?, Scene::default(), Vec::new(), String::new()));
    }
    for frame in frames {
        let images = TIMES_THE_SIDE.map(|times| larger(frame, times));
        for round in 0..=ROUNDS {
            for (image, (cell, scene, times, size)) in images.iter().zip(&mut cells) {
                cell.inspect_into(&image.view(), scene)?;
                // The first round touches memory that later rounds have already.
                if round > 0 {
                    times.push(ms(scene.times.total()));
                }
                *size = size_of(image);
            }
        }
        let now = cells.iter().map(|(_, scene, times, size)| {
            format!("{size} {:.1} ms, {} partitions", median(&times[times.len() - ROUNDS..]), scene.partition.len())
        });
        println!("  {} {kind}: {}", frame.name, now.collect::<Vec<_>>().join("; "));
    }
    let medians: Vec<_> = cells.iter().map(|(_, _, times, _)| median(times)).collect();
    for (i, side) in TIMES_THE_SIDE.into_iter().enumerate().skip(1) {
        let ratio = medians[i] / medians[0];
        let what = format!("chain at {}, {kind}: time for {} times the pixels", cells[i].3, side * side);
        let measured = format!("{ratio:.1} times ({:.0} ms over {:.1} ms)", medians[i], medians[0]);
        if side == 4 {
            table.bar(what, measured, "at most 22", ratio <= 22.0);
        } else {
            table.figure(what, measured);
        }
    }
    Ok(())
}

/// Both methods on the same partitions, at the smallest width.
fn fast_against_exact(frames: &[Frame], table: &mut Table) -> Outcome {
    let width = WIDTHS_PX[0];
    println!("\nfast against exact, {width} px wide");
    let mut segmenter = Segmenter::new(SegmentParams::default())?;
    let with = |method| Saliency::new(SaliencyParams { method, ..SaliencyParams::default() });
    let (mut fast, mut exact) = (with(Method::Fast)?, with(Method::Exact)?);
    let (mut differences, mut same) = (Vec::new(), 0);
    for frame in frames {
        let partition = segmenter.segment(&frame.at_width(width).view())?;
        let (quick, reference) = (fast.compute(&partition)?, exact.compute(&partition)?);
        let pairs = quick.values().iter().zip(reference.values());
        let difference = pairs.map(|(q, r)| f64::from((q - r).abs())).sum::<f64>() / partition.labels().len() as f64;
        let equal = salient_partitions(&quick, &partition)? == salient_partitions(&reference, &partition)?;
        println!(
            "  {}: mean |difference| {difference:.5}, same salient partitions: {}",
            frame.name,
            if equal { "yes" } else { "no" }
        );
        differences.push(difference);
        same += usize::from(equal);
    }
    let worst = differences.iter().copied().fold(0.0, f64::max);
    table.bar(
        format!("fast against exact, {width} px wide: mean absolute difference of S"),
        format!("{:.5} (worst frame {worst:.5})", differences.iter().sum::<f64>() / differences.len() as f64),
        "at most 0.005",
        worst <= 0.005,
    );
    table.bar(
        format!("fast against exact, {width} px wide: same set of salient partitions"),
        format!("{same} of {} frames", frames.len()),
        "at least 95 %",
        same as f64 >= 0.95 * frames.len() as f64,
    );
    Ok(())
}

/// The labels of all partitions in salient regions.
fn salient_partitions(map: &SaliencyMap, partition: &Partition) -> Outcome<BTreeSet<u32>> {
    let regions = salient_regions(map, partition, Threshold::default())?;
    Ok(regions.into_iter().flat_map(|region| region.partitions).collect())
}

/// Wall-clock times, and processor time where the system tells it.
#[derive(Default)]
struct Measured {
    ms: Vec<f64>,
    processor: Duration,
    processor_unknown: bool,
}

impl Measured {
    /// Times one call.
    fn measure<T, E>(&mut self, call: impl FnOnce() -> Result<T, E>) -> Result<T, E> {
        let before = machine::processor_time();
        let start = Instant::now();
        let result = call();
        self.ms.push(ms(start.elapsed()));
        match (before, machine::processor_time()) {
            (Some(before), Some(after)) => self.processor += after.saturating_sub(before),
            _ => self.processor_unknown = true,
        }
        result
    }

    /// Processor time of a call; the error of single readings averages out.
    fn mean_processor_ms(&self) -> Option<f64> {
        (!self.processor_unknown).then(|| ms(self.processor) / self.ms.len() as f64)
    }
}

fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

fn size_of(frame: &Frame) -> String {
    format!("{} x {}", frame.image.width(), frame.image.height())
}

/// The smallest value that a share of the values does not exceed; NaN without values.
fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied().unwrap_or(f64::NAN)
}

/// The value in the middle, or the mean of the two there; NaN without values.
fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    match sorted.get(sorted.len().saturating_sub(1) / 2..=sorted.len() / 2) {
        Some(middle) => middle.iter().sum::<f64>() / middle.len() as f64,
        None => f64::NAN,
    }
}

fn median_and_p90(ms: &[f64]) -> String {
    format!("{:.1} ms (p90 {:.1})", median(ms), quantile(ms, 0.9))
}

/// Figures beside their bars.
#[derive(Default)]
struct Table {
    rows: Vec<String>,
}

impl Table {
    /// A figure that has to reach something.
    fn bar(&mut self, what: String, measured: String, bar: &str, reached: bool) {
        self.rows.push(format!("| {what} | {measured} | {bar} | {} |", if reached { "yes" } else { "**no**" }));
    }

    /// A figure for information.
    fn figure(&mut self, what: String, measured: String) {
        self.rows.push(format!("| {what} | {measured} | | |"));
    }

    fn print(&self, description: &str) {
        println!("\n{description}:\n\n| figure | measured | bar | reached |\n|---|---|---|---|");
        self.rows.iter().for_each(|row| println!("{row}"));
    }
}
