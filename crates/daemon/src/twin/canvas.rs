//! The picture of a table, put together from layers: one for each part, its shadow and its patch.
//!
//! A part that has not moved looks the same, so its layer is kept, and only where a part came or went the picture is composed
//! anew. From the bare table upwards, in linear light:
//!
//! 1. the table is darkened by all shadows. Of the light that one part lets through, the next takes its share: what is left
//!    is the product of 1 - missed. Where two parts stand before the same lamp, that is darker than it were in truth, and
//!    where they stand before two, brighter; parts with a gap for the gripper between them have only thin shadows in common;
//! 2. patches are laid over it, the far ones first: what lies nearer hides what lies farther.
//!
//! A pixel depends on the layers alone, not on what was shown before.

use std::ops::Range;

use super::noise::level_of;
use super::tile::{Area, Tile};

/// Light that comes back into a shadow from the table around it.
const BOUNCE: f32 = 0.06;
/// Steps of the curve from linear light to levels.
const CURVE_STEPS: usize = 1 << 14;
/// Of a millimetre or degree: files that are read and written again change the last digits of a place.
const PLACE_STEPS: f64 = 1e6;

/// What a layer shows: a part and its place in the base frame. The same key means the same layer.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct LayerKey {
    pub(super) name: String,
    /// x, y, z and yaw, in steps.
    place: [i64; 4],
    pub(super) is_dropped: bool,
}

impl LayerKey {
    /// # Arguments
    /// * `place` - x, y, z in mm, yaw in degrees
    pub(super) fn new(name: &str, place: [f64; 4], is_dropped: bool) -> Self {
        Self { name: name.to_owned(), place: place.map(|c| (c * PLACE_STEPS).round() as i64), is_dropped }
    }

    /// x, y, z in mm, yaw in degrees: those of the steps.
    pub(super) fn place(&self) -> [f64; 4] {
        self.place.map(|c| c as f64 / PLACE_STEPS)
    }
}

/// A part at its place, drawn.
#[derive(Debug)]
pub(super) struct Layer {
    pub(super) key: LayerKey,
    /// Depth of its nearest point, mm.
    pub(super) depth_mm: f64,
    /// Linear red, green, blue times cover; cover, in [0, 1].
    pub(super) patch: Tile<[f32; 4]>,
    /// Share of the light that the table misses, in [0, 1].
    pub(super) shadow: Tile<f32>,
}

/// What [`Canvas::show`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Shown {
    /// Layers that have anything in view.
    pub(super) in_view: usize,
    /// Layers that were drawn; the others were kept.
    pub(super) drawn: usize,
}

/// The bare table and what lies on it now.
#[derive(Debug)]
pub(super) struct Canvas {
    size: [usize; 2],
    /// Linear light of the bare table, row by row.
    table: Vec<[f32; 3]>,
    curve: Vec<u16>,
    levels: Vec<u16>,
    /// Far to near.
    layers: Vec<Layer>,
    /// Those of the picture before that are not in this one.
    gone: Vec<Layer>,
}

impl Canvas {
    /// A bare table.
    ///
    /// # Arguments
    /// * `table` - its linear light, row by row, as many pixels as `size` has
    pub(super) fn new(table: Vec<[f32; 3]>, size: [usize; 2]) -> Self {
        let curve: Vec<u16> = (0..=CURVE_STEPS).map(|i| level_of(i as f64 / CURVE_STEPS as f64)).collect();
        let levels = table.iter().flat_map(|pixel| pixel.map(|c| level(&curve, c))).collect();
        Self { size, table, curve, levels, layers: Vec::new(), gone: Vec::new() }
    }

    /// Red, green, blue of each pixel, row by row: sRGB, 256 steps for one of 8 bits.
    pub(super) fn levels(&self) -> &[u16] {
        &self.levels
    }

    /// Shows these parts and no others.
    ///
    /// # Arguments
    /// * `draw` - makes the layer of a key that is not at hand, over the linear light of the bare table
    pub(super) fn show(&mut self, keys: Vec<LayerKey>, mut draw: impl FnMut(LayerKey, &[[f32; 3]]) -> Layer) -> Shown {
        let mut before = std::mem::take(&mut self.layers);
        let mut gone = std::mem::take(&mut self.gone);
        let (mut changed, mut layers, mut drawn) = (Vec::new(), Vec::new(), 0);
        for key in keys {
            let take = |from: &mut Vec<Layer>| {
                let at = from.iter().position(|layer| layer.key == key)?;
                Some(from.swap_remove(at))
            };
            if let Some(same) = take(&mut before) {
                layers.push(same);
                continue;
            }
            let layer = take(&mut gone).unwrap_or_else(|| {
                drawn += 1;
                draw(key, &self.table)
            });
            changed.extend(layer.areas());
            layers.push(layer);
        }
        changed.extend(before.iter().flat_map(Layer::areas));
        // Not in the order of the file: the same parts in another order are the same picture.
        layers.sort_by(|a, b| b.depth_mm.total_cmp(&a.depth_mm).then_with(|| a.key.cmp(&b.key)));
        (self.layers, self.gone) = (layers, before);
        self.compose(&changed);
        Shown { in_view: self.layers.iter().filter(|layer| layer.is_in_view()).count(), drawn }
    }

    /// Composes these areas anew, each pixel once.
    fn compose(&mut self, areas: &[Area]) {
        let mut light = Vec::new();
        for row in 0..self.size[1] {
            let in_row = areas.iter().filter(|area| area.rows.contains(&row));
            let mut spans: Vec<(usize, usize)> = in_row.map(|area| (area.columns.start, area.columns.end)).collect();
            spans.sort_unstable();
            let mut done = 0;
            for (start, end) in spans {
                let start = start.max(done);
                if start < end {
                    self.compose_row(row, start..end, &mut light);
                    done = end;
                }
            }
        }
    }

