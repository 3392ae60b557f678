//! Which frames of a camera never came, from gaps in its own numbers.
//!
//! Input: the number of each frame that came, whole or not. Output: how many are missing before it.

/// GigE Vision cameras with short numbers count 1 to 65535 and begin again at 1.
const LAST_SHORT: u64 = 65_535;
/// A larger jump is a camera that has begun to count anew.
const LARGEST_GAP: u64 = 10_000;

/// Follows the numbers of one camera.
#[derive(Debug, Default)]
pub(crate) struct Gaps {
    last: Option<u64>,
}

impl Gaps {
    /// Frames that are missing between the last one and `number`.
    pub(crate) fn before(&mut self, number: u64) -> u64 {
        let Some(last) = self.last.replace(number) else { return 0 };
        let ahead = number.checked_sub(last);
        // Round the end of short numbers, which leave 0 out.
        let ahead = ahead.or_else(|| (last <= LAST_SHORT).then(|| LAST_SHORT - last + number));
        ahead.filter(|ahead| (1..=LARGEST_GAP).contains(ahead)).map_or(0, |ahead| ahead - 1)
    }

    /// The camera was set up anew: its numbers mean nothing any more.
    pub(crate) fn begin_anew(&mut self) {
        self.last = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn missing(numbers: &[u64]) -> Vec<u64> {
        let mut gaps = Gaps::default();
        numbers.iter().map(|number| gaps.before(*number)).collect()
    }

    #[test]
    fn gaps_are_counted_round_the_end_of_the_numbers() {
        assert_eq!(missing(&[7, 8, 11, 12]), [0, 0, 2, 0]);
        assert_eq!(missing(&[65_534, 65_535, 1, 2]), [0, 0, 0, 0]);
        assert_eq!(missing(&[65_533, 2]), [0, 3], "65534, 65535 and 1");
        assert_eq!(missing(&[65_535, 65_536, 65_538]), [0, 0, 1], "long numbers go on");
    }

    #[test]
    fn a_count_begun_anew_is_no_loss() {
        assert_eq!(missing(&[40_000, 1, 2]), [0, 0, 0]);
        assert_eq!(missing(&[5, 5]), [0, 0]);
        assert_eq!(missing(&[1 << 40, 3]), [0, 0]);
        let mut gaps = Gaps::default();
        gaps.before(1);
        gaps.begin_anew();
        assert_eq!(gaps.before(9), 0);
    }
}
