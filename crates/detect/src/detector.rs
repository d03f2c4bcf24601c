//! The tag detector: from an image to tags with their corners.

use super::binarise::{Binariser, Bitmap, Where};
use super::candidate::{Found, decode, detection, same_place, straighten};
use super::components::{Labeller, Touch};
use super::detection::TagDetection;
use super::family::{Family, TagLayout};
use super::noise::noise_sigma;
use super::pyramid::{Base, Pyramid, Rim};
use super::quad::{Quad, QuadFinder, SizeLimits, distance, may_be_border};
use super::refine::Refiner;
use super::roi::Roi;
use super::simd::Simd;
use nalgebra::Vector2;
use windhover_base::msg::{GrayImage, ImageView};

/// Finds square tags. Buffers are kept from image to image: with images of one size the second and later ones
/// take no memory.
#[derive(Clone, Debug)]
pub struct Detector {
    families: Vec<Family>,
    min_px: f32,
    simd: Simd,
    pyramid: Pyramid,
    binariser: Binariser,
    bits: Bitmap,
    labeller: Labeller,
    finder: QuadFinder,
    refiner: Refiner,
    found: Vec<Found>,
    /// Levels and quadrilaterals that were read.
    tried: Vec<(usize, Quad)>,
    detections: Vec<TagDetection>,
    negative: GrayImage,
    /// Runs of dark pixels of the last division, and of a level at the highest one that is looked at everywhere.
    runs: usize,
    runs_of_level: usize,
    /// Of a frame pixel, grey levels.
    noise: f32,
}

/// What is looked for.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Limits {
    /// Smallest edge of a tag's border, the square whose size is configured, pixels.
    pub min_px: f64,
    /// Most wrong bits that are corrected. Families with few bits correct fewer: 36h11 at most 2, 25h9 at
    /// most 1, 16h5 none, 41h12 at most 3.
    pub max_hamming: u8,
}

impl Default for Limits {
    /// Tags from 16 pixels, at most two wrong bits.
    fn default() -> Self {
        Self { min_px: 16.0, max_hamming: 2 }
    }
}

/// How regions of a level are looked at once more, those that touch by a corner alone taken apart.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Look {
    /// Not at all.
    Whole,
    /// At the highest division: ground with a tag here and there.
    Ground,
    /// At every division: sheets of tags that touch each other's corners.
    Print,
    /// The same, and whole regions too, where lower divisions were left out because there is so much of it.
    BusyPrint,
}

impl Look {
    fn is_print(self) -> bool {
        matches!(self, Self::Print | Self::BusyPrint)
    }

    /// The same where what has the contrast of print is none.
    fn of_ground(self) -> Self {
        match self {
            Self::BusyPrint => Self::Whole,
            Self::Print => Self::Ground,
            other => other,
        }
    }
}

/// Most levels of an image that are searched.
const MOST_SEARCHED: usize = 3;

/// Where between the local minimum and maximum dark and light are divided, of 256. Low keeps a border whole
/// where a shadow's edge crosses the tag; a second time higher up for borders that are blurred, which the
/// coarser levels can afford, and small tags need in the finest. In the coarser ones a third time lower still:
/// where a deep shadow ends, its paper is not much lighter than ink in the light.
const FRACTIONS_ONCE: [u16; 1] = [85];
const FRACTIONS_TWICE: [u16; 2] = [72, 116];
const FRACTIONS_THRICE: [u16; 3] = [40, 72, 116];

/// In the finest level, where these are not among them, the others only in parts: low where light changes, high where
/// there is most contrast.
const FRACTIONS_IN_PARTS: [(u16, Where); 2] = [(56, Where::LightChanges), (116, Where::Strongest)];

/// And where white is over-exposed: it spreads into the border from both sides and leaves little of it dark.
const FRACTION_SATURATED: u16 = 195;

/// Smallest edge in a level at which a border can be distinguished from its surroundings, pixels.
const LEAST_EDGE_IN_LEVEL: f32 = 12.0;

