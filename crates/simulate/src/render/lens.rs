//! The ray of every pixel, worked out once for a camera.

use nalgebra::Vector2;

use windhover_base::settings::CameraConfig;

/// Undistorted normalised coordinates of every pixel, row by row.
#[derive(Clone, Debug)]
pub(super) struct Lens {
    pub(super) width: usize,
    pub(super) height: usize,
    rays: Vec<[f32; 2]>,
    /// Change of the normalised coordinates over a pixel, at the centre.
    pub(super) per_px: (f32, f32),
}

impl Lens {
    pub(super) fn new(camera: &CameraConfig) -> Self {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let model = &camera.intrinsics;
        let mut rays = Vec::with_capacity(width * height);
        for v in 0..height {
            // Beyond the fold of the distortion polynomial, the last good ray of the row stands in.
            let mut last = [0.0, ((v as f64 - model.cy) / model.fy) as f32];
            for u in 0..width {
                if let Some(m) = model.normalised(Vector2::new(u as f64, v as f64)) {
                    last = [m.x as f32, m.y as f32];
                }
                rays.push(last);
            }
        }
        Self { width, height, rays, per_px: (1.0 / model.fx as f32, 1.0 / model.fy as f32) }
    }

    /// The rays of a row.
    pub(super) fn row(&self, v: usize) -> &[[f32; 2]] {
        &self.rays[v * self.width..(v + 1) * self.width]
    }

    /// The ray of a point `(du, dv)` pixels from a pixel's centre, to first order with the slope
    /// between the neighbouring pixels (exact to 10⁻⁴ px for ordinary lenses).
    pub(super) fn near(&self, u: usize, v: usize, du: f32, dv: f32) -> [f32; 2] {
        let at = |u: usize, v: usize| self.rays[v * self.width + u];
        let (u0, u1) = (u.saturating_sub(1), (u + 1).min(self.width - 1));
        let (v0, v1) = (v.saturating_sub(1), (v + 1).min(self.height - 1));
        let (here, left, right, above, below) = (at(u, v), at(u0, v), at(u1, v), at(u, v0), at(u, v1));
        let (su, sv) = (du / (u1 - u0).max(1) as f32, dv / (v1 - v0).max(1) as f32);
        std::array::from_fn(|i| here[i] + su * (right[i] - left[i]) + sv * (below[i] - above[i]))
    }
}
