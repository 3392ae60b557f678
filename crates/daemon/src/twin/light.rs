//! Light over the table: sRGB and linear light, lamps and sky.

use std::f64::consts::TAU;

use clap::ValueEnum;

/// Directions by which a lamp, and the sky, are replaced. As many as leave steps below the noise of a camera.
const LAMP_DIRECTIONS: usize = 48;
const SKY_DIRECTIONS: usize = 96;
/// The sky ends above the horizon, where walls stand: sine of the least elevation.
const SKY_LEAST_SINE: f64 = 0.2;
/// Elevation of lamps, degrees: those near the horizon would throw shadows without end.
const LEAST_ELEVATION_DEG: f64 = 10.0;
/// Angle from one point of a spiral to the next that spreads points evenly, in turns.
const GOLDEN_TURN: f64 = 0.381_966_011_250_105_1;

/// Linear light of an sRGB value; both in [0, 1].
pub(super) fn linear_from_srgb(value: f64) -> f64 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// The sRGB value of linear light; both in [0, 1].
pub(super) fn srgb_from_linear(value: f64) -> f64 {
    if value <= 0.003_130_8 { value * 12.92 } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 }
}

/// Arrangements of lamps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum Arrangement {
    /// Light from everywhere, and a little more from one large lamp: thin shadows.
    #[default]
    Soft,
    /// One lamp from the side: dark shadows.
    Side,
    /// Two lamps from two sides.
    Two,
}

/// A lamp, far away.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lamp {
    /// Direction towards it, counter-clockwise from world x, rad.
    azimuth_rad: f64,
    /// Over the table, rad.
    elevation_rad: f64,
    /// Half the angle under which it is seen, rad: the softness of its shadows.
    radius_rad: f64,
    /// Its share of the light on the table.
    share: f64,
}

/// Lamps and sky, whose light on a free table is 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Lighting {
    lamps: Vec<Lamp>,
}

/// Changes to the first lamp of an arrangement, degrees.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LampOptions {
    /// Direction towards the lamp, counter-clockwise from world x.
    pub azimuth_deg: Option<f64>,
    /// Over the table, 10 to 90.
    pub elevation_deg: Option<f64>,
    /// Half the angle under which the lamp is seen, 0 to 30.
    pub softness_deg: Option<f64>,
}

/// A lamp that cannot be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key} is {value}; allowed: {least} to {most}")]
pub struct LampError {
    /// Which number.
    pub key: &'static str,
    /// The value given.
    pub value: f64,
    /// The least that is allowed.
    pub least: f64,
    /// The most that is allowed.
    pub most: f64,
}

impl Lighting {
    /// An arrangement, with another first lamp where options say so; the second lamp keeps its angle to the first.
    ///
    /// # Errors
    /// [`LampError`]: an angle out of range.
    pub fn new(arrangement: Arrangement, options: &LampOptions) -> Result<Self, LampError> {
        let within = |key, value: Option<f64>, [least, most]: [f64; 2]| match value {
            // NaN is in no range.
            Some(value) if !(least..=most).contains(&value) => Err(LampError { key, value, least, most }),
            value => Ok(value),
        };
        let azimuth_deg = within("azimuth_deg", options.azimuth_deg, [-360.0, 360.0])?.unwrap_or(125.0);
        let elevation_deg = within("elevation_deg", options.elevation_deg, [LEAST_ELEVATION_DEG, 90.0])?;
        let softness_deg = within("softness_deg", options.softness_deg, [0.0, 30.0])?;
        // Degrees from the first lamp, elevation, softness; share.
        let lamps: &[[f64; 4]] = match arrangement {
            Arrangement::Soft => &[[0.0, 60.0, 14.0, 0.3]],
            Arrangement::Side => &[[0.0, 45.0, 4.0, 0.75]],
            Arrangement::Two => &[[0.0, 50.0, 5.0, 0.45], [120.0, 50.0, 5.0, 0.3]],
        };
        let lamp = |(index, &[turn_deg, elevation, softness, share]): (usize, &[f64; 4])| {
            let first = |value: Option<f64>, default| if index == 0 { value.unwrap_or(default) } else { default };
            Lamp {
                azimuth_rad: (azimuth_deg + turn_deg).to_radians(),
                elevation_rad: first(elevation_deg, elevation).to_radians(),
                radius_rad: first(softness_deg, softness).to_radians(),
                share,
            }
        };
        Ok(Self { lamps: lamps.iter().enumerate().map(lamp).collect() })
    }

    fn sky_share(&self) -> f64 {
        1.0 - self.lamps.iter().map(|lamp| lamp.share).sum::<f64>()
    }

