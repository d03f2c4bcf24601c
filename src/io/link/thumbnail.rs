//! Thumbnails of the camera image: small JPEG pictures with what was detected in them.

use jpeg_encoder::{ColorType, Encoder};
use prost::Message as _;

use crate::io::proto::link::Thumbnail;
use crate::io::records;
use crate::msg::{FeatureTrack, GrayImage, MarkerDetection};
use crate::time::MonoTime;

/// JPEG quality: a thumbnail of 320 × 256 takes about 8 KB.
const QUALITY: u8 = 60;

/// A frame offered for the next thumbnail.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Number of the frame.
    pub frame: u32,
    /// Exposure.
    pub t_exposure: MonoTime,
    /// The frame.
    pub image: std::sync::Arc<GrayImage>,
    /// Markers found in it.
    pub markers: Vec<MarkerDetection>,
    /// Ground features found in it.
    pub features: Vec<FeatureTrack>,
}

/// The mean of blocks of `factor`² pixels; what does not fill a block at the right and bottom is left out.
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
    /// The thumbnail, about `width` pixels wide; `None` where the frame is empty.
    pub fn thumbnail(&self, width: u32) -> Option<Thumbnail> {
        let factor = (self.image.width / width.max(1) as usize).max(1);
        let small = shrink(&self.image, factor);
        let size = (u16::try_from(small.width).ok()?, u16::try_from(small.height).ok()?);
        if size.0 == 0 || size.1 == 0 {
            return None;
        }
        let mut jpeg = Vec::new();
        Encoder::new(&mut jpeg, QUALITY).encode(&small.data, size.0, size.1, ColorType::Luma).ok()?;
        let found = records::detections(self.frame, self.t_exposure, &self.markers, &self.features);
        Some(Thumbnail {
            frame: self.frame,
            time_ns: self.t_exposure.ns(),
            width: self.image.width as u32,
            height: self.image.height as u32,
            jpeg,
            detections: found.encode_to_vec(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thumbnail_shows_the_mean_and_keeps_the_size_of_the_frame() {
        let mut image = GrayImage::new(64, 48);
        for (i, pixel) in image.data.iter_mut().enumerate() {
            *pixel = if i % 64 < 32 { 40 } else { 200 };
        }
        let small = shrink(&image, 4);
        assert_eq!((small.width, small.height), (16, 12));
        assert_eq!((small.data[0], small.data[15]), (40, 200));
        let picture = Picture {
            frame: 7,
            t_exposure: MonoTime::from_ns(5),
            image: image.into(),
            markers: Vec::new(),
            features: Vec::new(),
        };
        let thumbnail = picture.thumbnail(16).expect("a thumbnail");
        assert_eq!((thumbnail.frame, thumbnail.width, thumbnail.height), (7, 64, 48));
        assert_eq!(thumbnail.jpeg[..2], [0xff, 0xd8]);
        assert!(Picture { image: GrayImage::new(0, 0).into(), ..picture }.thumbnail(16).is_none());
    }
}
