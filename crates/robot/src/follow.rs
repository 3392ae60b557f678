//! Seeing a command through to its end.
//!
//! Input: a controller that has accepted a command. Output: the final [`Outcome`]. The rules are those of the safety
//! conventions: poll at least every 100 ms; five misses in a row, or no end by the deadline, put the robot on hold, over a new
//! connection if the old one is broken.

use std::time::Duration;

use crate::{AbortReason, Clock, CommandId, Controller, HoldError, Outcome, Progress};

/// How a command is followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FollowOptions {
    /// Time between polls; 50 to 100 ms suits real controllers.
    pub interval: Duration,
    /// Time after which a command that is not done is held and given up.
    pub deadline: Duration,
    /// Failed polls in a row after which the robot is held and the outcome unknown.
    pub misses: u32,
}

impl FollowOptions {
    /// Options for a motion over `distance_mm` at `speed_mm_s`: the deadline is 1.5 times its time plus 2 s.
    ///
    /// Without a speed that means anything (zero, negative, NaN) the deadline is the 2 s alone.
    pub fn for_motion(distance_mm: f64, speed_mm_s: f64) -> Self {
        let travel = Duration::try_from_secs_f64(distance_mm / speed_mm_s * 1.5).unwrap_or(Duration::ZERO);
        Self { deadline: travel.saturating_add(Duration::from_secs(2)), ..Self::default() }
    }
}

impl Default for FollowOptions {
    /// Every 50 ms, for at most 30 s, giving up after five misses.
    fn default() -> Self {
        Self { interval: Duration::from_millis(50), deadline: Duration::from_secs(30), misses: 5 }
    }
}

/// Polls until the outcome of command `id` is final, and calls `each` with every answer.
///
/// Blocks for as long as the command runs. When the deadline passes, the robot is put on hold and the outcome is
/// `Aborted(timeout)`, or `Unknown` if the hold did not get through. After too many failed polls in a row the robot is
/// put on hold if that is possible, and the outcome is `Unknown`: it may still be moving. Both latch a fault.
pub fn follow<C, K>(
    controller: &mut C,
    clock: &K,
    id: CommandId,
    options: &FollowOptions,
    mut each: impl FnMut(&Progress),
) -> Outcome
where
    C: Controller + ?Sized,
    K: Clock + ?Sized,
{
    let start = clock.now();
    let mut misses = 0;
    loop {
        match controller.poll(id) {
            Ok(progress) => {
                misses = 0;
                each(&progress);
                if progress.outcome.is_final() {
                    return progress.outcome;
                }
            }
            Err(error) => {
                misses += 1;
                if misses >= options.misses {
                    let reason = format!("{misses} polls in a row failed ({error}); {}", stand(controller).0);
                    controller.latch(&reason);
                    return Outcome::Unknown { reason };
                }
            }
        }
        let waited = clock.now().saturating_sub(start);
        if waited >= options.deadline {
            let (waited_ms, allowed_ms) = (waited.as_millis() as u64, options.deadline.as_millis() as u64);
            let timeout = AbortReason::Timeout { waited_ms, allowed_ms };
            let (standing, held) = stand(controller);
            let reason = format!("command {id} {timeout}; {standing}");
            controller.latch(&reason);
            return if held { Outcome::Aborted { reason: timeout } } else { Outcome::Unknown { reason } };
        }
        clock.sleep(options.interval);
    }
}

/// Puts the robot on hold; says in words whether that got through.
fn stand<C: Controller + ?Sized>(controller: &mut C) -> (String, bool) {
    match hold_anyway(controller) {
        Ok(()) => ("the robot was put on hold".to_string(), true),
        Err(cause) => (format!("the robot may still be moving, hold failed: {cause}"), false),
    }
}

/// Puts the robot on hold; over a broken connection by making it anew, once. To be told twice to stand does no harm.
pub(crate) fn hold_anyway<C: Controller + ?Sized>(controller: &mut C) -> Result<(), String> {
    match controller.hold(true) {
        Ok(()) => return Ok(()),
        Err(refused @ HoldError::Refused { .. }) => return Err(refused.to_string()),
        Err(HoldError::NotConnected | HoldError::NoAnswer { .. }) => {}
    }
    controller.connect().map_err(|error| error.to_string())?;
    controller.hold(true).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deadline_is_one_and_a_half_times_the_travel_plus_two_seconds() {
        assert_eq!(FollowOptions::for_motion(300.0, 100.0).deadline, Duration::from_millis(6500));
        for speed in [0.0, -5.0, f64::NAN] {
            assert_eq!(FollowOptions::for_motion(300.0, speed).deadline, Duration::from_secs(2), "{speed}");
        }
    }
}
