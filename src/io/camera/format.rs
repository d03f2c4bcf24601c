//! Pixel formats by their V4L2 names, and the choice among the offered ones.

use windhover_base::msg::{Bayer, FrameEncoding};
use windhover_base::settings::PixelFormat;

/// A four-character code of V4L2.
pub(super) type FourCc = [u8; 4];

/// The V4L2 code of a format.
pub(super) const fn fourcc(format: PixelFormat) -> FourCc {
    match format {
        PixelFormat::Grey => *b"GREY",
        PixelFormat::Yuyv => *b"YUYV",
        PixelFormat::Uyvy => *b"UYVY",
        PixelFormat::Nv12 => *b"NV12",
        PixelFormat::Mjpg => *b"MJPG",
        PixelFormat::Rgb24 => *b"RGB3",
        PixelFormat::Rggb => *b"RGGB",
        PixelFormat::Bggr => *b"BA81",
        PixelFormat::Gbrg => *b"GBRG",
        PixelFormat::Grbg => *b"GRBG",
        PixelFormat::Y10 => *b"Y10 ",
        PixelFormat::Y12 => *b"Y12 ",
        PixelFormat::Y16 => *b"Y16 ",
        PixelFormat::Y10Packed => *b"Y10P",
    }
}

/// How frames of a V4L2 format are read; `None` where they are not supported.
pub(super) const fn encoding(code: FourCc) -> Option<FrameEncoding> {
    Some(match &code {
        b"GREY" | b"Y8  " | b"Y800" => FrameEncoding::Grey,
        b"RGGB" => FrameEncoding::Bayer(Bayer::Rggb),
        b"BA81" => FrameEncoding::Bayer(Bayer::Bggr),
        b"GBRG" => FrameEncoding::Bayer(Bayer::Gbrg),
        b"GRBG" => FrameEncoding::Bayer(Bayer::Grbg),
        b"Y10 " => FrameEncoding::Y10,
        b"Y12 " => FrameEncoding::Y12,
        b"Y16 " => FrameEncoding::Y16,
        b"Y10P" => FrameEncoding::Y10Packed,
        b"YUYV" => FrameEncoding::Yuyv,
        b"UYVY" => FrameEncoding::Uyvy,
        b"NV12" => FrameEncoding::Nv12,
        b"RGB3" => FrameEncoding::Rgb24,
        b"BGR3" => FrameEncoding::Bgr24,
        b"MJPG" | b"JPEG" => FrameEncoding::Jpeg,
        _ => return None,
    })
}

/// Formats in order of preference when the requested one is not offered: first those whose grey values are read
/// directly, last the lossy ones.
const PREFERENCE: [FourCc; 18] = [
    *b"GREY", *b"Y8  ", *b"Y800", *b"NV12", *b"YUYV", *b"UYVY", *b"RGB3", *b"BGR3", *b"Y10P", *b"Y10 ",
    *b"Y12 ", *b"Y16 ", *b"RGGB", *b"BA81", *b"GBRG", *b"GRBG", *b"MJPG", *b"JPEG",
];

/// The format to request from the driver: `asked` where it is offered (or where the driver offers no list), else the
/// most preferred of the supported ones; `None` where none is supported.
pub(super) fn choose(asked: FourCc, offered: &[FourCc]) -> Option<FourCc> {
    if offered.is_empty() || offered.contains(&asked) {
        return Some(asked);
    }
    PREFERENCE.into_iter().find(|code| offered.contains(code))
}

/// A code in its readable form.
pub(super) fn name(code: FourCc) -> String {
    code.iter().map(|&byte| if byte.is_ascii_graphic() { char::from(byte) } else { '.' }).collect()
}

/// The smallest frame of a format, bytes: with `stride` bytes from one row to the next. `None` for
/// compressed formats, whose frames have any size.
pub(super) fn frame_bytes(encoding: FrameEncoding, stride: usize, height: usize) -> Option<usize> {
    match encoding {
        FrameEncoding::Nv12 => Some(stride * height * 3 / 2),
        FrameEncoding::Jpeg | FrameEncoding::Png | FrameEncoding::Unknown => None,
        _ => Some(stride * height),
    }
}

/// Bytes of a row without padding, for drivers that leave the stride out.
pub(super) const fn packed_stride(encoding: FrameEncoding, width: u32) -> u32 {
    match encoding {
        FrameEncoding::Grey | FrameEncoding::Nv12 | FrameEncoding::Bayer(_) => width,
        FrameEncoding::Y10Packed => width.div_ceil(4) * 5,
        FrameEncoding::Yuyv | FrameEncoding::Uyvy => width * 2,
        FrameEncoding::Y10 | FrameEncoding::Y12 | FrameEncoding::Y16 => width * 2,
        FrameEncoding::Rgb24 | FrameEncoding::Bgr24 => width * 3,
        FrameEncoding::Jpeg | FrameEncoding::Png | FrameEncoding::Unknown => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_asked_for_comes_first() {
        assert_eq!(choose(*b"YUYV", &[*b"GREY", *b"YUYV"]), Some(*b"YUYV"));
        assert_eq!(choose(*b"GREY", &[*b"MJPG", *b"YUYV"]), Some(*b"YUYV"));
        assert_eq!(choose(*b"GREY", &[*b"H264", *b"BA81"]), Some(*b"BA81"));
        assert_eq!(choose(*b"GREY", &[*b"H264", *b"Y10B"]), None);
        assert_eq!(choose(*b"GREY", &[]), Some(*b"GREY"));
    }

    #[test]
    fn every_configurable_format_is_understood() {
        use PixelFormat::{
            Bggr, Gbrg, Grbg, Grey, Mjpg, Nv12, Rgb24, Rggb, Uyvy, Y10, Y10Packed, Y12, Y16, Yuyv,
        };
        for format in [Grey, Yuyv, Uyvy, Nv12, Mjpg, Rgb24, Rggb, Bggr, Gbrg, Grbg, Y10, Y12, Y16, Y10Packed]
        {
            assert!(encoding(fourcc(format)).is_some(), "{format:?}");
            assert!(PREFERENCE.contains(&fourcc(format)), "{format:?}");
        }
        assert_eq!(frame_bytes(FrameEncoding::Nv12, 1280, 1024), Some(1280 * 1024 * 3 / 2));
        assert_eq!(frame_bytes(FrameEncoding::Jpeg, 0, 1024), None);
        assert_eq!(name(*b"Y16\0"), "Y16.");
    }
}
