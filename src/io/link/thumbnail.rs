//! Thumbnails of the camera image: small JPEG pictures with the detections.

use prost::Message as _;

use crate::io::proto::link::Thumbnail;
use crate::io::records;
use crate::jpeg::{self, Layout};
use crate::pixels;
use windhover_base::msg::{FeatureTrack, FramePayload, GrayImage, MarkerDetection};

/// JPEG quality: a thumbnail of 320 × 256 takes about 8 KB.
const QUALITY: u8 = 60;

/// A frame for the next thumbnail, as the camera delivered it.
#[derive(Clone, Debug)]
pub struct Picture {
    /// The frame.
    pub frame: FramePayload,
    /// Markers found in it.
    pub markers: Vec<MarkerDetection>,
    /// Ground features found in it.
    pub features: Vec<FeatureTrack>,
}

/// The mean of blocks of `factor`² pixels; pixels at the right and bottom that do not fill a block are left out.
fn shrink(image: &GrayImage, factor: usize) -> GrayImage {
    let (width, height) = (image.width / factor, image.height / factor);
    let mut small = GrayImage::new(width, height);
    let area = (factor * factor) as u32;
    let mut sums = vec![0_u32; width];
    for v in 0..height {
        sums.fill(area / 2);
        for row in v * factor..(v + 1) * factor {
            let row = &image.data[row * image.stride..row * image.stride + width * factor];
            for (sum, block) in sums.iter_mut().zip(row.chunks_exact(factor)) {
                *sum += block.iter().map(|p| u32::from(*p)).sum::<u32>();
            }
        }
        for (pixel, sum) in small.data[v * width..(v + 1) * width].iter_mut().zip(&sums) {
            *pixel = (sum / area) as u8;
        }
    }
    small
}

impl Picture {
    /// The thumbnail, about `width` pixels wide; `None` where the frame cannot be read or is empty.
    pub fn thumbnail(&self, width: u32) -> Option<Thumbnail> {
        let image = pixels::decode(&self.frame, false).ok()?.gray;
        let factor = (image.width / width.max(1) as usize).max(1);
        let small = shrink(&image, factor);
        let jpeg = jpeg::encode(&small.data, Layout::Grey, (small.width, small.height), QUALITY).ok()?;
        let found =
            records::detections(self.frame.index, self.frame.t_exposure, &self.markers, &self.features);
        Some(Thumbnail {
            frame: self.frame.index,
            time_ns: self.frame.t_exposure.ns(),
            width: image.width as u32,
            height: image.height as u32,
            jpeg,
            detections: found.encode_to_vec(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::FrameEncoding;
    use windhover_base::time::MonoTime;

    #[test]
    fn a_thumbnail_shows_the_mean_and_keeps_the_size_of_the_frame() {
        let mut image = GrayImage::new(64, 48);
        for (i, pixel) in image.data.iter_mut().enumerate() {
            *pixel = if i % 64 < 32 { 40 } else { 200 };
        }
        let small = shrink(&image, 4);
        assert_eq!((small.width, small.height), (16, 12));
        assert_eq!((small.data[0], small.data[15]), (40, 200));
        let frame = FramePayload {
            index: 7,
            t_exposure: MonoTime::from_ns(5),
            encoding: FrameEncoding::Grey,
            width: 64,
            height: 48,
            stride: 64,
            data: image.data.into(),
        };
        let picture = Picture { frame, markers: Vec::new(), features: Vec::new() };
        let thumbnail = picture.thumbnail(16).expect("a thumbnail");
        assert_eq!((thumbnail.frame, thumbnail.width, thumbnail.height), (7, 64, 48));
        assert_eq!(thumbnail.jpeg[..2], [0xff, 0xd8]);
        let mut cut_off = picture;
        cut_off.frame.data = vec![0; 10].into();
        assert!(cut_off.thumbnail(16).is_none());
    }
}
