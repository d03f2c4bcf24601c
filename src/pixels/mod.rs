//! Pixels from the bytes of a frame, as cameras and captures deliver them.

mod huffman;
mod mosaic;
mod scan;
#[cfg(test)]
mod scan_tests;

pub use scan::MissingPart;

use std::io::Cursor;

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use windhover_base::msg::{FrameEncoding, FramePayload, GrayImage, RgbImage};

/// A frame in memory.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct DecodedFrame {
    /// Grey levels: the luma of colour formats.
    pub gray: GrayImage,
    /// Colours, where requested and where the format has them.
    pub rgb: Option<RgbImage>,
    /// Lost parts, which are grey in the picture. The rest is as the camera took it.
    pub missing: Vec<MissingPart>,
}

impl DecodedFrame {
    /// Whether the area between these columns and rows, `margin_px` wider, has no lost part.
    pub fn is_whole(&self, from: (f64, f64), to: (f64, f64), margin_px: f64) -> bool {
        !self.missing.iter().any(|part| {
            let (part_from, part_to) = (part.from, part.to);
            let apart = |low: f64, high: f64, part_low: usize, part_high: usize| {
                high + margin_px < part_low as f64 || low - margin_px > part_high as f64 - 1.0
            };
            !apart(from.0, to.0, part_from.0, part_to.0) && !apart(from.1, to.1, part_from.1, part_to.1)
        })
    }
}

/// Why a frame cannot be used.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum FrameFault {
    /// An encoding that is not supported.
    #[error("its encoding is not supported")]
    UnknownEncoding,
    /// The bytes are not valid in the encoding.
    #[error("its {encoding:?} bytes are damaged: {reason}")]
    Damaged {
        /// The stated encoding.
        encoding: FrameEncoding,
        /// What is wrong.
        reason: String,
    },
    /// Fewer bytes than width, height and stride require, or a stride shorter than a row.
    #[error("{got} bytes are not {width}x{height} {encoding:?} with rows {stride} bytes apart")]
    Size {
        /// Bytes there are.
        got: usize,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes from row to row.
        stride: u32,
        /// Encoding.
        encoding: FrameEncoding,
    },
    /// Not the size for which the configuration has intrinsics.
    #[error("it is {got_width}x{got_height}, the configuration has {want_width}x{want_height}")]
    Unexpected {
        /// Columns there are.
        got_width: usize,
        /// Rows there are.
        got_height: usize,
        /// Columns configured.
        want_width: usize,
        /// Rows configured.
        want_height: usize,
    },
}

/// Largest side of a frame, pixels: a larger one in a header is damage.
const LARGEST_SIDE: usize = 16_384;

/// Decodes a frame; with `want_rgb` also its colours.
pub fn decode(frame: &FramePayload, want_rgb: bool) -> Result<DecodedFrame, FrameFault> {
    match frame.encoding {
        FrameEncoding::Jpeg => jpeg(frame, want_rgb),
        FrameEncoding::Png => png(frame, want_rgb),
        FrameEncoding::Unknown => Err(FrameFault::UnknownEncoding),
        _ => raw(frame, want_rgb),
    }
}

/// Refuses a frame that is not of the configured size.
pub fn check_size(frame: &DecodedFrame, width: u32, height: u32) -> Result<(), FrameFault> {
    let (got_width, got_height) = (frame.gray.width, frame.gray.height);
    let (want_width, want_height) = (width as usize, height as usize);
    if (got_width, got_height) == (want_width, want_height) {
        return Ok(());
    }
    Err(FrameFault::Unexpected { got_width, got_height, want_width, want_height })
}

fn damaged(encoding: FrameEncoding, reason: impl std::fmt::Display) -> FrameFault {
    FrameFault::Damaged { encoding, reason: reason.to_string() }
}

/// Grey levels of a picture in a file, whatever the extension of its name, and its lost parts.
pub fn picture(bytes: &[u8]) -> Result<(GrayImage, Vec<MissingPart>), String> {
    let format = image::guess_format(bytes).map_err(|e| e.to_string())?;
    let checked = match format {
        image::ImageFormat::Jpeg => scan::checked(bytes)?,
        _ => scan::Checked { bytes: bytes.into(), missing: Vec::new() },
    };
    let decoded = image::load_from_memory_with_format(&checked.bytes, format).map_err(|e| e.to_string())?;
    let luma = decoded.into_luma8();
    let (width, height) = (luma.width() as usize, luma.height() as usize);
    let gray = GrayImage::from_vec(width, height, luma.into_raw()).ok_or("it has no pixels")?;
    Ok((gray, checked.missing))
}

