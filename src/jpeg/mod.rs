//! Pictures to JPEG, in the colour formats of cameras without conversion: chroma is neither interpolated nor reduced.

use turbojpeg::{Compressor, Image, PixelFormat, Subsamp, YuvImage};
use windhover_base::msg::GrayImage;

/// Format of a picture's bytes, row after row without gaps.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Layout {
    /// One byte for each pixel.
    Grey,
    /// Red, green, blue.
    Rgb,
    /// Blue, green, red.
    Bgr,
    /// Planes Y, U, V; one colour for two pixels of a row.
    Yuv422,
    /// Planes Y, U, V; one colour for a block of 2×2 pixels.
    Yuv420,
}

/// One plane of a picture.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Plane {
    /// Bytes of a sample.
    pub channels: usize,
    /// Samples of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels of the picture from one sample to the next, along and across rows.
    pub step: (usize, usize),
}

impl Plane {
    /// Bytes of the plane.
    pub fn bytes(&self) -> usize {
        self.channels * self.width * self.height
    }
}

impl Layout {
    /// The planes of a picture of `width` by `height` pixels, in the order of its bytes. Where colour is subsampled,
    /// the first plane is padded to whole blocks.
    pub fn planes(self, width: usize, height: usize) -> Vec<Plane> {
        let plane = |channels, step| Plane { channels, width, height, step };
        let subsampled = |(across, down): (usize, usize)| {
            let (columns, rows) = (width.div_ceil(across), height.div_ceil(down));
            let luma = Plane { channels: 1, width: columns * across, height: rows * down, step: (1, 1) };
            let color = Plane { channels: 1, width: columns, height: rows, step: (across, down) };
            vec![luma, color, color]
        };
        match self {
            Layout::Grey => vec![plane(1, (1, 1))],
            Layout::Rgb | Layout::Bgr => vec![plane(3, (1, 1))],
            Layout::Yuv422 => subsampled((2, 1)),
            Layout::Yuv420 => subsampled((2, 2)),
        }
    }

    /// Bytes of a picture of `width` by `height` pixels.
    pub fn bytes(self, width: usize, height: usize) -> usize {
        self.planes(width, height).iter().map(Plane::bytes).sum()
    }
}

/// Why a picture cannot be made into JPEG.
#[derive(Debug, thiserror::Error)]
pub enum JpegError {
    /// The number of bytes is wrong for such a picture.
    #[error("{got} bytes are not {width}x{height} {layout:?}")]
    Size {
        /// Bytes there are.
        got: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Layout.
        layout: Layout,
    },
    /// The error of the compressor.
    #[error(transparent)]
    Refused(#[from] turbojpeg::Error),
}

/// The picture as baseline JPEG of `quality` 1 to 100 percent.
pub fn encode(
    pixels: &[u8],
    layout: Layout,
    (width, height): (usize, usize),
    quality: u8,
) -> Result<Vec<u8>, JpegError> {
    if width == 0 || height == 0 || pixels.len() != layout.bytes(width, height) {
        return Err(JpegError::Size { got: pixels.len(), width, height, layout });
    }
    let mut compressor = Compressor::new()?;
    compressor.set_quality(i32::from(quality.clamp(1, 100)))?;
    let (format, channels) = match layout {
        Layout::Grey => (PixelFormat::GRAY, 1),
        Layout::Rgb => (PixelFormat::RGB, 3),
        Layout::Bgr => (PixelFormat::BGR, 3),
        Layout::Yuv422 | Layout::Yuv420 => {
            let subsamp = if layout == Layout::Yuv422 { Subsamp::Sub2x1 } else { Subsamp::Sub2x2 };
            compressor.set_subsamp(subsamp)?;
            return Ok(compressor.compress_yuv_to_vec(YuvImage {
                pixels,
                width,
                align: 1,
                height,
                subsamp,
            })?);
        }
    };
    compressor.set_subsamp(if layout == Layout::Grey { Subsamp::Gray } else { Subsamp::None })?;
    Ok(compressor.compress_to_vec(Image { pixels, width, pitch: width * channels, height, format })?)
}

/// A grey image as baseline JPEG of `quality` 1 to 100 percent.
///
/// # Errors
/// Those of [`encode`].
pub fn encode_grey(image: &GrayImage, quality: u8) -> Result<Vec<u8>, JpegError> {
    encode(&image.data, Layout::Grey, (image.width, image.height), quality)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ramp of grey and a slowly changing colour, at odd sizes too.
    fn picture(layout: Layout, (width, height): (usize, usize)) -> Vec<u8> {
        let mut out = Vec::new();
        for (k, plane) in layout.planes(width, height).iter().enumerate() {
            for v in 0..plane.height {
                for u in 0..plane.width {
                    let (x, y) = (u * plane.step.0, v * plane.step.1);
                    match (plane.channels, k) {
                        (3, _) => out.extend_from_slice(&[(60 + x) as u8, (40 + y) as u8, 90]),
                        (_, 0) => out.push((40 + x + y) as u8),
                        (_, k) => out.push((110 + 20 * k + y / 2) as u8),
                    }
                }
            }
        }
        out
    }

    #[test]
    fn every_layout_comes_back_as_it_went() {
        for size in [(64, 48), (33, 21), (1, 1)] {
            for layout in [Layout::Grey, Layout::Rgb, Layout::Bgr, Layout::Yuv422, Layout::Yuv420] {
                let pixels = picture(layout, size);
                let jpeg = encode(&pixels, layout, size, 95).expect("encodes");
                let back = image::load_from_memory(&jpeg).expect("decodes").to_rgb8();
                assert_eq!((back.width() as usize, back.height() as usize), size, "{layout:?}");
                let last = (size.0 - 1, size.1 - 1);
                for (x, y) in [(0, 0), (last.0 / 2, last.1 / 2), last] {
                    let got = back.get_pixel(x as u32, y as u32).0.map(f64::from);
                    let wanted = expected(layout, x, y);
                    for (got, wanted) in got.iter().zip(wanted) {
                        assert!((got - wanted).abs() < 8.0, "{layout:?} {size:?} at {x},{y}: {got} {wanted}");
                    }
                }
            }
        }
    }

    /// Red, green, blue of [`picture`]; full-range BT.601 as in JFIF.
    fn expected(layout: Layout, x: usize, y: usize) -> [f64; 3] {
        let (x, y) = (x as f64, y as f64);
        let luma = 40.0 + x + y;
        match layout {
            Layout::Grey => [luma; 3],
            Layout::Rgb => [60.0 + x, 40.0 + y, 90.0],
            Layout::Bgr => [90.0, 40.0 + y, 60.0 + x],
            Layout::Yuv422 | Layout::Yuv420 => {
                let (cb, cr) = (130.0 + y / 2.0 - 128.0, 150.0 + y / 2.0 - 128.0);
                [luma + 1.402 * cr, luma - 0.344 * cb - 0.714 * cr, luma + 1.772 * cb]
            }
        }
    }

    #[test]
    fn the_wrong_number_of_bytes_is_refused() {
        for bad in [(4, 4), (0, 3), (5, 0)] {
            assert!(matches!(encode(&[0; 15], Layout::Grey, bad, 90), Err(JpegError::Size { .. })));
        }
        assert!(
            encode(&vec![0; 70_000], Layout::Grey, (70_000, 1), 90).is_err(),
            "beyond the format's sides"
        );
    }
}
