//! The shape of a part from an STL file.
//!
//! In: binary or ASCII STL in millimetres, z up, lying as the part lies on the table. Out: vertices, merged, with the
//! lowest at z = 0, and triangles. A file may claim any number of triangles and hold any coordinates: what is not a
//! part of at most [`MAX_TRIANGLES`] triangles and [`MAX_EXTENT_MM`] is refused.

use std::collections::HashMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// Most triangles of a mesh.
const MAX_TRIANGLES: usize = 1_000_000;
/// Longest side of a mesh, mm.
const MAX_EXTENT_MM: f32 = 5_000.0;
/// Cells of a coarse mesh along its longest side.
const COARSE_CELLS: f32 = 64.0;
/// An ASCII triangle with all digits a float can have.
const MOST_BYTES_OF_TRIANGLE: u64 = 600;

/// Why a file is no mesh.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// It cannot be read, or is no STL.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What was said.
        source: std::io::Error,
    },
    /// It is larger than any mesh that is taken.
    #[error("{}: {bytes} bytes; allowed are at most {most}", path.display())]
    Size {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// The most that is allowed.
        most: u64,
    },
    /// It has too few or too many triangles.
    #[error("{}: {count} triangles; allowed are 4 to {MAX_TRIANGLES}", path.display())]
    Triangles {
        /// The file.
        path: PathBuf,
        /// How many there are.
        count: usize,
    },
    /// A coordinate is NaN, infinite or far away.
    #[error("{}: vertex {vertex} is at {value:?} mm; allowed are finite numbers up to 1e6", path.display())]
    Vertex {
        /// The file.
        path: PathBuf,
        /// Index of the vertex.
        vertex: usize,
        /// Its coordinates.
        value: [f32; 3],
    },
    /// It is flat, a point, or larger than a cell.
    #[error("{}: {extent:?} mm long, wide and high; allowed are 0.1 to {MAX_EXTENT_MM}; is the unit millimetres?", path.display())]
    Extent {
        /// The file.
        path: PathBuf,
        /// Length along x, y, z.
        extent: [f32; 3],
    },
}

/// A triangle mesh in the frame of its part, mm.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    vertices: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
    is_closed: bool,
    sides: Vec<Side>,
    coarse: Coarse,
}

/// A mesh whose vertices of one cell are one.
#[derive(Debug, Clone, Default, PartialEq)]
struct Coarse {
    vertices: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
    sides: Vec<Side>,
}

/// A side of a triangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Side {
    /// The vertices of the edge that it lies on, the lower index first.
    pub(crate) edge: [u32; 2],
    /// Whether the triangle is run round along the edge.
    pub(crate) is_along: bool,
    /// Index of the triangle.
    pub(crate) triangle: u32,
}

/// What a mesh is seen by.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Faces<'a> {
    /// The vertices, mm,
    pub(crate) vertices: &'a [[f32; 3]],
    /// the triangles, counter-clockwise seen from outside,
    pub(crate) triangles: &'a [[u32; 3]],
    /// and their sides by edges. A triangle of a coarse mesh that is one of several alike has the sides of all.
    pub(crate) sides: &'a [Side],
}

impl Mesh {
    /// Reads an STL file.
    ///
    /// # Errors
    /// [`MeshError`], with the file, the value and what is allowed.
    pub fn read(path: &Path) -> Result<Self, MeshError> {
        let unreadable = |source| MeshError::Read { path: path.to_owned(), source };
        let file = File::open(path).map_err(unreadable)?;
        let bytes = file.metadata().map_err(unreadable)?.len();
        let most = MAX_TRIANGLES as u64 * MOST_BYTES_OF_TRIANGLE;
        if bytes > most {
            return Err(MeshError::Size { path: path.to_owned(), bytes, most });
        }
        let stl = stl_io::read_stl(&mut BufReader::new(file)).map_err(unreadable)?;
        if stl.faces.len() < 4 || stl.faces.len() > MAX_TRIANGLES {
            return Err(MeshError::Triangles { path: path.to_owned(), count: stl.faces.len() });
        }
        let vertices: Vec<[f32; 3]> = stl.vertices.iter().map(|v| [v[0], v[1], v[2]]).collect();
        let triangles = stl.faces.iter().map(|face| face.vertices.map(|v| v as u32)).collect();
        Self::new(vertices, triangles, path)
    }

