//! Exact crossing of two edges: the point to which all brightness gradients around it are perpendicular.

use nalgebra::{Matrix2, Vector2};

use super::saddle::FloatImage;

/// Steps smaller than this end the search, pixels.
const SETTLED_PX: f64 = 1e-3;
const MOST_STEPS: usize = 40;
/// How far a window reaches toward the next lines of the board, as a share: beyond it their blurred edges begin.
const CELL_SHARE: f64 = 0.45;

/// The window around a corner.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Window {
    /// Half the side of the square of pixels.
    half: i32,
    /// Converts an offset in pixels to shares of the distance to the next corners along rows and columns.
    cell: Option<Matrix2<f64>>,
}

impl Window {
    /// A square of `reach` pixels to each side.
    pub(super) fn square(reach: f64) -> Self {
        Self { half: reach.round().max(2.0) as i32, cell: None }
    }

    /// The part of it that belongs to this corner alone, where the next ones are at `along` and `across`: squares in a
    /// slanted view are narrow parallelograms, and the edges of their neighbours would displace the result.
    pub(super) fn within(self, along: Vector2<f64>, across: Vector2<f64>) -> Self {
        let basis = Matrix2::from_columns(&[along, across]);
        let reach = (basis.abs() * Vector2::repeat(CELL_SHARE)).max().ceil().max(2.0) as i32;
        Self { half: self.half.min(reach), cell: basis.try_inverse() }
    }

    fn holds(&self, offset: Vector2<f64>) -> bool {
        self.cell.is_none_or(|cell| (cell * offset).amax() <= CELL_SHARE)
    }
}

/// Refines a corner on the unblurred image within a window.
///
/// Solves `Σ w g gᵀ (q − p) = 0` over the window, the point `q` for which each gradient `g` at `p` is perpendicular to
/// `p − q` (Förstner and Gülch 1987), repeatedly around the new point. `None` where the window leaves the image,
/// contains only one edge, or the point moves away.
pub(super) fn refine(image: &FloatImage, start: Vector2<f64>, window: Window) -> Option<Vector2<f64>> {
    let mut at = start;
    for _ in 0..MOST_STEPS {
        let next = step(image, at, window)?;
        let moved = (next - at).norm();
        at = next;
        if (at - start).norm() > f64::from(window.half).max(3.0) {
            return None;
        }
        if moved < SETTLED_PX {
            break;
        }
    }
    Some(at)
}

fn step(image: &FloatImage, at: Vector2<f64>, window: Window) -> Option<Vector2<f64>> {
    let half = window.half;
    let side = (2 * half + 3) as usize;
    let mut patch = vec![0.0; side * side];
    for (k, value) in patch.iter_mut().enumerate() {
        let offset = Vector2::new((k % side) as f64, (k / side) as f64).add_scalar(-f64::from(half + 1));
        *value = image.sample(at + offset)?;
    }
    let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
    for y in 1..side - 1 {
        for x in 1..side - 1 {
            let g = 0.5
                * Vector2::new(
                    patch[y * side + x + 1] - patch[y * side + x - 1],
                    patch[(y + 1) * side + x] - patch[(y - 1) * side + x],
                );
            let p = Vector2::new(x as f64, y as f64).add_scalar(-f64::from(half + 1));
            if !window.holds(p) {
                continue;
            }
            let weight = (-p.norm_squared() / f64::from(half * half)).exp();
            let outer = g * g.transpose() * weight;
            normal += outer;
            right += outer * p;
        }
    }
    let eigen = normal.symmetric_eigenvalues();
    if !(eigen.min() > 1e-3 * eigen.max()) {
        return None;
    }
    Some(at + normal.try_inverse()? * right)
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::GrayImage;

    #[test]
    fn finds_a_rendered_crossing_to_a_few_hundredths() {
        // Two smooth edges through (20.3, 19.6), 70° apart, slightly blurred.
        let truth = Vector2::new(20.3, 19.6);
        let mut image = GrayImage::new(41, 41);
        for v in 0..41 {
            for u in 0..41 {
                let p = Vector2::new(u as f64, v as f64) - truth;
                let across = |angle: f64| (p.x * angle.sin() - p.y * angle.cos()).clamp(-1.0, 1.0);
                let value = 128.0 + 90.0 * across(0.3) * across(0.3 + 70f64.to_radians());
                image.data[v * 41 + u] = value.round() as u8;
            }
        }
        let found = refine(&FloatImage::of(image.view()), Vector2::new(21.5, 18.5), Window::square(7.0))
            .expect("a crossing");
        assert!((found - truth).norm() < 0.03, "{found}");
    }

    #[test]
    fn one_edge_is_no_corner() {
        let mut image = GrayImage::new(41, 41);
        image.data.iter_mut().enumerate().for_each(|(k, p)| *p = if k % 41 > 20 { 200 } else { 20 });
        assert!(
            refine(&FloatImage::of(image.view()), Vector2::new(20.0, 20.0), Window::square(6.0)).is_none()
        );
    }
}
