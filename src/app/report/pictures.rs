//! A few frames with their detections, and the image quality of a sample of all frames.

use std::fmt::Write as _;
use std::path::Path;

use super::page::{Section, base64, paragraph};
use crate::app::flight::{self, Flight};
use crate::io::mcap_read::ReadError;
use crate::io::proto::windhover as wh;
use crate::jpeg::{self, Layout};
use crate::pixels::decode;
use windhover_base::msg::GrayImage;
use windhover_base::time::MonoTime;

/// Frames shown.
const SHOWN: usize = 6;
/// Frames whose quality is measured.
const MEASURED: usize = 80;
/// Widest picture, pixels.
const WIDEST: usize = 640;
/// Quality of the pictures' JPEG, percent.
const JPEG_QUALITY: u8 = 72;

/// Image quality of a frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Quality {
    /// Mean grey level.
    pub(super) mean: f64,
    /// One sigma of the grey levels.
    pub(super) spread: f64,
    /// The strongest edges: the difference between neighbouring pixels that one in a hundred exceeds.
    pub(super) sharpness: f64,
}

/// A reduced frame.
pub(super) struct FramePicture {
    jpeg: Vec<u8>,
    /// Size of the full frame, pixels.
    width: usize,
    height: usize,
    t_s: f64,
    number: u32,
    seen: wh::Detections,
}

/// Data from the frames.
#[derive(Default)]
pub(super) struct Pictures {
    shown: Vec<FramePicture>,
    /// Quality by time of exposure.
    pub(super) quality: Vec<(MonoTime, Quality)>,
    /// Frames of the sample that could not be read.
    pub(super) unreadable: usize,
}

/// Reads the frames to show, and a sample for quality.
pub(super) fn read(path: &Path, flight: &Flight) -> Result<Pictures, ReadError> {
    let shown = chosen(flight);
    let step = flight.frames.len().div_ceil(MEASURED).max(1);
    let mut wanted: Vec<u32> =
        (0..flight.frames.len() as u32).step_by(step).chain(shown.iter().copied()).collect();
    wanted.sort_unstable();
    wanted.dedup();
    let mut pictures = Pictures::default();
    flight::frames(path, &wanted, |frame| match decode(frame, false) {
        Ok(decoded) => {
            pictures.quality.push((frame.t_exposure, quality(&decoded.gray)));
            if shown.contains(&frame.index) {
                let t_s = flight.seconds(frame.t_exposure);
                pictures.shown.extend(picture(&decoded.gray, frame.index, t_s, flight));
            }
        }
        Err(_) => pictures.unreadable += 1,
    })?;
    Ok(pictures)
}

/// Numbers of the frames to show: spread over the flight, in each part the frame with the most detections.
fn chosen(flight: &Flight) -> Vec<u32> {
    let n = flight.frames.len();
    if flight.detections.is_empty() {
        return (0..SHOWN.min(n)).map(|k| (k * n / SHOWN.min(n)) as u32).collect();
    }
    let part = flight.detections.len().div_ceil(SHOWN).max(1);
    let best = |part: &[wh::Detections]| {
        let rank = |d: &&wh::Detections| (d.markers.len(), d.features.len());
        part.iter().max_by_key(rank).map(|d| d.frame)
    };
    flight.detections.chunks(part).filter_map(best).collect()
}

fn quality(image: &GrayImage) -> Quality {
    let n = (image.width * image.height).max(1) as f64;
    let pixels = || (0..image.height).flat_map(|v| image.view().row(v).iter());
    let mean = pixels().map(|p| f64::from(*p)).sum::<f64>() / n;
    let spread = (pixels().map(|p| (f64::from(*p) - mean).powi(2)).sum::<f64>() / n).sqrt();
    let mut counts = [0u64; 256];
    for v in 0..image.height {
        image.view().row(v).windows(2).for_each(|w| counts[usize::from(w[0].abs_diff(w[1]))] += 1);
    }
    let total: u64 = counts.iter().sum();
    let mut above = 0;
    let sharpness = (0..256).rev().find(|k| {
        above += counts[*k];
        above * 100 >= total
    });
    Quality { mean, spread, sharpness: sharpness.unwrap_or(0) as f64 }
}

