//! Noise of a camera sensor: shot noise of the light and read noise of the electronics, anew for each frame.

use super::light::{linear_from_srgb, srgb_from_linear};
use super::random::Random;

/// Electrons of a full pixel, and read noise: of the sensor by which the bundled frames were made.
const FULL_WELL: f64 = 8500.0;
const READ_NOISE: f64 = 11.0;
/// Levels of a picture: 8 bits and 8 bits behind the point.
const FINE: f64 = 256.0;
/// Fine levels that share one deviation.
const LEVELS_A_STEP: usize = 16;
/// Deviates that are drawn from, and their unit.
const DEVIATES: usize = 1 << 13;
const UNIT: f64 = 1024.0;

/// Deviations by level, and deviates.
#[derive(Debug)]
pub(super) struct SensorNoise {
    /// In fine levels.
    deviations: Vec<i32>,
    /// Of deviation `UNIT`.
    deviates: Vec<i32>,
    seed: u64,
}

impl SensorNoise {
    /// `amount` is that of the sensor at 1; 0 is none.
    pub(super) fn new(amount: f64, seed: u64) -> Self {
        let deviation = |step: usize| {
            let level = (step * LEVELS_A_STEP) as f64 / (255.0 * FINE);
            let light = linear_from_srgb(level.min(1.0));
            let sigma = (light * FULL_WELL + READ_NOISE * READ_NOISE).sqrt() / FULL_WELL;
            // The slope of the curve over a step as wide as the noise itself.
            let slope = (srgb_from_linear(light + sigma) - srgb_from_linear((light - sigma).max(0.0)))
                / (sigma + sigma.min(light));
            (amount * sigma * slope * 255.0 * FINE).round() as i32
        };
        let mut random = Random::new(seed);
        Self {
            deviations: (0..=(u16::MAX as usize) / LEVELS_A_STEP).map(deviation).collect(),
            deviates: (0..DEVIATES).map(|_| (random.normal() * UNIT).round() as i32).collect(),
            seed,
        }
    }

    /// The frame `number` of a picture: 8-bit levels of fine ones.
    pub(super) fn expose(&self, levels: &[u16], number: u64, out: &mut [u8]) {
        // Streams of neighbouring frames have nothing in common.
        let mut random = Random::new(self.seed ^ Random::new(number).bits());
        for (levels, out) in levels.chunks(4).zip(out.chunks_mut(4)) {
            let mut bits = random.bits();
            for (&level, out) in levels.iter().zip(out) {
                let deviate = self.deviates[bits as usize % DEVIATES];
                bits >>= 16;
                let noise = deviate * self.deviations[level as usize / LEVELS_A_STEP] / UNIT as i32;
                *out = ((i32::from(level) + noise + FINE as i32 / 2) >> 8).clamp(0, 255) as u8;
            }
        }
    }
}

/// The fine level of linear light.
pub(super) fn level_of(light: f64) -> u16 {
    (srgb_from_linear(light.clamp(0.0, 1.0)) * 255.0 * FINE).round() as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exposed(noise: &SensorNoise, light: f64, number: u64) -> Vec<f64> {
        let mut out = vec![0; 60_000];
        noise.expose(&vec![level_of(light); 60_000], number, &mut out);
        out.into_iter().map(f64::from).collect()
    }

    #[test]
    fn noise_is_that_of_the_sensor_and_keeps_the_mean() {
        let noise = SensorNoise::new(1.0, 7);
        for light in [0.05, 0.2, 0.6] {
            let values = exposed(&noise, light, 3);
            let n = values.len() as f64;
            let mean = values.iter().sum::<f64>() / n;
            let sigma = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
            let level = srgb_from_linear(light) * 255.0;
            assert!((mean - level).abs() < 0.1, "{light}: {mean} for {level}");
            // By hand: the deviation of the light times the slope of the curve; rounding adds a twelfth.
            let slope = 255.0 * 1.055 / 2.4 * light.powf(1.0 / 2.4 - 1.0);
            let by_hand = slope * (light * 8500.0 + 121.0).sqrt() / 8500.0;
            let by_hand = (by_hand * by_hand + 1.0 / 12.0).sqrt();
            assert!((sigma / by_hand - 1.0).abs() < 0.05, "{light}: {sigma} for {by_hand}");
        }
    }

    #[test]
    fn frames_differ_and_a_seed_repeats_them() {
        let noise = SensorNoise::new(1.0, 7);
        assert_ne!(exposed(&noise, 0.2, 0), exposed(&noise, 0.2, 1));
        assert_eq!(exposed(&noise, 0.2, 1), exposed(&SensorNoise::new(1.0, 7), 0.2, 1));
        assert_ne!(exposed(&noise, 0.2, 1), exposed(&SensorNoise::new(1.0, 8), 0.2, 1));
    }

    #[test]
    fn without_noise_levels_are_rounded_and_white_stays_white() {
        let noise = SensorNoise::new(0.0, 1);
        for level in [0u8, 1, 100, 254, 255] {
            let light = linear_from_srgb(f64::from(level) / 255.0);
            assert!(exposed(&noise, light, 0).iter().all(|v| *v == f64::from(level)));
        }
        assert!(exposed(&SensorNoise::new(1.0, 1), 1.0, 0).iter().all(|v| *v > 240.0));
    }
}