/// Where weak contrast is divided.
const FRACTION_DIM: u16 = 100;

/// Pixels of a level for each run of dark ones from which it is looked at for contrast that is weaker than that of
/// print in clear air, where there is such too. In the finest level it is not: weak tags beside clear contrast are found
/// from twice the least size on.
const AREA_OF_RUN: usize = 20;

/// Pixels of the finest level for each run of dark ones from which an image with the contrast of print is one: gravel has
/// half as many. Where runs are as many, so many tags that were found show a sheet of small ones.
const AREA_OF_PRINT: usize = 24;
const TAGS_OF_PRINT: usize = 6;

/// The same by the share of a level that has such contrast, which is known before pixels are marked.
const MOST_DIM: f32 = 0.25;

/// Least step across a side, as a share of the light outside it, in clear air.
const CLEAR_STEP: f32 = 0.1;

/// Least contrast that is looked at where an image has hardly any noise, grey levels: in clear air, and at all.
const CLEAR_GATE: f32 = 12.0;
const LEAST_GATE: f32 = 6.0;

/// Farthest that corners of two quadrilaterals may be from each other to be read alike, pixels of a level.
const SAME_QUAD: f32 = 0.3;

/// Largest image, pixels on a side.
pub const LARGEST_IMAGE_PX: usize = 32_767;

impl Detector {
    /// A detector of tags of these families, or of these families with these borders.
    pub fn new<L: Into<TagLayout> + Copy>(layouts: &[L], limits: Limits) -> Self {
        let Limits { min_px, max_hamming } = limits;
        Self {
            families: layouts.iter().map(|&l| Family::new(l.into(), max_hamming)).collect(),
            min_px: min_px as f32,
            simd: Simd::best(),
            pyramid: Pyramid::default(),
            binariser: Binariser::default(),
            bits: Bitmap::default(),
            labeller: Labeller::default(),
            finder: QuadFinder::default(),
            refiner: Refiner::new(Simd::best()),
            found: Vec::new(),
            tried: Vec::new(),
            detections: Vec::new(),
            negative: GrayImage::default(),
            runs: 0,
            runs_of_level: 0,
            noise: 0.0,
        }
    }

    /// The same with other kernels; every kernel gives the same detections.
    pub fn with_simd(self, simd: Simd) -> Self {
        Self { simd, refiner: Refiner::new(simd), ..self }
    }

    /// Appearance for tags from this edge on, pixels, from now on.
    pub fn set_min_px(&mut self, min_px: f64) {
        self.min_px = min_px as f32;
    }

    /// Every tag found in a part of an image, in coordinates of the whole image.
    pub fn detect_roi(&mut self, image: ImageView<'_>, roi: Roi) -> &[TagDetection] {
        self.search_all(image.crop(roi.u, roi.v, roi.width, roi.height), Rim::LeftOut);
        let origin = Vector2::new(roi.u as f64, roi.v as f64);
        self.detections.iter_mut().for_each(|found| *found = found.moved(origin));
        &self.detections
    }

    /// Every tag found in an image, each once. Images with a side over [`LARGEST_IMAGE_PX`] are not searched.
    pub fn detect(&mut self, image: ImageView<'_>) -> &[TagDetection] {
        self.search_all(image, Rim::Kept);
        &self.detections
    }

    fn search_all(&mut self, image: ImageView<'_>, rim: Rim) {
        self.found.clear();
        self.detections.clear();
        let sides = [image.width, image.height];
        if sides.iter().any(|s| !(1..=LARGEST_IMAGE_PX).contains(s)) {
            return;
        }
        if self.families.iter().any(|f| !f.in_negative) {
            self.search(image, rim, false);
        }
        if self.families.iter().any(|f| f.in_negative) {
            let mut negative = std::mem::take(&mut self.negative);
            negate(image, &mut negative);
            self.search(negative.view(), rim, true);
            self.negative = negative;
        }
        self.detections.extend(self.found.iter().map(detection));
    }

