//! Recorded video: frames as configured, encoded outside of the pipeline.

use std::borrow::Cow;
use std::sync::Arc;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::format::Compression;
use crate::config::{FramePolicy, StoreConfig};
use crate::jpeg::{self, Layout};
use crate::pixels;
use windhover_base::msg::{FrameEncoding, FramePayload};

/// Grey level outside the recorded region.
const BLANK: u8 = 128;

/// A rectangle of an image, pixels; the last column and row are left out.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Region {
    /// First column.
    pub u0: u32,
    /// First row.
    pub v0: u32,
    /// Column after the last.
    pub u1: u32,
    /// Row after the last.
    pub v1: u32,
}

impl Region {
    /// The smallest region around pixels `(u, v)`, widened by `margin_px`; `None` without pixels.
    pub fn around(pixels: impl IntoIterator<Item = (f64, f64)>, margin_px: u32) -> Option<Self> {
        let mut bounds: Option<(f64, f64, f64, f64)> = None;
        for (u, v) in pixels {
            let (u0, v0, u1, v1) = bounds.unwrap_or((u, v, u, v));
            bounds = Some((u0.min(u), v0.min(v), u1.max(u), v1.max(v)));
        }
        let (u0, v0, u1, v1) = bounds?;
        let margin = f64::from(margin_px);
        let pixel = |value: f64| value.max(0.0) as u32;
        Some(Self {
            u0: pixel((u0 - margin).floor()),
            v0: pixel((v0 - margin).floor()),
            u1: pixel((u1 + margin).ceil() + 1.0),
            v1: pixel((v1 + margin).ceil() + 1.0),
        })
    }
}

/// Selects the recorded frames and encodes them.
#[derive(Clone, Debug)]
pub struct FrameKeeper {
    policy: FramePolicy,
    every: u32,
    quality: u8,
}

impl FrameKeeper {
    /// For this configuration.
    pub fn new(config: &StoreConfig) -> Self {
        Self { policy: config.frames, every: config.frames_every.max(1), quality: config.jpeg_quality }
    }

    /// Compression of chunks of frames: compressed frames are not compressed again.
    pub fn chunk_compression(&self) -> Compression {
        match self.policy {
            FramePolicy::Zstd => Compression::Zstd,
            _ => Compression::None,
        }
    }

    /// The frame as it is to be stored; `None` where it is not stored. A frame that cannot be encoded is stored
    /// unchanged.
    pub fn keep(&self, frame: &FramePayload, region: Option<Region>) -> Option<FramePayload> {
        if self.policy == FramePolicy::None || !frame.index.is_multiple_of(self.every) {
            return None;
        }
        let encoded = match self.policy {
            FramePolicy::Jpeg => self.jpeg(frame, None),
            FramePolicy::Region => self.jpeg(frame, region),
            FramePolicy::Png => png(frame),
            FramePolicy::Zstd | FramePolicy::None => None,
        };
        let Some((encoding, data)) = encoded else { return Some(frame.clone()) };
        Some(FramePayload { encoding, data: Arc::from(data), ..frame.clone() })
    }

    fn jpeg(&self, frame: &FramePayload, region: Option<Region>) -> Option<(FrameEncoding, Vec<u8>)> {
        let (layout, pixels) = packed(frame)?;
        let pixels = match region {
            Some(region) => blank_outside(&pixels, layout, frame, region).into(),
            None => pixels,
        };
        let size = (frame.width as usize, frame.height as usize);
        Some((FrameEncoding::Jpeg, jpeg::encode(&pixels, layout, size, self.quality).ok()?))
    }
}

/// Rows without gaps, as the JPEG encoder needs them; `None` for frames that are already compressed, not supported, or
/// too short.
fn packed(frame: &FramePayload) -> Option<(Layout, Cow<'_, [u8]>)> {
    let (layout, channels) = match frame.encoding {
        FrameEncoding::Grey => (Layout::Grey, 1),
        FrameEncoding::Rgb24 => (Layout::Rgb, 3),
        FrameEncoding::Bgr24 => (Layout::Bgr, 3),
        FrameEncoding::Yuyv => return Some((Layout::Yuv422, yuv422(frame, [0, 1, 3])?.into())),
        FrameEncoding::Uyvy => return Some((Layout::Yuv422, yuv422(frame, [1, 0, 2])?.into())),
        FrameEncoding::Nv12 => return Some((Layout::Yuv420, nv12(frame)?.into())),
        // As the detector uses them: the colours of a mosaic are coarser than its grey.
        FrameEncoding::Bayer(_)
        | FrameEncoding::Y10
        | FrameEncoding::Y12
        | FrameEncoding::Y16
        | FrameEncoding::Y10Packed => {
            return Some((Layout::Grey, pixels::decode(frame, false).ok()?.gray.data.into()));
        }
        FrameEncoding::Jpeg | FrameEncoding::Png | FrameEncoding::Unknown => return None,
    };
    let (row, height) = (frame.width as usize * channels, frame.height as usize);
    let stride = stride_of(frame, row)?;
    if stride == row {
        return Some((layout, frame.data.get(..row * height)?.into()));
    }
    let mut pixels = Vec::with_capacity(row * height);
    for v in 0..height {
        pixels.extend_from_slice(frame.data.get(v * stride..v * stride + row)?);
    }
    Some((layout, pixels.into()))
}

