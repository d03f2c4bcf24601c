//! Which disc of the configuration each round region is: by size, by colour, by place, or not at all.

use nalgebra::{Matrix2, Vector2};

use super::disc::{Blob, DiscFinder, center_shift};
use super::roi::Roi;
use windhover_base::geo::CameraModel;
use windhover_base::msg::{
    FramePrediction, GrayImage, ImageView, MarkerDetection, MarkerId, MarkerPrediction, RgbImage,
};
use windhover_base::settings::{Brightness, MarkerKind, TargetConfig};

/// What a disc looks like against its surroundings.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Look {
    Light,
    Dark,
    Color([u8; 3]),
}

/// A disc of the configuration.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Disc {
    target: usize,
    marker: usize,
    diameter_m: f64,
    look: Look,
    at: Vector2<f64>,
}

/// Finds the configured discs; keeps its buffers.
#[derive(Clone, Debug)]
pub(super) struct DiscPairs {
    discs: Vec<Disc>,
    finder: DiscFinder,
    plane: GrayImage,
    blobs: Vec<(usize, Blob)>,
    found: Vec<Blob>,
    focal_px: f64,
    principal: Vector2<f64>,
}

/// Sigmas of a predicted centre within which a disc is taken.
const GATE_SIGMAS: f64 = 4.0;

/// Ground wanted around a disc, pixels.
const AROUND_PX: f64 = 12.0;

/// How far a disc's size may be from the predicted one, and a pair's ratio from the configured one.
const SIZE_SLACK: f64 = 0.25;
const RATIO_SLACK: f64 = 0.12;

impl DiscPairs {
    /// The discs of `targets`; `None` where they have none.
    pub fn new(targets: &[TargetConfig], lens: &CameraModel) -> Option<Self> {
        let mut discs = Vec::new();
        for (target, t) in targets.iter().enumerate() {
            for (marker, m) in t.marker.iter().enumerate().filter(|(_, m)| m.kind == MarkerKind::Disc) {
                let look = match (m.brightness, m.color.as_deref().and_then(parse_color)) {
                    (_, Some(color)) => Look::Color(color),
                    (Some(Brightness::Dark), None) => Look::Dark,
                    _ => Look::Light,
                };
                let diameter_m = m.diameter_m?;
                let at = Vector2::new(m.position_m[0], m.position_m[1]);
                discs.push(Disc { target, marker, diameter_m, look, at });
            }
        }
        (!discs.is_empty()).then(|| Self {
            discs,
            finder: DiscFinder::new(),
            plane: GrayImage::default(),
            blobs: Vec::new(),
            found: Vec::new(),
            focal_px: 0.5 * (lens.fx + lens.fy),
            principal: Vector2::new(lens.cx, lens.cy),
        })
    }

    /// Appends the discs that can be distinguished from all others. While tracking they are looked for where they are
    /// predicted, and only there; else in the whole frame.
    pub fn find(
        &mut self,
        image: ImageView<'_>,
        rgb: Option<&RgbImage>,
        prediction: Option<&FramePrediction>,
        out: &mut Vec<MarkerDetection>,
    ) {
        self.blobs.clear();
        let rgb = rgb.filter(|c| (c.width, c.height) == (image.width, image.height));
        let tracking = prediction.filter(|p| !p.search);
        for i in 0..self.discs.len() {
            if let Some(prediction) = tracking {
                let roi = predicted(&self.discs[i], Some(prediction)).and_then(|m| roi_of(image, m));
                if let Some(roi) = roi {
                    self.search(i, image, rgb, roi);
                }
                continue;
            }
            // Discs that look alike are searched once.
            let look = self.discs[i].look;
            match self.discs[..i].iter().position(|d| d.look == look) {
                Some(same) => {
                    let searched = self.blobs.len();
                    for k in 0..searched {
                        let (disc, blob) = self.blobs[k];
                        if disc == same {
                            self.blobs.push((i, blob));
                        }
                    }
                }
                None => {
                    let whole = Roi { u: 0, v: 0, width: image.width, height: image.height };
                    self.search(i, image, rgb, whole);
                }
            }
        }
        let targets = self.discs.iter().map(|d| d.target).max().map_or(0, |t| t + 1);
        for target in 0..targets {
            self.assign(target, prediction, out);
        }
    }

