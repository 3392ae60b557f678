//! Poses as 4 x 4 matrices, as files and Python carry them.
//!
//! In: rows of numbers. Out: a rigid motion, checked; translations in mm.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

/// How far the product of the rotation with its transpose may be from the identity: four decimals written by hand pass.
const TOLERANCE: f64 = 5e-4;

/// Why a matrix is no pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PoseError {
    /// An element is NaN or infinite.
    #[error("row {row}, column {column} is {value}; allowed: a finite number")]
    NotFinite {
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        column: usize,
        /// The element.
        value: f64,
    },
    /// The last row is not that of a pose.
    #[error("the last row is {row:?}; allowed: [0, 0, 0, 1]")]
    LastRow {
        /// The row.
        row: [f64; 4],
    },
    /// The upper left 3 x 3 matrix does not preserve lengths and angles.
    #[error(
        "the upper left 3 x 3 matrix is no rotation: its product with its transpose is {deviation:.2e} away from the \
         identity; allowed: {TOLERANCE}"
    )]
    NotOrthonormal {
        /// Largest difference of an element.
        deviation: f64,
    },
    /// The upper left 3 x 3 matrix exchanges left and right.
    #[error("the upper left 3 x 3 matrix is a reflection: its determinant is -1; allowed: 1")]
    Reflection,
}

/// The pose that a matrix stands for. A rotation that is off by rounding is made orthonormal again (the nearest
/// rotation, by singular values).
///
/// # Errors
/// [`PoseError`]: elements that are not finite, a last row other than 0 0 0 1, no rotation.
pub fn pose_from_rows(rows: &[[f64; 4]; 4]) -> Result<Isometry3<f64>, PoseError> {
    for (row, values) in rows.iter().enumerate() {
        if let Some(column) = values.iter().position(|v| !v.is_finite()) {
            return Err(PoseError::NotFinite { row, column, value: values[column] });
        }
    }
    if rows[3] != [0.0, 0.0, 0.0, 1.0] {
        return Err(PoseError::LastRow { row: rows[3] });
    }
    let given = Matrix3::from_fn(|row, column| rows[row][column]);
    // Beyond 2 the squares could be too large for numbers, and then their differences are none.
    let deviation = match given.amax() {
        most if most <= 2.0 => (given * given.transpose() - Matrix3::identity()).amax(),
        _ => f64::INFINITY,
    };
    if deviation > TOLERANCE {
        return Err(PoseError::NotOrthonormal { deviation });
    }
    if given.determinant() < 0.0 {
        return Err(PoseError::Reflection);
    }
    let nearest = match given.svd(true, true) {
        nalgebra::SVD { u: Some(u), v_t: Some(v_t), .. } => u * v_t,
        _ => return Err(PoseError::NotOrthonormal { deviation }),
    };
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(nearest));
    Ok(Isometry3::from_parts(Translation3::new(rows[0][3], rows[1][3], rows[2][3]), rotation))
}

/// The matrix of a pose, row by row.
pub fn rows_from_pose(pose: &Isometry3<f64>) -> [[f64; 4]; 4] {
    let matrix = pose.to_homogeneous();
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn rows() -> [[f64; 4]; 4] {
        rows_from_pose(&Isometry3::new(Vector3::new(10.0, -20.0, 900.0), Vector3::new(3.0, 0.1, -0.2)))
    }

    #[test]
    fn rows_and_back() {
        let again = rows_from_pose(&pose_from_rows(&rows()).unwrap());
        for (a, b) in again.iter().flatten().zip(rows().iter().flatten()) {
            assert!((a - b).abs() < 1e-14, "{a} {b}");
        }
    }

    #[test]
    fn four_decimals_are_made_orthonormal_again() {
        let rounded = rows().map(|row| row.map(|v| (v * 1e4).round() / 1e4));
        let pose = pose_from_rows(&rounded).unwrap();
        let matrix = pose.rotation.to_rotation_matrix().into_inner();
        assert!((matrix * matrix.transpose() - Matrix3::identity()).amax() < 1e-14);
        let again = rows_from_pose(&pose);
        assert!(again.iter().flatten().zip(rows().iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-4));
    }

    #[test]
    fn what_is_no_pose_is_refused_with_its_numbers() {
        let with = |row: usize, column: usize, value: f64| {
            let mut rows = rows();
            rows[row][column] = value;
            pose_from_rows(&rows).unwrap_err().to_string()
        };
        assert_eq!(with(1, 3, f64::NAN), "row 1, column 3 is NaN; allowed: a finite number");
        assert!(with(3, 3, 2.0).contains("last row is [0.0, 0.0, 0.0, 2.0]; allowed: [0, 0, 0, 1]"));
        assert!(with(0, 0, 1.3).contains("is no rotation"));
        assert!(with(0, 0, 1e300).contains("is no rotation"));
        let mut mirrored = rows();
        for row in &mut mirrored[..3] {
            row[0] = -row[0];
        }
        assert_eq!(pose_from_rows(&mirrored).unwrap_err(), PoseError::Reflection);
        assert!(matches!(pose_from_rows(&[[0.0; 4]; 4]).unwrap_err(), PoseError::LastRow { .. }));
    }
}