fn stride_of(frame: &FramePayload, row: usize) -> Option<usize> {
    let stride = if frame.stride == 0 { row } else { frame.stride as usize };
    (stride >= row && row > 0 && frame.height > 0).then_some(stride)
}

/// Interleaved 4:2:2 to planes. `order`: places of the first Y, U and V in each group of four; the second Y is two
/// after the first.
fn yuv422(frame: &FramePayload, [y, u, v]: [usize; 3]) -> Option<Vec<u8>> {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let row = width.next_multiple_of(2) * 2;
    let stride = stride_of(frame, row)?;
    let mut out = vec![0; Layout::Yuv422.bytes(width, height)];
    let (luma, color) = out.split_at_mut(row / 2 * height);
    let (blue, red) = color.split_at_mut(row / 4 * height);
    for line in 0..height {
        let packed = frame.data.get(line * stride..line * stride + row)?;
        let luma = luma[line * row / 2..(line + 1) * row / 2].chunks_exact_mut(2);
        let colors = blue.iter_mut().zip(red.iter_mut()).skip(line * row / 4);
        for ((pair, luma), (blue, red)) in packed.chunks_exact(4).zip(luma).zip(colors) {
            luma.copy_from_slice(&[pair[y], pair[y + 2]]);
            (*blue, *red) = (pair[u], pair[v]);
        }
    }
    Some(out)
}

/// 4:2:0 with interleaved colour to planes.
fn nv12(frame: &FramePayload) -> Option<Vec<u8>> {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let stride = stride_of(frame, width.next_multiple_of(2))?;
    let (across, down) = (width.div_ceil(2), height.div_ceil(2));
    let mut out = Vec::with_capacity(Layout::Yuv420.bytes(width, height));
    for v in 0..2 * down {
        let start = v.min(height - 1) * stride;
        out.extend_from_slice(frame.data.get(start..start + 2 * across)?);
    }
    for channel in 0..2 {
        for v in height..height + down {
            let row = frame.data.get(v * stride..v * stride + 2 * across)?;
            out.extend(row.chunks_exact(2).map(|pair| pair[channel]));
        }
    }
    Some(out)
}

fn blank_outside(pixels: &[u8], layout: Layout, frame: &FramePayload, region: Region) -> Vec<u8> {
    let mut out = vec![BLANK; pixels.len()];
    let mut start = 0;
    for plane in layout.planes(frame.width as usize, frame.height as usize) {
        let samples = |from: u32, to: u32, step: usize, all: usize| {
            let to = (to as usize).div_ceil(step).min(all);
            (from as usize / step).min(to)..to
        };
        let (row, columns) =
            (plane.width * plane.channels, samples(region.u0, region.u1, plane.step.0, plane.width));
        for v in samples(region.v0, region.v1, plane.step.1, plane.height) {
            let line = start + v * row;
            let part = line + columns.start * plane.channels..line + columns.end * plane.channels;
            out[part.clone()].copy_from_slice(&pixels[part]);
        }
        start += plane.bytes();
    }
    out
}

