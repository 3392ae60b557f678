//! The 4-connected components of the pixels of a sheet that have one code, as runs of a row.

use crate::MaskRun;

/// Components, with memory that is reused.
#[derive(Debug, Default)]
pub(crate) struct Components {
    /// The runs, from top to bottom and left to right, in coordinates of the sheet.
    pub(crate) runs: Vec<MaskRun>,
    /// A run of the same component; a root is its own parent, and the first run of its component.
    parents: Vec<u32>,
}

impl Components {
    /// Reads the runs of a code, row by row of `width` pixels, and joins those that share an edge; calls
    /// `others(code, run)` for the runs between.
    pub(crate) fn find(&mut self, sheet: &[u8], width: usize, code: u8, mut others: impl FnMut(u8, MaskRun)) {
        self.runs.clear();
        self.parents.clear();
        // The runs of the row above.
        let mut above = 0..0;
        for (y, row) in (0..).zip(sheet.chunks_exact(width.max(1))) {
            let first = self.runs.len();
            let mut start = 0;
            for chunk in row.chunk_by(|a, b| a == b) {
                let run = MaskRun { y, start, end: start + chunk.len() as u32 };
                start = run.end;
                if chunk[0] != code {
                    others(chunk[0], run);
                    continue;
                }
                let number = self.runs.len();
                self.runs.push(run);
                self.parents.push(number as u32);
                while above.start < above.end && self.runs[above.start].end <= run.start {
                    above.start += 1;
                }
                let mut i = above.start;
                while i < above.end && self.runs[i].start < run.end {
                    self.join(i, number);
                    i += 1;
                }
            }
            above = first..self.runs.len();
        }
    }

    /// The first run of the component of a run.
    pub(crate) fn root(&mut self, mut run: usize) -> usize {
        while self.parents[run] as usize != run {
            let next = self.parents[run] as usize;
            self.parents[run] = self.parents[next];
            run = next;
        }
        run
    }

    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.parents[a.max(b)] = a.min(b) as u32;
    }
}
