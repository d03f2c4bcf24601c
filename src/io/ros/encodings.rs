//! Uncompressed images by their names in ROS (`sensor_msgs/image_encodings.hpp`).

use windhover_base::msg::{Bayer, FrameEncoding};

/// The first name is written, all are read.
const NAMES: [(FrameEncoding, &[&str]); 10] = [
    (FrameEncoding::Grey, &["mono8", "8UC1"]),
    (FrameEncoding::Yuyv, &["yuv422_yuy2", "yuyv"]),
    (FrameEncoding::Uyvy, &["yuv422", "uyvy"]),
    (FrameEncoding::Rgb24, &["rgb8"]),
    (FrameEncoding::Bgr24, &["bgr8", "8UC3"]),
    (FrameEncoding::Bayer(Bayer::Rggb), &["bayer_rggb8"]),
    (FrameEncoding::Bayer(Bayer::Bggr), &["bayer_bggr8"]),
    (FrameEncoding::Bayer(Bayer::Gbrg), &["bayer_gbrg8"]),
    (FrameEncoding::Bayer(Bayer::Grbg), &["bayer_grbg8"]),
    (FrameEncoding::Y16, &["mono16", "16UC1"]),
];

/// The encoding of that name.
pub fn frame_encoding(name: &str) -> FrameEncoding {
    let row = NAMES.iter().find(|(_, names)| names.contains(&name));
    row.map_or(FrameEncoding::Unknown, |(encoding, _)| *encoding)
}

/// The name of an encoding; `None` for compressed ones, and for those without a name. Ten and twelve bits are in
/// sixteen.
pub fn encoding_name(encoding: FrameEncoding) -> Option<&'static str> {
    let wide = match encoding {
        FrameEncoding::Y10 | FrameEncoding::Y12 => FrameEncoding::Y16,
        other => other,
    };
    NAMES.iter().find(|(of, _)| *of == wide)?.1.first().copied()
}