    /// Light on a surface with a unit normal, of that on the table.
    pub(super) fn on(&self, normal: [f64; 3]) -> f64 {
        let of_lamp = |lamp: &Lamp| {
            let towards = direction(lamp.azimuth_rad, lamp.elevation_rad.sin());
            let dot: f64 = (0..3).map(|i| towards[i] * normal[i]).sum();
            lamp.share * dot.max(0.0) / towards[2]
        };
        self.sky_share() * sky_on(normal) + self.lamps.iter().map(of_lamp).sum::<f64>()
    }

    /// Directions towards the light, world, each with its share of the light on the table; all shares are 1.
    pub(super) fn directions(&self) -> Vec<([f64; 3], f64)> {
        let mut all = Vec::new();
        for lamp in &self.lamps {
            for i in 0..LAMP_DIRECTIONS {
                let radius = lamp.radius_rad * ((i as f64 + 0.5) / LAMP_DIRECTIONS as f64).sqrt();
                let (aside, up) = (i as f64 * GOLDEN_TURN * TAU).sin_cos();
                let elevation = (lamp.elevation_rad + radius * up).max(LEAST_ELEVATION_DEG.to_radians() / 2.0);
                // Seen from below, the lamp is as wide as it is high.
                let azimuth = lamp.azimuth_rad + radius * aside / lamp.elevation_rad.cos().max(0.1);
                all.push((direction(azimuth, elevation.sin()), lamp.share / LAMP_DIRECTIONS as f64));
            }
        }
        for i in 0..SKY_DIRECTIONS {
            // Even in the square of the sine: as much light on the table from each.
            let sine = (SKY_LEAST_SINE.powi(2)
                + (1.0 - SKY_LEAST_SINE.powi(2)) * (i as f64 + 0.5) / SKY_DIRECTIONS as f64)
                .sqrt();
            let share = self.sky_share() / SKY_DIRECTIONS as f64;
            all.push((direction(i as f64 * GOLDEN_TURN * TAU, sine), share));
        }
        all
    }
}

/// Light of an even sky on a surface with a unit normal, of that on the table.
pub(super) fn sky_on(normal: [f64; 3]) -> f64 {
    (1.0 + normal[2]) / 2.0
}

fn direction(azimuth_rad: f64, sine_of_elevation: f64) -> [f64; 3] {
    let (sin, cos) = azimuth_rad.sin_cos();
    let flat = (1.0 - sine_of_elevation * sine_of_elevation).max(0.0).sqrt();
    [flat * cos, flat * sin, sine_of_elevation]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_light_and_srgb_are_inverse_and_keep_black_and_white() {
        for level in 0..=255 {
            let value = f64::from(level) / 255.0;
            assert!((srgb_from_linear(linear_from_srgb(value)) - value).abs() < 1e-6);
        }
        assert_eq!((linear_from_srgb(0.0), srgb_from_linear(0.0)), (0.0, 0.0));
        // By the table of the standard.
        assert!((linear_from_srgb(0.5) - 0.2140).abs() < 1e-4);
    }

    #[test]
    fn a_free_table_gets_all_light_in_every_arrangement() {
        for arrangement in [Arrangement::Soft, Arrangement::Side, Arrangement::Two] {
            let lighting = Lighting::new(arrangement, &LampOptions::default()).unwrap();
            assert!((lighting.on([0.0, 0.0, 1.0]) - 1.0).abs() < 1e-12);
            let directions = lighting.directions();
            assert!((directions.iter().map(|(_, share)| share).sum::<f64>() - 1.0).abs() < 1e-9);
            assert!(directions.iter().all(|(d, _)| d[2] > 0.0 && (d[0].hypot(d[1]).hypot(d[2]) - 1.0).abs() < 1e-12));
        }
    }

    #[test]
    fn a_wall_towards_the_lamp_is_brighter_than_one_away_from_it() {
        let options = LampOptions { azimuth_deg: Some(0.0), ..LampOptions::default() };
        let lighting = Lighting::new(Arrangement::Side, &options).unwrap();
        assert!(lighting.on([1.0, 0.0, 0.0]) > 4.0 * lighting.on([-1.0, 0.0, 0.0]));
    }

    #[test]
    fn lamps_that_cannot_be_are_told() {
        let options = LampOptions { elevation_deg: Some(3.0), ..LampOptions::default() };
        let message = Lighting::new(Arrangement::Side, &options).unwrap_err().to_string();
        assert_eq!(message, "elevation_deg is 3; allowed: 10 to 90");
        let options = LampOptions { softness_deg: Some(f64::NAN), ..LampOptions::default() };
        assert!(Lighting::new(Arrangement::Soft, &options).is_err());
    }
}