    /// Searches an image, or its negative for the families whose border is light.
    fn search(&mut self, image: ImageView<'_>, rim: Rim, inverted: bool) {
        let base = if self.min_px >= LEAST_EDGE_IN_LEVEL * 2.0 {
            Base::Half
        } else if self.min_px >= LEAST_EDGE_IN_LEVEL * 1.3 {
            Base::TwoThirds
        } else {
            Base::Full
        };
        self.noise = noise_sigma(image);
        let is_print = self.search_from(image, base, rim, inverted);
        // Sheets hold tags seen so much aslant that only the frame itself shows their cells, however large they are.
        if is_print && base != Base::Full && rim == Rim::Kept {
            self.search_from(image, Base::Full, rim, inverted);
        }
    }

    /// Searches an image's levels from a base on; whether it shows print.
    fn search_from(&mut self, image: ImageView<'_>, base: Base, rim: Rim, inverted: bool) -> bool {
        self.pyramid.build(image, base, rim, 16, self.simd);
        let first = usize::from(base != Base::Full).min(self.pyramid.len() - 1);
        let last = (first + MOST_SEARCHED - 1).min(self.pyramid.len() - 1);
        let fractions = |n: usize| -> &[u16] {
            match (n == first, base) {
                (true, Base::Half) => &FRACTIONS_ONCE,
                (true, _) => &FRACTIONS_TWICE,
                (false, _) => &FRACTIONS_THRICE,
            }
        };
        self.tried.clear();
        let mut looks = [Look::Whole; MOST_SEARCHED];
        for n in (first..=last).rev() {
            looks[n - first] = self.search_level(image, n, fractions(n), n == first, inverted);
        }
        let is_sparse = self.runs_of_level * AREA_OF_PRINT <= self.bits.width * self.bits.height;
        let is_print = looks[0].is_print() && (is_sparse || self.found.len() >= TAGS_OF_PRINT);
        // What touches others by a corner comes last: what is found without needs no second look. While tracking a region
        // is predicted, and has to be searched fast.
        if rim == Rim::Kept {
            for n in (first..=last).rev() {
                let look = if is_print { looks[n - first] } else { looks[n - first].of_ground() };
                self.search_parts(image, n, fractions(n), look, inverted);
            }
        }
        is_print
    }

    /// Appearance for tags in a level; how their parts are to be looked at afterwards.
    fn search_level(
        &mut self,
        image: ImageView<'_>,
        n: usize,
        fractions: &[u16],
        finest: bool,
        inverted: bool,
    ) -> Look {
        self.measure(image, n, inverted);
        let (is_busy, highest) = (self.binariser.is_busy(), fractions.last().copied());
        for &fraction in fractions {
            let is_lower = is_busy && Some(fraction) != highest;
            let at = if is_lower { Where::LightChanges } else { Where::Everywhere };
            self.search_division(image, n, (fraction, at, Touch::Corners), inverted);
        }
        let runs = self.runs;
        if finest {
            for (fraction, at) in FRACTIONS_IN_PARTS.into_iter().filter(|(f, _)| !fractions.contains(f)) {
                self.search_division(image, n, (fraction, at, Touch::Corners), inverted);
            }
        }
        self.runs_of_level = runs;
        if self.binariser.is_saturated() {
            let division = (FRACTION_SATURATED, Where::Saturated, Touch::Corners);
            self.search_division(image, n, division, inverted);
        }
        let most_dim = match (self.binariser.is_hazy(), finest) {
            (true, _) => 1.0,
            (false, false) => MOST_DIM,
            (false, true) => 0.0,
        };
        if (f32::MIN_POSITIVE..=most_dim).contains(&self.binariser.dim_share()) {
            self.search_division(image, n, (FRACTION_DIM, Where::AboveNoise, Touch::Corners), inverted);
        }
        match self.binariser.is_print() {
            true if is_busy => Look::BusyPrint,
            true => Look::Print,
            false if !is_busy && !finest => Look::Ground,
            false => Look::Whole,
        }
    }

