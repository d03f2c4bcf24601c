//! What a tag shows of its own pixels: four corners are eight numbers, of which place, heading and range explain
//! four. What is left over is noise, whatever the vehicle does.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::measurement::Measurement;

/// Unknowns of a rigid tag on the ground as seen from a helicopter of known attitude: north, east, heading, height.
const RIGID: usize = 4;

/// Components of a tag's innovation that no motion explains.
pub(crate) const LEFT: usize = 8 - RIGID;

/// `min over x of (r − A x)ᵀ R⁻¹ (r − A x)`: the innovation of a tag's corners less what a shift of the tag, a turn or
/// another range explains, chi-square with [`LEFT`] degrees where the noise is as assumed. `rigid` are the columns of the
/// error state of these unknowns. `None` where the noise or the geometry is singular.
pub(crate) fn left_over(z: &Measurement, rigid: &[usize; RIGID]) -> Option<f64> {
    let mut information = SMatrix::<f64, RIGID, RIGID>::zeros();
    let mut seen = SVector::<f64, RIGID>::zeros();
    let mut squared = 0.0;
    for i in (0..z.m).step_by(2) {
        let noise = Matrix2::from_fn(|r, c| z.noise[i + r][i + c]);
        let weight = noise.try_inverse()?;
        let residual = Vector2::new(z.residual[i], z.residual[i + 1]);
        let a = SMatrix::<f64, 2, RIGID>::from_fn(|r, k| z.derivative(i + r, rigid[k]));
        information += a.transpose() * weight * a;
        seen += a.transpose() * (weight * residual);
        squared += residual.dot(&(weight * residual));
    }
    let explained = seen.dot(&information.cholesky()?.solve(&seen));
    Some((squared - explained).max(0.0))
}

#[cfg(test)]
mod tests {
    use super::super::blocks::Block;
    use super::*;

    /// A tag of 40 px seen from above at 1000 px to the unit and 10 m: corners off by `residual`, sigma 0.1 px.
    fn tag(residual: [f64; 8]) -> (Measurement, [usize; RIGID]) {
        let mut z = Measurement::default();
        z.begin(8);
        let columns = z.touch(Block::<RIGID>::FIRST);
        for (i, (x, y)) in
            [(-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0)].into_iter().enumerate()
        {
            for (r, row) in [[100.0, 0.0, -y, x / 10.0], [0.0, 100.0, x, y / 10.0]].into_iter().enumerate() {
                z.residual[2 * i + r] = residual[2 * i + r];
                z.noise[2 * i + r][2 * i + r] = 0.01;
                z.set(2 * i + r, columns, &nalgebra::RowVector4::from(row));
            }
        }
        (z, std::array::from_fn(|k| Block::<RIGID>::FIRST.column(k)))
    }

    #[test]
    fn what_moves_as_a_whole_leaves_nothing() {
        // A shift, a turn by a tenth of a radian, another range: each many sigmas.
        for residual in [
            [3.0, -1.0, 3.0, -1.0, 3.0, -1.0, 3.0, -1.0],
            [2.0, -2.0, 2.0, 2.0, -2.0, 2.0, -2.0, -2.0],
            [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0],
        ] {
            let (z, rigid) = tag(residual);
            assert!(left_over(&z, &rigid).expect("regular") < 1e-9, "{residual:?}");
        }
    }

    #[test]
    fn corners_off_one_by_one_are_noise() {
        // One corner off by ten sigmas: half of its square is no shift, turn or range.
        let mut residual = [0.0; 8];
        residual[4] = 1.0;
        let (z, rigid) = tag(residual);
        let left = left_over(&z, &rigid).expect("regular");
        assert!((left - 50.0).abs() < 1e-6, "{left}");
    }

    #[test]
    fn a_singular_tag_shows_nothing() {
        let (mut z, rigid) = tag([1.0; 8]);
        z.scale_noise(0.0);
        assert_eq!(left_over(&z, &rigid), None);
    }
}
