//! Boards rendered for tests: a chessboard through a distorting lens, with noise and shadow.

use nalgebra::{Rotation3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::PlanePose;
use windhover_base::geo::{CameraModel, ned_from_body_321};
use windhover_base::msg::GrayImage;

/// Subsamples a side of each pixel.
const SUB: usize = 3;
/// Width of the square over which lens and pixel blur, pixels.
const BLUR_PX: f64 = 1.8;

/// A chessboard in front of a camera.
#[derive(Clone)]
pub(crate) struct DrawnBoard {
    pub(crate) camera: CameraModel,
    size: (usize, usize),
    inner: (usize, usize),
    square_m: f64,
    pub(crate) pose: PlanePose,
}

/// Everything on one side of a line is darker.
#[derive(Clone, Copy)]
pub(crate) struct Shadow {
    /// Turns the image's u axis to the line's normal.
    pub(crate) direction: Rotation3<f64>,
    /// How far the line runs from the image's middle, pixels.
    pub(crate) edge_px: f64,
    /// Share of the light left.
    pub(crate) depth: f64,
}

impl DrawnBoard {
    pub(crate) fn new(
        camera: CameraModel,
        size: (usize, usize),
        inner: (usize, usize),
        square_m: f64,
    ) -> Self {
        let pose = PlanePose { rotation: Rotation3::identity(), translation: Vector3::z() };
        Self { camera, size, inner, square_m, pose }
    }

    /// Rotated in the image, tilted, its middle `distance_m` in front of the camera.
    pub(crate) fn posed(mut self, turn: f64, pitch: f64, roll: f64, distance_m: f64) -> Self {
        let rotation = ned_from_body_321(0.0, pitch, roll) * windhover_base::geo::rot_z(turn);
        let span = |n: usize| (n - 1) as f64 * self.square_m / 2.0;
        let middle = Vector3::new(span(self.inner.0), span(self.inner.1), 0.0);
        self.pose = PlanePose { rotation, translation: Vector3::z() * distance_m - rotation * middle };
        self
    }

    pub(crate) fn plane_points(&self) -> Vec<Vector2<f64>> {
        let (columns, rows) = self.inner;
        let at = |k: usize| Vector2::new((k % columns) as f64, (k / columns) as f64) * self.square_m;
        (0..columns * rows).map(at).collect()
    }

    /// True corners, row by row, pixels.
    pub(crate) fn corners(&self) -> Vec<Vector2<f64>> {
        let project = |p: Vector2<f64>| {
            let at = self.pose.rotation * Vector3::new(p.x, p.y, 0.0) + self.pose.translation;
            self.camera.project(&at).expect("boards are drawn in front of the camera").px
        };
        self.plane_points().into_iter().map(project).collect()
    }

    /// The photograph, with two grey levels of noise.
    pub(crate) fn image(&self, shadow: Option<Shadow>) -> GrayImage {
        let (width, height) = self.size;
        let mut image = GrayImage::new(width, height);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for v in 0..height {
            for u in 0..width {
                let mut sum = 0.0;
                for k in 0..SUB * SUB {
                    let inside = |n: usize| ((n as f64 + 0.5) / SUB as f64 - 0.5) * BLUR_PX;
                    sum += self.light(Vector2::new(u as f64 + inside(k % SUB), v as f64 + inside(k / SUB)));
                }
                let mut value = sum / (SUB * SUB) as f64;
                if let Some(s) = shadow {
                    let from_middle =
                        Vector3::new(u as f64 - width as f64 / 2.0, v as f64 - height as f64 / 2.0, 0.0);
                    if (s.direction.inverse() * from_middle).x > s.edge_px {
                        value *= s.depth;
                    }
                }
                let noise: f64 = rng.sample(rand_distr::StandardNormal);
                image.data[v * width + u] = (value + 2.0 * noise).round().clamp(0.0, 255.0) as u8;
            }
        }
        image
    }

    /// Brightness of a point of the image.
    fn light(&self, px: Vector2<f64>) -> f64 {
        let background = 110.0;
        let Some(m) = self.camera.normalised(px) else { return background };
        let ray = self.pose.rotation.inverse() * Vector3::new(m.x, m.y, 1.0);
        let origin = self.pose.rotation.inverse() * -self.pose.translation;
        let at = origin - ray * (origin.z / ray.z);
        let (c, r) = (at.x / self.square_m + 1.0, at.y / self.square_m + 1.0);
        let (columns, rows) = ((self.inner.0 + 1) as f64, (self.inner.1 + 1) as f64);
        let margin = 0.6;
        if c < -margin || r < -margin || c > columns + margin || r > rows + margin {
            return background;
        }
        let on_board = (0.0..columns).contains(&c) && (0.0..rows).contains(&r);
        let dark = on_board && (c.floor() as i64 + r.floor() as i64) % 2 == 0;
        if dark { 35.0 } else { 215.0 }
    }
}
