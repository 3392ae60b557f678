//! Faults by chance, the same from the same seed.

// Not every harness asks for everything.
#![allow(dead_code, unreachable_pub, clippy::panic)]

use std::sync::atomic::{AtomicU64, Ordering};

use samsod_robot::emulator::{FaultKind, FaultPhase, FaultRule, FaultScript};

/// Time that the network has, ms.
pub const TIMEOUT_MS: u64 = 80;
/// Longer than that, ms.
pub const PAST_THE_TIMEOUT_MS: u64 = 120;

/// Numbers that look random, the same from the same seed (SplitMix64).
pub struct Dice(pub u64);

impl Dice {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub fn below(&mut self, end: u64) -> u64 {
        self.next() % end
    }

    pub fn one_of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len() as u64) as usize]
    }
}

/// One to three faults at random commands and phases.
pub fn random_script(dice: &mut Dice) -> FaultScript {
    let commands = [
        None,
        Some("acting"),
        Some("acting"),
        Some("MOVL"),
        Some("MOVJ"),
        Some("START"),
        Some("IOWRITE"),
        Some("LOADV"),
        Some("RSTATS"),
        Some("RPOSC"),
        Some("RJSEQ"),
        Some("HOLD"),
    ];
    let phases = [FaultPhase::Header, FaultPhase::Data, FaultPhase::Answer, FaultPhase::MidMotion];
    let kinds = [
        FaultKind::Close,
        FaultKind::Reset,
        FaultKind::Delay { ms: PAST_THE_TIMEOUT_MS },
        FaultKind::NeverAnswer,
        FaultKind::OneByteSegments,
        FaultKind::Coalesce,
        FaultKind::Twice,
        FaultKind::LoneCr,
        FaultKind::Truncate,
        FaultKind::NonAscii,
        FaultKind::TooLong,
        FaultKind::EmergencyStop,
        FaultKind::ServoOff,
        FaultKind::Alarm { code: 4107 },
        FaultKind::Error { code: 2060 },
        FaultKind::ExternalHold,
        FaultKind::Teach,
        FaultKind::Stall,
        FaultKind::StopShort,
        FaultKind::SecondClient,
    ];
    let faults = (0..1 + dice.below(3)).map(|_| {
        let command = dice.one_of(&commands);
        let nth = 1 + dice.below(if matches!(command, None | Some("RSTATS" | "RPOSC")) { 60 } else { 6 });
        let (phase, share) = (dice.one_of(&phases), dice.below(100) as f64 / 100.0);
        FaultRule { command: command.map(str::to_string), nth, phase, share, what: dice.one_of(&kinds) }
    });
    FaultScript { faults: faults.collect() }
}

/// A number in an environment variable.
pub fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{variable}={text} is no number")))
}

/// Makes `default` runs, or as many as `SAMSOD_FAULT_RUNS` says, or the one of `SAMSOD_FAULT_SEED`; gives the number of runs, and
/// what came of them in no order.
pub fn runs<T: Send>(default: u64, run: impl Fn(u64) -> T + Sync) -> (u64, Vec<T>) {
    let seeds = match number("SAMSOD_FAULT_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("SAMSOD_FAULT_RUNS").unwrap_or(default),
    };
    let next = AtomicU64::new(seeds.start);
    let work = || {
        let mut results = Vec::new();
        loop {
            let seed = next.fetch_add(1, Ordering::SeqCst);
            if seed >= seeds.end {
                return results;
            }
            results.push(run(seed));
        }
    };
    // More than there are processors: a run mostly waits for deadlines.
    let results = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..8).map(|_| scope.spawn(work)).collect();
        threads.into_iter().flat_map(|thread| thread.join().unwrap_or_else(|_| panic!("a run panicked"))).collect()
    });
    (seeds.end - seeds.start, results)
}