/// Decodes once: to luma alone, or where colours are wanted and exist to luma and chroma.
fn jpeg(frame: &FramePayload, want_rgb: bool) -> Result<DecodedFrame, FrameFault> {
    let fault = |e: zune_jpeg::errors::DecodeErrors| damaged(FrameEncoding::Jpeg, format!("{e:?}"));
    let options = DecoderOptions::default().set_max_width(LARGEST_SIDE).set_max_height(LARGEST_SIDE);
    let scan::Checked { bytes, missing } =
        scan::checked(&frame.data).map_err(|reason| damaged(FrameEncoding::Jpeg, reason))?;
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(&bytes[..]), options);
    decoder.decode_headers().map_err(fault)?;
    let with_chroma = want_rgb && decoder.input_colorspace() == Some(ColorSpace::YCbCr);
    let space = if with_chroma { ColorSpace::YCbCr } else { ColorSpace::Luma };
    decoder.set_options(options.jpeg_set_out_colorspace(space));
    let mut pixels = decoder.decode().map_err(fault)?;
    let (width, height) =
        decoder.dimensions().ok_or_else(|| damaged(FrameEncoding::Jpeg, "it has no size"))?;
    let short = || damaged(FrameEncoding::Jpeg, "it has fewer pixels than its header states");
    if !with_chroma {
        let gray = GrayImage::from_vec(width, height, pixels).ok_or_else(short)?;
        return Ok(DecodedFrame { gray, rgb: None, missing });
    }
    if pixels.len() != 3 * width * height {
        return Err(short());
    }
    let luma = pixels.chunks_exact(3).map(|p| p[0]).collect();
    let gray = GrayImage::from_vec(width, height, luma).ok_or_else(short)?;
    pixels.chunks_exact_mut(3).for_each(|p| p.copy_from_slice(&yuv(p[0], p[1], p[2])));
    Ok(DecodedFrame { gray, rgb: Some(RgbImage { width, height, data: pixels }), missing })
}

