//! `[camera]`: the device, its format and exposure, its lens and mounting.

use nalgebra::{Rotation3, Vector3};
use serde::{Deserialize, Serialize};

use super::GpioLine;
use crate::geo::{CameraModel, ImageTop, body_from_camera};

/// `[camera]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// V4L2 device.
    pub device: String,
    /// Frame width, pixels.
    pub width: u32,
    /// Frame height, pixels.
    pub height: u32,
    /// Requested frame rate, frames a second.
    pub fps: f64,
    /// Pixel format that is requested from V4L2.
    #[serde(default)]
    pub pixel_format: PixelFormat,
    /// Added to the driver's stamp to get mid-exposure, ms.
    #[serde(default)]
    pub exposure_offset_ms: f64,
    /// Rolling shutter: from the exposure of the first row to that of the last, ms; 0 where all are exposed together. The
    /// driver's stamp with `exposure_offset_ms` is then the middle row's mid-exposure.
    #[serde(default)]
    pub readout_ms: f64,
    /// Fixed exposure, µs; absent: the camera's own automatic exposure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_us: Option<f64>,
    /// Automatic exposure by windhover, never longer than this, µs; instead of `exposure_us`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub auto_max_us: Option<f64>,
    /// Fixed gain in the driver's units; absent: as the camera sets it, or with `auto_max_us` as windhover sets it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<i32>,
    /// A GPIO line that gets the pulses which trigger the camera: frames are counted against them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trigger_line: Option<GpioLine>,
    /// The lens.
    pub intrinsics: CameraModel,
    /// Its mounting.
    #[serde(default)]
    pub mount: CameraMount,
}

/// Supported pixel formats.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
pub enum PixelFormat {
    /// 8-bit grey.
    #[default]
    #[serde(rename = "GREY")]
    Grey,
    /// Packed 4:2:2, Y first.
    #[serde(rename = "YUYV")]
    Yuyv,
    /// Packed 4:2:2, U first.
    #[serde(rename = "UYVY")]
    Uyvy,
    /// Planar 4:2:0, Y then interleaved UV.
    #[serde(rename = "NV12")]
    Nv12,
    /// Motion JPEG.
    #[serde(rename = "MJPG")]
    Mjpg,
    /// 24-bit RGB (V4L2 RGB3).
    #[serde(rename = "RGB24", alias = "RGB3")]
    Rgb24,
    /// 8-bit mosaic of colours, red first; read as grey, with the mosaic filtered out.
    #[serde(rename = "RGGB")]
    Rggb,
    /// The same, blue first (V4L2 BA81).
    #[serde(rename = "BGGR", alias = "BA81")]
    Bggr,
    /// The same, green and blue first.
    #[serde(rename = "GBRG")]
    Gbrg,
    /// The same, green and red first.
    #[serde(rename = "GRBG")]
    Grbg,
    /// Grey of 10 bits in two bytes.
    #[serde(rename = "Y10")]
    Y10,
    /// Grey of 12 bits in two bytes.
    #[serde(rename = "Y12")]
    Y12,
    /// Grey of 16 bits.
    #[serde(rename = "Y16")]
    Y16,
    /// Grey of 10 bits, four pixels in five bytes.
    #[serde(rename = "Y10P")]
    Y10Packed,
}

/// `[camera.mount]`
#[derive(Clone, Copy, PartialEq, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraMount {
    /// The direction on the aircraft to which the top of the image points.
    pub image_top: ImageTop,
    /// Camera in the body frame, forward-right-down, metres.
    pub position_m: [f64; 3],
    /// Small mounting yaw, degrees.
    pub yaw_deg: f64,
    /// Small mounting pitch, degrees.
    pub pitch_deg: f64,
    /// Small mounting roll, degrees.
    pub roll_deg: f64,
}

impl CameraMount {
    /// `body_from_camera` with the mounting angles.
    pub fn body_from_camera(&self) -> Rotation3<f64> {
        body_from_camera(
            self.image_top,
            self.yaw_deg.to_radians(),
            self.pitch_deg.to_radians(),
            self.roll_deg.to_radians(),
        )
    }

    /// Camera position in the body frame, metres.
    pub fn position(&self) -> Vector3<f64> {
        Vector3::from(self.position_m)
    }
}