    fn search(&mut self, disc: usize, image: ImageView<'_>, rgb: Option<&RgbImage>, roi: Roi) {
        let look = self.discs[disc].look;
        self.found.clear();
        let part = image.crop(roi.u, roi.v, roi.width, roi.height);
        let sizes = (0.0, 0.5 * image.width.min(image.height) as f64);
        match (look, rgb) {
            (Look::Dark, _) => self.finder.find(part, sizes, &mut self.found),
            (Look::Light, _) => {
                negative(part, &mut self.plane);
                self.finder.find(self.plane.view(), sizes, &mut self.found);
            }
            (Look::Color(color), Some(rgb)) => {
                color_distance(rgb, roi, color, &mut self.plane);
                self.finder.find(self.plane.view(), sizes, &mut self.found);
            }
            // A grey frame of a coloured disc: lighter or darker, there is no telling which.
            (Look::Color(_), None) => {
                self.finder.find(part, sizes, &mut self.found);
                negative(part, &mut self.plane);
                self.finder.find(self.plane.view(), sizes, &mut self.found);
            }
        }
        let shift = Vector2::new(roi.u as f64, roi.v as f64);
        self.blobs.extend(self.found.iter().map(|b| (disc, Blob { center: b.center + shift, ..*b })));
    }

    /// Gives a target's discs to regions where there is one way to do so.
    fn assign(&self, target: usize, prediction: Option<&FramePrediction>, out: &mut Vec<MarkerDetection>) {
        let mut discs = (0..self.discs.len()).filter(|&i| self.discs[i].target == target);
        match (discs.next(), discs.next()) {
            (Some(only), None) => out.extend(self.alone(only, prediction)),
            (Some(first), Some(second)) => {
                let (a, b) = (&self.discs[first], &self.discs[second]);
                let mut pairs = self
                    .candidates(first, prediction)
                    .flat_map(|p| self.candidates(second, prediction).map(move |q| (p, q)))
                    .filter(|(p, q)| is_pair((a, p), (b, q)));
                match (pairs.next(), pairs.next()) {
                    (Some((p, q)), None) => {
                        out.push(self.detection(first, p));
                        out.push(self.detection(second, q));
                    }
                    (Some(_), Some(_)) => {}
                    (None, _) => out.extend(self.left_over(first, second, prediction)),
                }
            }
            (None, _) => {}
        }
    }

    /// A disc by itself: nothing but its place and size tell it from other round things.
    fn alone(&self, disc: usize, prediction: Option<&FramePrediction>) -> Option<MarkerDetection> {
        predicted(&self.discs[disc], prediction)?;
        let mut candidates = self.candidates(disc, prediction);
        match (candidates.next(), candidates.next()) {
            (Some(blob), None) => Some(self.detection(disc, blob)),
            _ => None,
        }
    }

    /// The disc of a pair whose other one is covered: where it is predicted, while nothing there can be the
    /// other.
    fn left_over(
        &self,
        first: usize,
        second: usize,
        prediction: Option<&FramePrediction>,
    ) -> Option<MarkerDetection> {
        predicted(&self.discs[first], prediction).and(predicted(&self.discs[second], prediction))?;
        let is_there = |disc| self.candidates(disc, prediction).next().is_some();
        match (is_there(first), is_there(second)) {
            (true, false) => self.alone(first, prediction),
            (false, true) => self.alone(second, prediction),
            _ => None,
        }
    }

