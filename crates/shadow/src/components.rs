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
            let mut rest = row;
            while let Some(&here) = rest.first() {
                let start = (row.len() - rest.len()) as u32;
                rest = after(rest, here);
                let run = MaskRun { y, start, end: (row.len() - rest.len()) as u32 };
                if here != code {
                    others(here, run);
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

/// What follows the first pixels of a code; most runs are long, so several pixels are asked at a time.
fn after(mut row: &[u8], code: u8) -> &[u8] {
    while let Some((chunk, rest)) = row.split_first_chunk::<16>()
        && *chunk == [code; 16]
    {
        row = rest;
    }
    let same = row.iter().take_while(|&&here| here == code).count();
    &row[same..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_of_any_length_are_whole_and_joined_where_they_touch() {
        let row = |lengths: &[(u8, usize)]| -> Vec<u8> {
            lengths.iter().flat_map(|&(code, n)| std::iter::repeat_n(code, n)).collect()
        };
        let sheet = [
            row(&[(1, 15), (2, 1), (1, 16), (0, 17), (1, 1)]),
            row(&[(2, 16), (1, 1), (2, 32), (1, 1)]),
            row(&[(0, 1), (1, 32), (0, 17)]),
        ]
        .concat();
        let (mut components, mut others) = (Components::default(), Vec::new());
        components.find(&sheet, 50, 1, |code, run: MaskRun| others.push((code, run.y, run.start, run.end)));
        let runs: Vec<_> = components.runs.iter().map(|run| (run.y, run.start, run.end)).collect();
        assert_eq!(runs, [(0, 0, 15), (0, 16, 32), (0, 49, 50), (1, 16, 17), (1, 49, 50), (2, 1, 33)]);
        assert_eq!(
            others,
            [(2, 0, 15, 16), (0, 0, 32, 49), (2, 1, 0, 16), (2, 1, 17, 49), (0, 2, 0, 1), (0, 2, 33, 50)]
        );
        assert_eq!((0..6).map(|run| components.root(run)).collect::<Vec<_>>(), [0, 1, 2, 1, 2, 1]);
        // Nothing is left of an earlier sheet.
        components.find(&[], 0, 1, |_, _| {});
        assert!(components.runs.is_empty());
    }
}