/// PNG at its fastest; `None` where the format has no lossless PNG.
fn png(frame: &FramePayload) -> Option<(FrameEncoding, Vec<u8>)> {
    let color = match frame.encoding {
        FrameEncoding::Grey => ExtendedColorType::L8,
        FrameEncoding::Rgb24 => ExtendedColorType::Rgb8,
        _ => return None,
    };
    let (_, pixels) = packed(frame)?;
    let mut out = Vec::with_capacity(pixels.len());
    PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Up)
        .write_image(&pixels, frame.width, frame.height, color)
        .ok()?;
    Some((FrameEncoding::Png, out))
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::time::MonoTime;

    fn frame(encoding: FrameEncoding, width: u32, height: u32, stride: u32, data: Vec<u8>) -> FramePayload {
        let t_exposure = MonoTime::from_ns(1);
        FramePayload { index: 0, t_exposure, encoding, width, height, stride, data: Arc::from(data) }
    }

    /// A smooth picture, which JPEG preserves well.
    fn smooth(width: usize, height: usize, stride: usize) -> Vec<u8> {
        let mut data = vec![0; stride * height];
        for v in 0..height {
            for u in 0..width {
                data[v * stride + u] = (40 + u + 2 * v) as u8;
            }
        }
        data
    }

    fn keeper(frames: FramePolicy) -> FrameKeeper {
        FrameKeeper::new(&StoreConfig { frames, ..StoreConfig::default() })
    }

    fn decoded(frame: &FramePayload) -> image::GrayImage {
        image::load_from_memory(&frame.data).expect("decodes").to_luma8()
    }

    #[test]
    fn grey_survives_jpeg_and_png_with_padded_rows() {
        let given = frame(FrameEncoding::Grey, 64, 32, 80, smooth(64, 32, 80));
        for (policy, tolerance) in [(FramePolicy::Jpeg, 4), (FramePolicy::Png, 0)] {
            let kept = decoded(&keeper(policy).keep(&given, None).expect("kept"));
            for (u, v, pixel) in kept.enumerate_pixels() {
                let true_value = 40 + u as i32 + 2 * v as i32;
                assert!((i32::from(pixel.0[0]) - true_value).abs() <= tolerance, "{policy:?} at {u},{v}");
            }
        }
    }

    #[test]
    fn yuyv_and_uyvy_keep_their_luma() {
        let grey = smooth(16, 8, 16);
        let yuyv: Vec<u8> = grey.iter().flat_map(|y| [*y, 128]).collect();
        let uyvy: Vec<u8> = grey.iter().flat_map(|y| [128, *y]).collect();
        let mut nv12 = grey.clone();
        nv12.extend_from_slice(&[128; 64]);
        let cases = [
            (FrameEncoding::Yuyv, yuyv, 32),
            (FrameEncoding::Uyvy, uyvy, 32),
            (FrameEncoding::Nv12, nv12, 16),
        ];
        for (encoding, data, stride) in cases {
            let kept =
                keeper(FramePolicy::Jpeg).keep(&frame(encoding, 16, 8, stride, data), None).expect("kept");
            assert_eq!(kept.encoding, FrameEncoding::Jpeg);
            let kept = decoded(&kept);
            for (u, v, pixel) in kept.enumerate_pixels() {
                assert!((i32::from(pixel.0[0]) - (40 + u as i32 + 2 * v as i32)).abs() <= 5, "{encoding:?}");
            }
        }
    }

    #[test]
    fn the_region_is_kept_and_the_rest_is_blank() {
        let given = frame(FrameEncoding::Grey, 64, 64, 64, vec![250; 64 * 64]);
        let region = Region::around([(40.0, 40.0), (44.0, 42.0)], 8);
        assert_eq!(region, Some(Region { u0: 32, v0: 32, u1: 53, v1: 51 }));
        let kept = decoded(&keeper(FramePolicy::Region).keep(&given, region).expect("kept"));
        assert!(kept.get_pixel(42, 41).0[0] > 240);
        assert!((i32::from(kept.get_pixel(4, 4).0[0]) - 128).abs() < 4);
        let whole = decoded(&keeper(FramePolicy::Region).keep(&given, None).expect("kept"));
        assert!(whole.get_pixel(4, 4).0[0] > 240, "no vehicle is known: everything is recorded");
    }

    #[test]
    fn compressed_and_unusable_frames_stay_as_they_are() {
        let jpeg = frame(FrameEncoding::Jpeg, 0, 0, 0, vec![0xFF, 0xD8, 1, 2, 3]);
        let short = frame(FrameEncoding::Grey, 64, 64, 64, vec![0; 10]);
        for policy in [FramePolicy::Jpeg, FramePolicy::Png, FramePolicy::Region, FramePolicy::Zstd] {
            for given in [&jpeg, &short] {
                let kept = keeper(policy).keep(given, None).expect("kept");
                assert_eq!((kept.encoding, &kept.data), (given.encoding, &given.data));
            }
        }
        assert!(keeper(FramePolicy::None).keep(&jpeg, None).is_none());
        let every = FrameKeeper::new(&StoreConfig { frames_every: 3, ..StoreConfig::default() });
        let kept = (0..9).filter(|i| every.keep(&FramePayload { index: *i, ..jpeg.clone() }, None).is_some());
        assert_eq!(kept.collect::<Vec<_>>(), [0, 3, 6]);
    }
}
