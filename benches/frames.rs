//! Frames for the benchmarks: the bundled scenes of a robot cell at several widths.