    /// # Arguments
    /// * `light` - room for a row
    fn compose_row(&mut self, row: usize, columns: Range<usize>, light: &mut Vec<[f32; 3]>) {
        let first = row * self.size[0] + columns.start;
        light.clear();
        light.resize(columns.len(), [1.0; 3]);
        for layer in &self.layers {
            let (skip, missed) = layer.shadow.within(row, &columns);
            light.iter_mut().skip(skip).zip(missed).for_each(|(left, missed)| left[0] *= 1.0 - missed);
        }
        for (light, table) in light.iter_mut().zip(&self.table[first..]) {
            let left = 1.0 - (1.0 - light[0]) * (1.0 - BOUNCE);
            *light = table.map(|c| c * left);
        }
        for layer in &self.layers {
            let (skip, patch) = layer.patch.within(row, &columns);
            for (light, [red, green, blue, cover]) in light.iter_mut().skip(skip).zip(patch) {
                let left = 1.0 - cover;
                let [r, g, b] = *light;
                *light = [r * left + red, g * left + green, b * left + blue];
            }
        }
        let levels = self.levels[first * 3..].chunks_exact_mut(3);
        for (levels, light) in levels.zip(light.iter()) {
            levels.copy_from_slice(&light.map(|c| level(&self.curve, c)));
        }
    }
}

impl Layer {
    fn areas(&self) -> [Area; 2] {
        [self.patch.area.clone(), self.shadow.area.clone()]
    }

    fn is_in_view(&self) -> bool {
        !self.patch.values.is_empty()
    }
}

fn level(curve: &[u16], light: f32) -> u16 {
    curve[((light.clamp(0.0, 1.0) * CURVE_STEPS as f32) + 0.5) as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [30, 20];

    fn canvas() -> Canvas {
        Canvas::new((0..SIZE[0] * SIZE[1]).map(|i| [0.3, 0.5, i as f32 / 600.0]).collect(), SIZE)
    }

    fn key(name: &str, [x, y]: [usize; 2]) -> LayerKey {
        LayerKey::new(name, [x as f64, y as f64, 0.0, 0.0], false)
    }

    /// A square of 6 px with a shadow of 10, the nearer the later its name comes.
    fn layer(key: LayerKey) -> Layer {
        let [x, y, ..] = key.place().map(|c| c as usize);
        let depth_mm = f64::from(200 - key.name.as_bytes()[0]);
        let cover = 0.25 + f32::from(key.name.as_bytes()[0] % 3) * 0.25;
        Layer {
            patch: Tile::new(
                Area { columns: x..x + 6, rows: y..y + 6 },
                [0.1 * cover, 0.7 * cover, 0.2 * cover, cover],
            ),
            shadow: Tile::new(Area { columns: x + 1..x + 11, rows: y..y + 10 }, 0.37),
            key,
            depth_mm,
        }
    }

    fn fresh(keys: Vec<LayerKey>) -> Vec<u16> {
        let mut canvas = canvas();
        canvas.show(keys, |key, _| layer(key));
        canvas.levels
    }

    #[test]
    fn what_was_shown_before_leaves_no_trace() {
        let (a, b, c) = (key("a", [2, 3]), key("b", [5, 6]), key("c", [11, 4]));
        let moved = key("b", [9, 7]);
        let mut canvas = canvas();
        let bare = canvas.levels().to_vec();
        for (keys, drawn) in [
            (vec![a.clone(), b.clone(), c.clone()], 3),
            // One is gone; it comes back, and all lie in another order.
            (vec![a.clone(), c.clone()], 0),
            (vec![c.clone(), b.clone(), a.clone()], 0),
            (vec![a.clone(), moved.clone()], 1),
            (vec![a.clone(), a.clone(), moved], 1),
            // One that was gone for two pictures is drawn anew.
            (vec![c], 1),
            (vec![], 0),
        ] {
            let shown = canvas.show(keys.clone(), |key, _| layer(key));
            assert_eq!(shown, Shown { in_view: keys.len(), drawn }, "{keys:?}");
            assert_eq!(canvas.levels(), fresh(keys.clone()), "{keys:?}");
            assert_eq!(canvas.levels() != bare, !keys.is_empty(), "{keys:?}");
        }
    }

    #[test]
    fn shadows_multiply_and_the_nearer_patch_is_on_top() {
        let keys = vec![key("b", [5, 6]), key("a", [3, 6])];
        let levels = fresh(keys);
        let at = |[x, y]: [usize; 2]| levels[(y * SIZE[0] + x) * 3 + 1];
        // In both shadows, under no patch.
        let left = 1.0 - (1.0 - 0.63 * 0.63) * 0.94;
        assert!(at([12, 13]).abs_diff(level_of(0.5 * left)) <= 12);
        // Under both: a covers by a half, b above it by three quarters.
        let under = (0.5 * left) * 0.5 + 0.7 * 0.5;
        assert!(at([7, 8]).abs_diff(level_of(under * 0.25 + 0.7 * 0.75)) <= 12);
    }

    #[test]
    fn places_that_were_written_and_read_are_the_same() {
        let place = [512.37, -40.11, 0.0, 31.07];
        let again = [512.37, -40.11, 0.0, 31.07f64.to_radians().to_degrees().to_radians().to_degrees() + 1e-13];
        assert_eq!(LayerKey::new("a", place, false), LayerKey::new("a", again, false));
        assert_eq!(LayerKey::new("a", place, false).place(), place);
        assert_ne!(LayerKey::new("a", place, false), LayerKey::new("a", [512.38, -40.11, 0.0, 31.07], false));
    }
}
