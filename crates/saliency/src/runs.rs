//! The rows of a label image as runs of one label.

use rayon::prelude::*;
use samsod_segment::Partition;

/// Columns `start .. end` of a row carry `label`; `end` is the start of the next run or the width.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Run {
    pub(crate) start: u32,
    pub(crate) end: u32,
    pub(crate) label: u32,
}

/// The runs of every row.
#[derive(Debug, Default)]
pub(crate) struct Runs {
    rows: Vec<Vec<Run>>,
}

impl Runs {
    /// Reads the runs of a partition.
    pub(crate) fn fill(&mut self, partition: &Partition) {
        let width = partition.width() as usize;
        self.rows.resize_with(partition.height() as usize, Vec::new);
        self.rows.par_iter_mut().zip(partition.labels().par_chunks_exact(width)).with_min_len(16).for_each(
            |(runs, line)| {
                runs.clear();
                let mut start = 0;
                for run in line.chunk_by(|a, b| a == b) {
                    let end = start + run.len() as u32;
                    runs.push(Run { start, end, label: run[0] });
                    start = end;
                }
            },
        );
    }

    /// The runs of row `y`.
    pub(crate) fn row(&self, y: usize) -> &[Run] {
        &self.rows[y]
    }

    /// Number of rows.
    pub(crate) fn height(&self) -> usize {
        self.rows.len()
    }
}