    /// Checks, and puts the lowest vertex on the table.
    fn new(mut vertices: Vec<[f32; 3]>, triangles: Vec<[u32; 3]>, path: &Path) -> Result<Self, MeshError> {
        if let Some(vertex) = vertices.iter().position(|v| v.iter().any(|c| !c.is_finite() || c.abs() > 1e6)) {
            return Err(MeshError::Vertex { path: path.to_owned(), vertex, value: vertices[vertex] });
        }
        let least = |axis: usize| vertices.iter().map(|v| v[axis]).fold(f32::INFINITY, f32::min);
        let most = |axis: usize| vertices.iter().map(|v| v[axis]).fold(f32::NEG_INFINITY, f32::max);
        let extent = [0, 1, 2].map(|axis| most(axis) - least(axis));
        if extent.iter().any(|side| !(0.1..=MAX_EXTENT_MM).contains(side)) {
            return Err(MeshError::Extent { path: path.to_owned(), extent });
        }
        let bottom = least(2);
        vertices.iter_mut().for_each(|v| v[2] -= bottom);
        let sides = sides(&triangles, |i| i as u32);
        let is_closed = is_closed(&sides);
        let cell = extent.iter().copied().fold(0.0, f32::max) / COARSE_CELLS;
        let coarse = coarse(&vertices, &triangles, cell);
        Ok(Self { vertices, triangles, is_closed, sides, coarse })
    }

    /// All of it.
    pub(crate) fn fine(&self) -> Faces<'_> {
        Faces { vertices: &self.vertices, triangles: &self.triangles, sides: &self.sides }
    }

    /// The same shape to about a hundredth of its length: a thread has thousands of triangles that no camera resolves. As
    /// closed as the mesh.
    pub(crate) fn coarse(&self) -> Faces<'_> {
        let Coarse { vertices, triangles, sides } = &self.coarse;
        Faces { vertices, triangles, sides }
    }

    /// Whether every edge belongs to as many triangles that run along it as to such that run back. A ray then meets as many
    /// triangles from their front as from behind.
    pub(crate) fn is_closed(&self) -> bool {
        self.is_closed
    }

    /// The vertices, mm.
    pub fn vertices(&self) -> &[[f32; 3]] {
        &self.vertices
    }

    /// Indices of the vertices of every triangle, counter-clockwise seen from outside.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Height of the highest vertex over the table, mm.
    pub fn height_mm(&self) -> f32 {
        self.vertices.iter().map(|v| v[2]).fold(0.0, f32::max)
    }
}

/// Puts all vertices of a cell into their middle, and leaves out the triangles that have no area then.
fn coarse(vertices: &[[f32; 3]], triangles: &[[u32; 3]], cell: f32) -> Coarse {
    let mut of_cells: HashMap<[i32; 3], u32> = HashMap::new();
    let mut sums: Vec<([f64; 3], f64)> = Vec::new();
    let mut merged = Vec::with_capacity(vertices.len());
    for vertex in vertices {
        let index = *of_cells.entry(vertex.map(|c| (c / cell).floor() as i32)).or_insert_with(|| {
            sums.push(([0.0; 3], 0.0));
            sums.len() as u32 - 1
        });
        let (sum, count) = &mut sums[index as usize];
        sum.iter_mut().zip(vertex).for_each(|(sum, c)| *sum += f64::from(*c));
        *count += 1.0;
        merged.push(index);
    }
    let mut all: Vec<[u32; 3]> = triangles
        .iter()
        .map(|triangle| triangle.map(|i| merged[i as usize]))
        .filter(|[a, b, c]| a != b && b != c && c != a)
        // Of the three ways to name one, that which begins with the least.
        .map(|[a, b, c]| {
            if a < b && a < c {
                [a, b, c]
            } else if b < c {
                [b, c, a]
            } else {
                [c, a, b]
            }
        })
        .collect();
    // What hides nothing that another does not hide, adds nothing.
    all.sort_unstable();
    let mut different = all.clone();
    different.dedup();
    // One of several that are alike is found where they would be.
    let sides = sides(&all, |i| different.partition_point(|other| *other < all[i]) as u32);
    let vertices = sums.iter().map(|(sum, count)| sum.map(|c| (c / count) as f32)).collect();
    Coarse { vertices, triangles: different, sides }
}

/// The sides of triangles, those of one edge one after another; `index` says which triangle one counts as.
fn sides(triangles: &[[u32; 3]], index: impl Fn(usize) -> u32) -> Vec<Side> {
    let of_triangle = |(i, &[a, b, c]): (usize, &[u32; 3])| {
        let triangle = index(i);
        [[a, b], [b, c], [c, a]].map(|[a, b]| Side { edge: [a.min(b), a.max(b)], is_along: a < b, triangle })
    };
    let mut sides: Vec<Side> = triangles.iter().enumerate().flat_map(of_triangle).collect();
    sides.sort_unstable();
    sides
}