    /// Regions that can be a disc.
    fn candidates(
        &self,
        disc: usize,
        prediction: Option<&FramePrediction>,
    ) -> impl Iterator<Item = &Blob> + use<'_> {
        let expected = predicted(&self.discs[disc], prediction).copied();
        self.blobs
            .iter()
            .filter(move |(of, blob)| *of == disc && expected.is_none_or(|m| is_expected(blob, &m)))
            .map(|(_, blob)| blob)
    }

    fn detection(&self, disc: usize, blob: &Blob) -> MarkerDetection {
        let Disc { target, marker, .. } = self.discs[disc];
        let (shift, doubt) = center_shift(blob, self.focal_px, self.principal);
        MarkerDetection {
            marker: MarkerId::Disc { target, marker },
            center_px: blob.center + shift,
            center_cov_px2: blob.cov + doubt,
            corners_px: None,
            corner_cov_px2: [Matrix2::zeros(); 4],
            hamming: 0,
            margin: 0.0,
            size_px: blob.diameter,
        }
    }
}

/// Whether a region is where and as large as a disc is expected.
fn is_expected(blob: &Blob, m: &MarkerPrediction) -> bool {
    (blob.center - m.center_px).norm() <= reach(m) && (blob.diameter / m.size_px - 1.0).abs() <= SIZE_SLACK
}

/// How far from the predicted centre a disc's may be, pixels.
fn reach(m: &MarkerPrediction) -> f64 {
    GATE_SIGMAS * m.sigma_px + 3.0
}

/// The part of a frame in which a predicted disc lies whole, with ground around it.
fn roi_of(image: ImageView<'_>, m: &MarkerPrediction) -> Option<Roi> {
    let radius = reach(m) + 0.5 * (1.0 + SIZE_SLACK) * m.size_px + AROUND_PX;
    radius.is_finite().then(|| Roi::around(image, m.center_px, radius)).flatten()
}

fn predicted<'a>(disc: &Disc, prediction: Option<&'a FramePrediction>) -> Option<&'a MarkerPrediction> {
    let id = MarkerId::Disc { target: disc.target, marker: disc.marker };
    prediction?.markers.iter().find(|m| m.marker == id)
}

/// Whether two regions have the sizes and the distance of two discs of one plane, seen at most 60° aslant.
fn is_pair((a, p): (&Disc, &Blob), (b, q): (&Disc, &Blob)) -> bool {
    let apart = (p.center - q.center).norm();
    if apart < 0.5 * (p.diameter.min(q.diameter)) {
        return false;
    }
    let ratio = (p.diameter / q.diameter) / (a.diameter_m / b.diameter_m);
    // The larger axis is not foreshortened: it gives the scale.
    let px_per_m = p.half_axes[0].max(1.0) * 2.0 / a.diameter_m;
    let distance = apart / px_per_m / (a.at - b.at).norm().max(1e-6);
    (ratio - 1.0).abs() <= RATIO_SLACK && (0.45..=1.25).contains(&distance)
}

fn parse_color(text: &str) -> Option<[u8; 3]> {
    let digits = text.strip_prefix('#')?;
    let part = |k: usize| u8::from_str_radix(digits.get(2 * k..2 * k + 2)?, 16).ok();
    Some([part(0)?, part(1)?, part(2)?])
}

fn negative(image: ImageView<'_>, to: &mut GrayImage) {
    (to.width, to.height, to.stride) = (image.width, image.height, image.width);
    to.data.clear();
    (0..image.height).for_each(|v| to.data.extend(image.row(v).iter().map(|p| !p)));
}

/// Distance in chromaticity from a colour in part of a frame, dark where near: shares of red, green and blue do
/// not change with the light.
fn color_distance(rgb: &RgbImage, roi: Roi, color: [u8; 3], to: &mut GrayImage) {
    (to.width, to.height, to.stride) = (roi.width, roi.height, roi.width);
    let shares = |c: [u8; 3]| {
        let sum = c.iter().map(|&x| f32::from(x)).sum::<f32>() + 24.0;
        c.map(|x| (f32::from(x) + 8.0) / sum)
    };
    let wanted = shares(color);
    to.data.clear();
    for v in roi.v..roi.v + roi.height {
        let row = &rgb.data[3 * (v * rgb.width + roi.u)..][..3 * roi.width];
        to.data.extend(row.chunks_exact(3).map(|p| {
            let here = shares([p[0], p[1], p[2]]);
            let distance: f32 = wanted.iter().zip(here).map(|(a, b)| (a - b).abs()).sum();
            (distance * 300.0).min(255.0) as u8
        }));
    }
}
