//! Where shadows fade out: pixels of the table, each with the partition that it fades from.

use crate::partition::BoundingBox;
use crate::runs::{Run, Runs};

/// No label.
pub(crate) const NOTHING: u32 = u32::MAX;

/// The penumbrae of a partition, in blocks of working pixels.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Penumbrae {
    /// Side of a block, px.
    reduction: u32,
    /// The blocks, and gaps of [`NOTHING`] between them.
    runs: Runs,
    /// Their extent by label, px.
    boxes: Vec<Option<BoundingBox>>,
}

impl Penumbrae {
    pub(crate) fn clear(&mut self) {
        self.reduction = 0;
        self.runs.clear();
        self.boxes.clear();
    }

    /// Takes a label or [`NOTHING`] for every block of `reduction` px a side, of which `columns` lie in a row, of an image of `size`
    /// with `count` labels.
    pub(crate) fn fill(&mut self, from: &[u32], (columns, reduction): (usize, usize), size: (u32, u32), count: usize) {
        self.reduction = reduction as u32;
        self.runs.fill(from, columns);
        self.boxes.clear();
        self.boxes.resize(count, None);
        let r = self.reduction;
        for (row, runs) in self.runs.rows().iter().enumerate() {
            for run in runs {
                let Some(slot) = self.boxes.get_mut(run.label as usize) else { continue };
                let (x, y) = (run.start * r, row as u32 * r);
                let (right, bottom) = ((run.end * r).min(size.0), (y + r).min(size.1));
                let own = BoundingBox { x, y, width: right - x, height: bottom - y };
                *slot = Some(slot.map_or(own, |b| b.union(&own)));
            }
        }
    }

    /// Those of one row of the image of `width` columns, from left to right.
    pub(crate) fn row(&self, y: u32, width: u32) -> impl Iterator<Item = Run> {
        let r = self.reduction;
        let runs = y.checked_div(r).map_or(&[][..], |row| self.runs.row(row as usize));
        let scaled = move |run: &Run| Run { start: run.start * r, end: (run.end * r).min(width), label: run.label };
        runs.iter().filter(|run| run.label != NOTHING).map(scaled)
    }

    /// What a pixel fades from.
    pub(crate) fn at(&self, x: u32, y: u32) -> Option<u32> {
        let (column, row) = (x.checked_div(self.reduction)?, y.checked_div(self.reduction)?);
        let runs = self.runs.row(row as usize);
        let run = runs.get(runs.partition_point(|run| run.end <= column))?;
        (run.label != NOTHING).then_some(run.label)
    }

    /// The extent of those that fade from a label, px.
    pub(crate) fn bbox(&self, label: u32) -> Option<BoundingBox> {
        self.boxes.get(label as usize).copied().flatten()
    }
}