fn png(frame: &FramePayload, want_rgb: bool) -> Result<DecodedFrame, FrameFault> {
    let fault = |e: image::ImageError| damaged(FrameEncoding::Png, e);
    let mut reader = image::ImageReader::with_format(Cursor::new(&frame.data[..]), image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(LARGEST_SIDE as u32);
    limits.max_image_height = Some(LARGEST_SIDE as u32);
    reader.limits(limits);
    let decoded = reader.decode().map_err(fault)?;
    let rgb = (want_rgb && decoded.color().has_color()).then(|| {
        let rgb = decoded.to_rgb8();
        RgbImage { width: rgb.width() as usize, height: rgb.height() as usize, data: rgb.into_raw() }
    });
    let luma = decoded.into_luma8();
    let (width, height) = (luma.width() as usize, luma.height() as usize);
    let gray = GrayImage::from_vec(width, height, luma.into_raw())
        .ok_or_else(|| damaged(FrameEncoding::Png, "it has fewer pixels than its header states"))?;
    Ok(DecodedFrame { gray, rgb, missing: Vec::new() })
}

/// Bytes of a row of pixels, and rows of bytes for `height` rows of pixels.
fn raw_layout(encoding: FrameEncoding, width: usize, height: usize) -> (usize, usize) {
    match encoding {
        FrameEncoding::Yuyv | FrameEncoding::Uyvy => (2 * width, height),
        FrameEncoding::Nv12 => (width, height + height.div_ceil(2)),
        FrameEncoding::Rgb24 | FrameEncoding::Bgr24 => (3 * width, height),
        FrameEncoding::Y10 | FrameEncoding::Y12 | FrameEncoding::Y16 => (2 * width, height),
        FrameEncoding::Y10Packed => (width.div_ceil(4) * 5, height),
        _ => (width, height),
    }
}

fn raw(frame: &FramePayload, want_rgb: bool) -> Result<DecodedFrame, FrameFault> {
    let (width, height, encoding) = (frame.width as usize, frame.height as usize, frame.encoding);
    let wrong_size = FrameFault::Size {
        got: frame.data.len(),
        width: frame.width,
        height: frame.height,
        stride: frame.stride,
        encoding,
    };
    if width == 0 || height == 0 || width > LARGEST_SIDE || height > LARGEST_SIDE {
        return Err(wrong_size);
    }
    let (row_bytes, rows) = raw_layout(encoding, width, height);
    let stride = if frame.stride == 0 { row_bytes } else { frame.stride as usize };
    if stride < row_bytes || frame.data.len() < stride.saturating_mul(rows - 1) + row_bytes {
        return Err(wrong_size);
    }
    if let FrameEncoding::Bayer(order) = encoding {
        let rows = mosaic::Rows { data: &frame.data, stride, width, height };
        let rgb = want_rgb.then(|| rows.colours(order));
        return Ok(DecodedFrame { gray: rows.grey(), rgb, missing: Vec::new() });
    }
    let row = |v: usize| &frame.data[v * stride..v * stride + row_bytes];
    let mut gray = GrayImage::new(width, height);
    for (v, out) in gray.data.chunks_exact_mut(width).enumerate() {
        luma_row(encoding, row(v), out);
    }
    let rgb = (want_rgb && has_colour(encoding)).then(|| {
        let mut data = Vec::with_capacity(3 * width * height);
        for v in 0..height {
            let chroma = if encoding == FrameEncoding::Nv12 { row(height + v / 2) } else { &[] };
            (0..width).for_each(|u| data.extend(rgb_at(encoding, row(v), chroma, u)));
        }
        RgbImage { width, height, data }
    });
    Ok(DecodedFrame { gray, rgb, missing: Vec::new() })
}

fn luma_row(encoding: FrameEncoding, row: &[u8], out: &mut [u8]) {
    match encoding {
        FrameEncoding::Yuyv => out.iter_mut().zip(row.iter().step_by(2)).for_each(|(o, y)| *o = *y),
        FrameEncoding::Uyvy => out.iter_mut().zip(row.iter().skip(1).step_by(2)).for_each(|(o, y)| *o = *y),
        FrameEncoding::Rgb24 => {
            out.iter_mut().zip(row.chunks_exact(3)).for_each(|(o, p)| *o = luma(p[0], p[1], p[2]));
        }
        FrameEncoding::Bgr24 => {
            out.iter_mut().zip(row.chunks_exact(3)).for_each(|(o, p)| *o = luma(p[2], p[1], p[0]));
        }
        FrameEncoding::Y10 => upper_eight(row, out, 2),
        FrameEncoding::Y12 => upper_eight(row, out, 4),
        FrameEncoding::Y16 => upper_eight(row, out, 8),
        FrameEncoding::Y10Packed => {
            let pixels = row.chunks_exact(5).flat_map(|group| &group[..4]);
            out.iter_mut().zip(pixels).for_each(|(o, y)| *o = *y);
        }
        _ => out.copy_from_slice(&row[..out.len()]),
    }
}

/// The upper eight of a pixel's bits, which are in two bytes; bits above them saturate.
fn upper_eight(row: &[u8], out: &mut [u8], below: u32) {
    for (o, pair) in out.iter_mut().zip(row.chunks_exact(2)) {
        *o = (u16::from_le_bytes([pair[0], pair[1]]) >> below).min(255) as u8;
    }
}

/// Whether a format that is not a mosaic has colours.
const fn has_colour(encoding: FrameEncoding) -> bool {
    matches!(
        encoding,
        FrameEncoding::Yuyv
            | FrameEncoding::Uyvy
            | FrameEncoding::Nv12
            | FrameEncoding::Rgb24
            | FrameEncoding::Bgr24
    )
}

/// Luma of ITU-R BT.601 in 1/256: 0.299 R + 0.587 G + 0.114 B, rounded.
fn luma(r: u8, g: u8, b: u8) -> u8 {
    ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8
}

fn rgb_at(encoding: FrameEncoding, row: &[u8], chroma: &[u8], u: usize) -> [u8; 3] {
    let pair = u / 2 * 4;
    let at = |bytes: &[u8], i: usize| bytes.get(i).copied().unwrap_or(128);
    match encoding {
        FrameEncoding::Rgb24 => [row[3 * u], row[3 * u + 1], row[3 * u + 2]],
        FrameEncoding::Bgr24 => [row[3 * u + 2], row[3 * u + 1], row[3 * u]],
        FrameEncoding::Yuyv => yuv(row[2 * u], at(row, pair + 1), at(row, pair + 3)),
        FrameEncoding::Uyvy => yuv(row[2 * u + 1], at(row, pair), at(row, pair + 2)),
        _ => yuv(row[u], at(chroma, u / 2 * 2), at(chroma, u / 2 * 2 + 1)),
    }
}

/// Full-range BT.601, as in JPEG and most webcams.
fn yuv(y: u8, cb: u8, cr: u8) -> [u8; 3] {
    let (y, cb, cr) = (f32::from(y), f32::from(cb) - 128.0, f32::from(cr) - 128.0);
    let clamp = |x: f32| x.round().clamp(0.0, 255.0) as u8;
    [clamp(y + 1.402 * cr), clamp(y - 0.344_14 * cb - 0.714_14 * cr), clamp(y + 1.772 * cb)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::time::MonoTime;

    fn payload(encoding: FrameEncoding, width: u32, height: u32, stride: u32, data: Vec<u8>) -> FramePayload {
        let t_exposure = MonoTime::default();
        FramePayload { index: 0, t_exposure, encoding, width, height, stride, data: data.into() }
    }

    #[test]
    fn packed_formats_give_their_luma() {
        let yuyv = payload(FrameEncoding::Yuyv, 2, 1, 0, vec![10, 128, 20, 128]);
        assert_eq!(decode(&yuyv, false).unwrap().gray.data, [10, 20]);
        let uyvy = payload(FrameEncoding::Uyvy, 2, 1, 4, vec![128, 10, 128, 20]);
        assert_eq!(decode(&uyvy, true).unwrap().rgb.unwrap().data, [10, 10, 10, 20, 20, 20]);
        let nv12 = payload(FrameEncoding::Nv12, 2, 2, 0, vec![1, 2, 3, 4, 128, 128]);
        assert_eq!(decode(&nv12, false).unwrap().gray.data, [1, 2, 3, 4]);
        let y10 = payload(FrameEncoding::Y10, 2, 1, 6, vec![0xff, 0x03, 0x04, 0x02, 9, 9]);
        assert_eq!(decode(&y10, true).unwrap().gray.data, [255, 129]);
        let y12 = payload(FrameEncoding::Y12, 2, 1, 0, vec![0xff, 0x0f, 0x10, 0x08]);
        assert_eq!(decode(&y12, false).unwrap().gray.data, [255, 129]);
        let y16 = payload(FrameEncoding::Y16, 2, 1, 0, vec![0xff, 0x7f, 0, 3]);
        assert_eq!(decode(&y16, false).unwrap().gray.data, [127, 3]);
        let y10p = payload(FrameEncoding::Y10Packed, 6, 1, 0, vec![1, 2, 3, 4, 0xff, 5, 6, 7, 8, 0xff]);
        assert_eq!(decode(&y10p, false).unwrap().gray.data, [1, 2, 3, 4, 5, 6]);
        let padded = payload(FrameEncoding::Grey, 2, 2, 3, vec![1, 2, 99, 3, 4]);
        assert_eq!(decode(&padded, false).unwrap().gray.data, [1, 2, 3, 4]);
    }

    #[test]
    fn red_stays_red_in_every_colour_format() {
        let rgb = payload(FrameEncoding::Rgb24, 1, 1, 0, vec![250, 10, 10]);
        assert_eq!(decode(&rgb, true).unwrap().rgb.unwrap().data, [250, 10, 10]);
        let bgr = payload(FrameEncoding::Bgr24, 1, 1, 0, vec![10, 10, 250]);
        assert_eq!(decode(&bgr, true).unwrap().rgb.unwrap().data, [250, 10, 10]);
        let red =
            decode(&payload(FrameEncoding::Nv12, 2, 2, 0, vec![81, 81, 81, 81, 90, 240]), true).unwrap();
        let data = red.rgb.unwrap().data;
        assert!(data[0] > 200 && data[1] < 40 && data[2] < 40, "{data:?}");
    }

    #[test]
    fn a_coloured_jpeg_has_the_same_luma_with_and_without_its_colours() {
        let (width, height) = (64, 48);
        let pixels: Vec<u8> = (0..width * height)
            .flat_map(|i| if i % width < 32 { [200, 30, 30] } else { [40, (i / width * 4) as u8, 160] })
            .collect();
        let data = crate::jpeg::encode(&pixels, crate::jpeg::Layout::Rgb, (width, height), 95).unwrap();
        let frame = payload(FrameEncoding::Jpeg, 0, 0, 0, data);
        let (plain, coloured) = (decode(&frame, false).unwrap(), decode(&frame, true).unwrap());
        assert_eq!(plain.gray, coloured.gray);
        assert_eq!(plain.rgb, None);
        let rgb = coloured.rgb.unwrap();
        let at = 3 * (20 * width + 10);
        for (seen, drawn) in rgb.data[at..at + 3].iter().zip([200i32, 30, 30]) {
            assert!((i32::from(*seen) - drawn).abs() < 12, "{:?}", &rgb.data[at..at + 3]);
        }
    }

    #[test]
    fn short_and_damaged_frames_are_reported() {
        let short = payload(FrameEncoding::Grey, 640, 480, 640, vec![0; 100]);
        assert!(decode(&short, false).unwrap_err().to_string().contains("100 bytes are not 640x480"));
        for encoding in [FrameEncoding::Jpeg, FrameEncoding::Png, FrameEncoding::Unknown] {
            assert!(decode(&payload(encoding, 0, 0, 0, vec![0xff, 0xd8, 0xff, 1, 2]), false).is_err());
            assert!(decode(&payload(encoding, 0, 0, 0, Vec::new()), false).is_err());
        }
    }
}