fn picture(image: &GrayImage, number: u32, t_s: f64, flight: &Flight) -> Option<FramePicture> {
    let small = shrunk(image);
    let jpeg = jpeg::encode(&small.data, Layout::Grey, (small.width, small.height), JPEG_QUALITY).ok()?;
    let seen = flight.detections.iter().find(|d| d.frame == number).cloned().unwrap_or_default();
    Some(FramePicture { jpeg, width: image.width, height: image.height, t_s, number, seen })
}

/// Each pixel is the mean of a block, so that the picture is no wider than [`WIDEST`].
fn shrunk(image: &GrayImage) -> GrayImage {
    let block = image.width.div_ceil(WIDEST).max(1);
    let mut small = GrayImage::new(image.width / block, image.height / block);
    for v in 0..small.height {
        for u in 0..small.width {
            let rows = v * block..(v + 1) * block;
            let sum: u32 = rows
                .flat_map(|y| image.view().row(y)[u * block..(u + 1) * block].iter())
                .map(|p| u32::from(*p))
                .sum();
            small.data[v * small.stride + u] = (sum / (block * block) as u32) as u8;
        }
    }
    small
}

/// The section; empty without pictures.
pub(super) fn section(pictures: &Pictures) -> Option<Section> {
    if pictures.shown.is_empty() {
        return None;
    }
    let mut body = paragraph("Markers outlined in green with their number, ground features in orange.");
    body += "<div class=\"grid\">";
    for p in &pictures.shown {
        let _ = write!(
            body,
            "<figure><div class=\"picture\"><img alt=\"frame {}\" width=\"{}\" height=\"{}\" \
             src=\"data:image/jpeg;base64,{}\">{}</div><figcaption>frame {} at {:.1} s, {} markers, {} features</figcaption></figure>",
            p.number,
            p.width,
            p.height,
            base64(&p.jpeg),
            overlay(p),
            p.number,
            p.t_s,
            p.seen.markers.len(),
            p.seen.features.len()
        );
    }
    body += "</div>\n";
    Some(Section { id: "frames", title: "Frames", body })
}

/// Outlines in pixels of the full frame; the centre of the first pixel is (½, ½) of the picture.
fn overlay(p: &FramePicture) -> String {
    let mut out = format!("<svg viewBox=\"0 0 {} {}\">", p.width, p.height);
    let size = p.width as f64 / 45.0;
    for m in &p.seen.markers {
        if m.corners.len() == 8 {
            let corners: Vec<String> =
                m.corners.chunks(2).map(|c| format!("{:.1},{:.1}", c[0] + 0.5, c[1] + 0.5)).collect();
            let _ = write!(
                out,
                "<polygon points=\"{}\" fill=\"none\" stroke=\"#2ee66b\" stroke-width=\"{:.1}\"/>",
                corners.join(" "),
                size / 10.0
            );
        } else {
            let _ = write!(
                out,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{:.1}\" fill=\"none\" stroke=\"#2ee66b\" stroke-width=\"{:.1}\"/>",
                m.center_u + 0.5,
                m.center_v + 0.5,
                m.size_px / 2.0,
                size / 10.0
            );
        }
        let _ = write!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size:.0}\" font-family=\"sans-serif\" fill=\"#2ee66b\" \
             stroke=\"#000\" stroke-width=\"{:.1}\" paint-order=\"stroke\">{}</text>",
            m.center_u + 0.7 * m.size_px,
            m.center_v - 0.5 * m.size_px,
            size / 8.0,
            m.id
        );
    }
    for f in &p.seen.features {
        let _ = write!(
            out,
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{:.1}\" fill=\"none\" stroke=\"#ffae33\" stroke-width=\"{:.1}\"/>",
            f.u + 0.5,
            f.v + 0.5,
            size / 3.0,
            size / 12.0
        );
    }
    out + "</svg>"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quality_of_an_edge() {
        let mut image = GrayImage::new(40, 10);
        image.data.iter_mut().enumerate().for_each(|(k, p)| *p = if k % 40 < 20 { 50 } else { 150 });
        let q = quality(&image);
        assert_eq!((q.mean, q.spread, q.sharpness), (100.0, 50.0, 100.0));
    }

    #[test]
    fn a_small_picture_keeps_its_brightness() {
        let mut image = GrayImage::new(1300, 40);
        image.data.fill(77);
        let small = shrunk(&image);
        assert_eq!((small.width, small.height), (433, 13));
        assert!(small.data.iter().all(|p| *p == 77));
    }
}