    /// Appearance for tags among what is left of regions when those that touch by a corner alone are taken apart.
    fn search_parts(
        &mut self,
        image: ImageView<'_>,
        n: usize,
        fractions: &[u16],
        look: Look,
        inverted: bool,
    ) {
        if look == Look::Whole {
            return;
        }
        self.measure(image, n, inverted);
        // Higher up borders are thick, and hold together by their sides.
        let from = if look == Look::Ground { fractions.len() - 1 } else { 0 };
        for &fraction in &fractions[from..] {
            let at = Where::Everywhere;
            self.search_division(image, n, (fraction, at, Touch::Sides), inverted);
            if look == Look::BusyPrint {
                self.search_regions(image, n, at, Touch::Corners, inverted);
            }
        }
    }

    fn measure(&mut self, image: ImageView<'_>, n: usize, inverted: bool) {
        let level = self.pyramid.level(image, n);
        // Noise alone spans some five sigmas in the 144 pixels of a neighbourhood.
        let gate = (7.0 * self.noise / level.scale).clamp(LEAST_GATE, 60.0) as u8;
        self.binariser.measure(level.image, (gate, gate.max(CLEAR_GATE as u8)), inverted, self.simd);
    }

    /// Appearance for tags among the dark regions that one division into dark and light makes of a level.
    fn search_division(
        &mut self,
        image: ImageView<'_>,
        n: usize,
        (fraction, at, touch): (u16, Where, Touch),
        inverted: bool,
    ) {
        let level = self.pyramid.level(image, n).image;
        self.binariser.mark(level, fraction, at, &mut self.bits, self.simd);
        let is_dim = at == Where::AboveNoise && !self.binariser.is_hazy();
        let most = if is_dim { level.width * level.height / AREA_OF_RUN } else { usize::MAX };
        self.runs = self.bits.runs();
        if !(1..=most).contains(&self.runs) {
            return;
        }
        self.search_regions(image, n, at, touch, inverted);
    }

    /// Appearance for tags among the marked regions of a level.
    fn search_regions(&mut self, image: ImageView<'_>, n: usize, at: Where, touch: Touch, inverted: bool) {
        let Self { pyramid, bits, labeller, finder, refiner, found, tried, families, noise, .. } = self;
        let level = pyramid.level(image, n);
        let limits = SizeLimits { least: (self.min_px / level.scale).max(8.0), most: f32::MAX };
        let (width, height) = (level.image.width, level.image.height);
        labeller.label(bits, touch, self.simd, |c| may_be_border(c, limits, width, height));
        let (least_gate, least_share) =
            if at == Where::AboveNoise { (LEAST_GATE, 0.0) } else { (CLEAR_GATE, CLEAR_STEP) };
        let gate = (7.0 * *noise / level.scale).clamp(least_gate, 60.0) as u8;
        for (component, outline) in labeller.kept() {
            let Some(quad) = finder.quad(component, outline, limits) else { continue };
            let in_frame = quad.map(|p| p.map(|c| level.to_frame(c)));
            if found.iter().any(|f| same_place(&f.corners, &in_frame)) {
                continue;
            }
            let is_again =
                |t: &(usize, Quad)| t.0 == n && (0..4).all(|i| distance(t.1[i], quad[i]) < SAME_QUAD);
            if tried.iter().any(is_again) {
                continue;
            }
            let Some(straight) = straighten(level, &quad, gate, least_share) else { continue };
            tried.push((n, quad));
            // Of a small tag a side may be drawn to what is beside it: then as it was.
            let tag = [straight, in_frame].iter().find_map(|quad| {
                let mut families = families.iter().filter(|f| f.in_negative == inverted);
                families.find_map(|f| decode(image, pyramid, quad, f, (refiner, *noise)))
            });
            found.extend(tag);
        }
    }
}

fn negate(image: ImageView<'_>, to: &mut GrayImage) {
    (to.width, to.height, to.stride) = (image.width, image.height, image.width);
    to.data.clear();
    (0..image.height).for_each(|v| to.data.extend(image.row(v).iter().map(|p| !p)));
}
