//! What a robot costs the vision chain: the chain alone, and beside a thread that polls a controller over TCP every 50 ms, as
//! samsodd does while the robot moves. Then what a plan costs.
//!
//! Both chains run on the same frame in one process; their ratio is printed, so that other load on the machine meets both.

mod settings;

use std::error::Error;
use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use samsod::{Cell, CellParams, Scene};
use samsod_benches::{Frame, PLAIN_AND_TEXTURED};
use samsod_robot::emulator::{EmptyTable, Emulator, EmulatorConfig};
use samsod_robot::{ArmModel, Controller, Joints, MonotonicClock, Motoman, MotomanConfig, NoWireLog, Pose};

/// Pairs of frames, alone and polled in turn.
const PAIRS: usize = 60;
/// Time between polls.
const INTERVAL: Duration = Duration::from_millis(50);

fn main() -> Result<(), Box<dyn Error>> {
    polled_chain()?;
    let mut criterion = settings::criterion();
    let mut group = settings::group(&mut criterion, "robot");
    let arm = ArmModel::mh5(100.0);
    let above = Pose::gripper_down(450.0, 120.0, 200.0, 0.5);
    let joints = arm.joints_at(&above, &Joints([0.0; 6]))?;
    group.bench_function("inverse kinematics", |bencher| bencher.iter(|| arm.joints_at(black_box(&above), &joints)));
    let down = Pose { z_mm: 15.0, ..above };
    group.bench_function("plan of a line of 185 mm", |bencher| {
        bencher.iter(|| arm.plan_line(&joints, black_box(&down), 250.0, 1500.0));
    });
    group.finish();
    criterion.final_summary();
    Ok(())
}

fn polled_chain() -> Result<(), Box<dyn Error>> {
    let emulator = Emulator::start(EmulatorConfig::default(), MonotonicClock::new(), Box::new(EmptyTable))?;
    let config = MotomanConfig { address: emulator.address().to_string(), ..MotomanConfig::default() };
    let mut controller = Motoman::new(config, MonotonicClock::new(), Box::new(NoWireLog))?;
    controller.connect()?;
    let (polling, ending) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
    let (polls, failures) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let thread = {
        let (polling, ending) = (Arc::clone(&polling), Arc::clone(&ending));
        let (polls, failures) = (Arc::clone(&polls), Arc::clone(&failures));
        std::thread::spawn(move || {
            while !ending.load(Ordering::Relaxed) {
                if polling.load(Ordering::Relaxed) {
                    let is_read = controller.status().is_ok() && controller.position().is_ok();
                    let count = if is_read { &polls } else { &failures };
                    count.fetch_add(1, Ordering::Relaxed);
                }
                std::thread::sleep(INTERVAL);
            }
        })
    };
    let Some(frame) = Frame::load_all(&PLAIN_AND_TEXTURED)?.into_iter().next() else {
        return Err("no frame is bundled".into());
    };
    let view = frame.view();
    let mut cell = Cell::new(CellParams::default())?;
    let mut scene = Scene::default();
    cell.inspect_into(&view, &mut scene)?;
    let mut times = [Vec::new(), Vec::new()];
    for i in 0..2 * PAIRS {
        // In turn, so that whatever else the machine does meets both.
        polling.store(i % 2 == 1, Ordering::Relaxed);
        let start = Instant::now();
        cell.inspect_into(&view, &mut scene)?;
        times[i % 2].push(start.elapsed().as_secs_f64() * 1e3);
    }
    ending.store(true, Ordering::Relaxed);
    if thread.join().is_err() {
        return Err("the polling thread panicked".into());
    }
    let [alone, polled] = times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    });
    println!(
        "chain of {}: alone {alone:.2} ms, beside status polls {polled:.2} ms (medians of {PAIRS}), ratio {:.3}; {} polls, {} failed",
        frame.name,
        polled / alone,
        polls.load(Ordering::Relaxed),
        failures.load(Ordering::Relaxed)
    );
    Ok(())
}
