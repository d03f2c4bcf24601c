//! Photographs of a flat sheet by a camera whose lens is known: for tests.

use nalgebra::{Rotation3, Vector2, Vector3};

use windhover_base::geo::{CameraModel, LensModel};
use windhover_base::msg::GrayImage;

/// The camera, of 640×480 pixels.
pub(crate) fn camera() -> CameraModel {
    CameraModel {
        fx: 640.0,
        fy: 636.0,
        cx: 324.0,
        cy: 238.0,
        model: LensModel::Brown,
        distortion: [-0.2, 0.05, 0.0005, -0.0005, 0.0],
        skew: 0.0,
    }
}

/// The sheet as [`camera`] sees it: `camera = rotation · sheet + translation`. A pixel is the mean of rays through
/// `aside.len()` squared points of it, offsets in pixels; `is_dark` is asked for points of the sheet, m.
pub(crate) fn photograph(
    rotation: &Rotation3<f64>,
    translation: &Vector3<f64>,
    aside: &[f64],
    is_dark: impl Fn(Vector2<f64>) -> bool,
) -> GrayImage {
    let camera = camera();
    let origin = rotation.inverse() * -translation;
    let mut image = GrayImage::new(640, 480);
    for v in 0..480 {
        for u in 0..640 {
            let mut light = 0.0;
            for (dv, du) in aside.iter().flat_map(|dv| aside.iter().map(move |du| (dv, du))) {
                let px = Vector2::new(u as f64 + du, v as f64 + dv);
                let m = camera.normalised(px).expect("inside the lens");
                let ray = rotation.inverse() * m.push(1.0);
                let at = origin - ray * (origin.z / ray.z);
                light += if is_dark(at.xy()) { 30.0 } else { 220.0 };
            }
            image.data[v * 640 + u] = (light / aside.len().pow(2) as f64) as u8;
        }
    }
    image
}