fn is_closed(sides: &[Side]) -> bool {
    let way = |side: &Side| if side.is_along { 1 } else { -1 };
    sides.chunk_by(|a, b| a.edge == b.edge).all(|edge| edge.iter().map(way).sum::<i32>() == 0)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::test_parts::{binary_stl, write_stl};

    const TETRAHEDRON: [[[f32; 3]; 3]; 4] = [
        [[0.0, 0.0, 3.0], [0.0, 8.0, 3.0], [8.0, 0.0, 3.0]],
        [[0.0, 0.0, 3.0], [8.0, 0.0, 3.0], [0.0, 0.0, 9.0]],
        [[0.0, 0.0, 3.0], [0.0, 0.0, 9.0], [0.0, 8.0, 3.0]],
        [[8.0, 0.0, 3.0], [0.0, 8.0, 3.0], [0.0, 0.0, 9.0]],
    ];

    /// What reading some bytes as STL says.
    fn read(bytes: &[u8]) -> Result<Mesh, MeshError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("odd.stl");
        fs::write(&path, bytes).unwrap();
        let read = Mesh::read(&path);
        if let Err(error) = &read {
            assert!(error.to_string().contains(path.to_str().unwrap()), "{error}");
        }
        read
    }

    fn refused(bytes: &[u8]) -> String {
        read(bytes).unwrap_err().to_string()
    }

    fn ascii(triangles: &[[[f32; 3]; 3]]) -> String {
        let mut text = "solid part\n".to_owned();
        for triangle in triangles {
            text += "facet normal 0 0 1\nouter loop\n";
            for [x, y, z] in triangle {
                text += &format!("vertex {x} {y} {z}\n");
            }
            text += "endloop\nendfacet\n";
        }
        text + "endsolid part\n"
    }

    #[test]
    fn binary_and_ascii_give_the_same_mesh_on_the_table() {
        let binary = read(&binary_stl(&TETRAHEDRON, 4)).unwrap();
        assert_eq!(binary, read(ascii(&TETRAHEDRON).as_bytes()).unwrap());
        assert_eq!((binary.vertices().len(), binary.triangles().len(), binary.height_mm()), (4, 4, 6.0));
        assert!(binary.vertices().contains(&[8.0, 0.0, 0.0]), "{:?}", binary.vertices());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("box.stl");
        write_stl(&[[[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]], &path);
        let mesh = Mesh::read(&path).unwrap();
        assert_eq!((mesh.vertices().len(), mesh.triangles().len(), mesh.height_mm()), (8, 12, 6.0));
        assert!(mesh.is_closed());
    }

    #[test]
    fn a_mesh_with_a_hole_or_a_turned_triangle_is_not_closed() {
        assert!(read(&binary_stl(&TETRAHEDRON, 4)).unwrap().is_closed());
        let mut triangles = TETRAHEDRON.to_vec();
        triangles[1].swap(0, 1);
        assert!(!read(&binary_stl(&triangles, 4)).unwrap().is_closed());
        triangles = [TETRAHEDRON, TETRAHEDRON.map(|t| t.map(|[x, y, z]| [x + 20.0, y, z]))].concat();
        triangles.pop();
        assert!(!read(&binary_stl(&triangles, 7)).unwrap().is_closed());
    }

    #[test]
    fn what_is_no_stl_is_refused_by_name() {
        let whole = binary_stl(&TETRAHEDRON, 4);
        for length in [0, 40, 80, 83, 84, 100, whole.len() - 1] {
            assert!(read(&whole[..length]).is_err(), "{length} bytes");
        }
        let text = ascii(&TETRAHEDRON);
        assert!(read(&text.as_bytes()[..text.len() / 2]).is_err());
        assert!(read(b"ISO-10303-21;\nHEADER;\n").is_err());
        assert!(read(&[0xff; 200]).is_err());
        let missing = Mesh::read(Path::new("/nowhere/model.stl")).unwrap_err().to_string();
        assert!(missing.starts_with("cannot read /nowhere/model.stl: "), "{missing}");
    }

    #[test]
    fn a_claim_of_billions_of_triangles_takes_no_memory_and_is_refused() {
        for count in [5, 1_000_001, u32::MAX] {
            assert!(read(&binary_stl(&TETRAHEDRON, count)).is_err(), "{count}");
        }
    }

    #[test]
    fn numbers_of_triangles_are_told() {
        assert!(refused(&binary_stl(&TETRAHEDRON[..3], 3)).contains("3 triangles; allowed are 4 to 1000000"));
        assert!(refused(&binary_stl(&[], 0)).contains("0 triangles; allowed are 4 to 1000000"));
    }

    #[test]
    fn coordinates_that_are_none_or_far_away_are_told() {
        for (value, shown) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf"), (-2e6, "-2000000.0")] {
            let mut triangles = TETRAHEDRON;
            triangles[2][1][1] = value;
            let message = refused(&binary_stl(&triangles, 4));
            assert!(message.contains(shown) && message.contains("finite numbers up to 1e6"), "{message}");
        }
    }

    #[test]
    fn a_unit_that_is_not_millimetres_is_asked_about() {
        let scaled = |scale: [f32; 3]| {
            let of = |t: [[f32; 3]; 3]| t.map(|v| [v[0] * scale[0], v[1] * scale[1], v[2] * scale[2]]);
            binary_stl(&TETRAHEDRON.map(of), 4)
        };
        // Metres and micrometres; and a flat one.
        for scale in [[1e-3; 3], [1e3; 3], [1.0, 1.0, 0.0]] {
            let message = refused(&scaled(scale));
            assert!(message.contains("allowed are 0.1 to 5000; is the unit millimetres?"), "{message}");
        }
    }
}
