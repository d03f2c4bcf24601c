//! Static ground features followed from frame to frame: corners found where nothing else is, tracked by
//! pyramidal Lucas–Kanade (Bouguet 2000), checked forwards and backwards, and held to the patch they were
//! born with so that they do not drift.

use nalgebra::Vector2;

use super::pyramid::{Base, Level, Pyramid};
use super::quad::bilinear;
use super::simd::Simd;
use crate::msg::{FeatureTrack, GrayImage, ImageView};

/// Half width of the patch compared, pixels of a level.
const HALF: usize = 6;
const SIDE: usize = 2 * HALF + 1;
const AREA: usize = SIDE * SIDE;

/// Coarsest level used: motions up to about 16 pixels a level are followed, 60 in all.
const LEVELS: usize = 4;

/// Tracks further apart than this after going there and back are dropped, pixels.
const MOST_RETURN_ERROR: f32 = 0.4;

/// Least correlation with the patch it was born with.
const LEAST_CORRELATION: f32 = 0.8;

/// A feature followed.
#[derive(Clone, Debug)]
struct Track {
    id: u64,
    at: [f32; 2],
    /// Grey levels around the place it was last anchored, row by row.
    patch: [f32; AREA],
    /// Error that re-anchoring has added up, px².
    drift: f32,
    sigma: f32,
}

/// Keeps a number of features alive; keeps its buffers.
#[derive(Clone, Debug)]
pub(super) struct FeatureTracker {
    wanted: usize,
    next_id: u64,
    tracks: Vec<Track>,
    frame: GrayImage,
    pyramid: Pyramid,
    before: GrayImage,
    before_pyramid: Pyramid,
    scores: Vec<f64>,
    /// The best corner of each part of the frame without a feature, and how good it is.
    corners: Vec<(f32, [f32; 2])>,
    simd: Simd,
}

/// A place that features keep off: centre and radius, pixels.
pub(super) type Circle = (Vector2<f64>, f64);

impl FeatureTracker {
    /// Keeps `wanted` features alive.
    pub fn new(wanted: usize) -> Self {
        Self {
            wanted,
            next_id: 0,
            tracks: Vec::with_capacity(wanted),
            frame: GrayImage::default(),
            pyramid: Pyramid::default(),
            before: GrayImage::default(),
            before_pyramid: Pyramid::default(),
            scores: Vec::new(),
            corners: Vec::new(),
            simd: Simd::best(),
        }
    }

    /// Follows the features into a frame and finds new ones off the `occupied` circles. A frame of another
    /// size than the last starts anew.
    pub fn process(&mut self, image: ImageView<'_>, occupied: &[Circle], out: &mut Vec<FeatureTrack>) {
        if self.wanted == 0 {
            return;
        }
        std::mem::swap(&mut self.frame, &mut self.before);
        std::mem::swap(&mut self.pyramid, &mut self.before_pyramid);
        copy(image, &mut self.frame);
        self.pyramid.build(self.frame.view(), Base::Half, 32, self.simd);
        if (self.before.width, self.before.height) == (image.width, image.height) {
            self.follow(occupied);
        } else {
            self.tracks.clear();
        }
        if self.tracks.len() < self.wanted {
            self.find(occupied);
        }
        out.extend(self.tracks.iter().map(|t| FeatureTrack {
            id: t.id,
            px: Vector2::new(f64::from(t.at[0]), f64::from(t.at[1])),
            sigma_px: f64::from((t.sigma * t.sigma + t.drift).sqrt()),
        }));
    }

    fn follow(&mut self, occupied: &[Circle]) {
        let now = Stack { frame: self.frame.view(), pyramid: &self.pyramid };
        let then = Stack { frame: self.before.view(), pyramid: &self.before_pyramid };
        self.tracks.retain_mut(|track| {
            let Some(guess) = carry(&then, &now, track.at) else { return false };
            let Some(back) = carry(&now, &then, guess) else { return false };
            let (du, dv) = (back[0] - track.at[0], back[1] - track.at[1]);
            let returned = (du * du + dv * dv).sqrt();
            if returned > MOST_RETURN_ERROR {
                return false;
            }
            let anchored = align(now.frame, &track.patch, guess)
                .filter(|a| a.correlation >= LEAST_CORRELATION && near(a.at, guess, 1.5));
            match anchored {
                Some(found) => {
                    track.at = found.at;
                    track.sigma = found.sigma;
                }
                None => {
                    // The ground looks different by now: go on from how it looked a frame ago.
                    track.patch = patch(then.frame, track.at);
                    let Some(found) = align(now.frame, &track.patch, guess) else { return false };
                    if found.correlation < LEAST_CORRELATION || !near(found.at, guess, 1.5) {
                        return false;
                    }
                    track.drift += track.sigma * track.sigma;
                    track.at = found.at;
                    track.sigma = found.sigma;
                }
            }
            inside(now.frame, track.at) && free(track.at, occupied)
        });
    }

    /// The best corner of each part of the frame that has no feature yet.
    fn find(&mut self, occupied: &[Circle]) {
        let level = self.pyramid.level(self.frame.view(), 2.min(self.pyramid.len() - 1));
        let (across, down) = (4, 3);
        let (w, h) = (level.image.width / across, level.image.height / down);
        if w < SIDE || h < SIDE {
            return;
        }
        self.corners.clear();
        for part in 0..across * down {
            let (u, v) = (part % across * w, part / across * h);
            let taken = self.tracks.iter().any(|t| {
                let (tu, tv) = (level.of_frame(t.at[0]), level.of_frame(t.at[1]));
                (tu as usize / w, tv as usize / h) == (part % across, part / across)
            });
            if !taken {
                self.corners.extend(best_corner(level, (u, v, w, h), occupied, &mut self.scores));
            }
        }
        self.corners.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
        for &(_, at) in &self.corners {
            if self.tracks.len() >= self.wanted {
                break;
            }
            let frame = self.frame.view();
            if inside(frame, at) && free(at, occupied) {
                let patch = patch(frame, at);
                let sigma = align(frame, &patch, at).map_or(0.1, |a| a.sigma);
                self.tracks.push(Track { id: self.next_id, at, patch, drift: 0.0, sigma });
                self.next_id += 1;
            }
        }
    }
}

struct Stack<'a> {
    frame: ImageView<'a>,
    pyramid: &'a Pyramid,
}

fn copy(image: ImageView<'_>, to: &mut GrayImage) {
    (to.width, to.height, to.stride) = (image.width, image.height, image.width);
    to.data.clear();
    (0..image.height).for_each(|v| to.data.extend_from_slice(image.row(v)));
}

fn near(a: [f32; 2], b: [f32; 2], radius: f32) -> bool {
    (a[0] - b[0]).abs() <= radius && (a[1] - b[1]).abs() <= radius
}

/// Whether a patch around a place lies within the image, with a margin for its gradients.
fn inside(image: ImageView<'_>, at: [f32; 2]) -> bool {
    let margin = (HALF + 2) as f32;
    at[0] >= margin
        && at[1] >= margin
        && at[0] + margin < image.width as f32
        && at[1] + margin < image.height as f32
}

fn free(at: [f32; 2], occupied: &[Circle]) -> bool {
    let p = Vector2::new(f64::from(at[0]), f64::from(at[1]));
    occupied.iter().all(|(center, radius)| (p - center).norm() > *radius)
}

/// Where a place in one frame is in another: coarse to fine.
fn carry(from: &Stack<'_>, to: &Stack<'_>, at: [f32; 2]) -> Option<[f32; 2]> {
    let levels = from.pyramid.len().min(to.pyramid.len()).min(LEVELS);
    let mut shift = [0.0, 0.0];
    for n in (0..levels).rev() {
        let (a, b) = (from.pyramid.level(from.frame, n), to.pyramid.level(to.frame, n));
        let here = at.map(|c| a.of_frame(c));
        let guess = [here[0] + shift[0] / b.scale, here[1] + shift[1] / b.scale];
        if !inside(a.image, here) || !inside(b.image, guess) {
            if n > 0 {
                continue;
            }
            return None;
        }
        let reference = patch(a.image, here);
        match align(b.image, &reference, guess) {
            Some(found) if found.correlation > 0.5 => {
                shift = [(found.at[0] - here[0]) * b.scale, (found.at[1] - here[1]) * b.scale];
            }
            _ if n > 0 => {}
            _ => return None,
        }
    }
    Some([at[0] + shift[0], at[1] + shift[1]])
}

fn patch(image: ImageView<'_>, at: [f32; 2]) -> [f32; AREA] {
    std::array::from_fn(|i| {
        let (x, y) = ((i % SIDE) as f32 - HALF as f32, (i / SIDE) as f32 - HALF as f32);
        bilinear(image, [at[0] + x, at[1] + y])
    })
}

/// A patch found in an image.
struct Aligned {
    at: [f32; 2],
    correlation: f32,
    sigma: f32,
}

/// Inverse compositional alignment of a patch, mean taken off (Baker and Matthews 2004).
fn align(image: ImageView<'_>, reference: &[f32; AREA], guess: [f32; 2]) -> Option<Aligned> {
    let (gx, gy) = gradients(reference);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (x, y) in gx.iter().zip(&gy) {
        xx += x * x;
        xy += x * y;
        yy += y * y;
    }
    let det = xx * yy - xy * xy;
    if !(det > 1e-3 * (xx + yy) * (xx + yy).max(1.0) * 0.04) {
        return None;
    }
    let mean = reference.iter().sum::<f32>() / AREA as f32;
    let mut at = guess;
    let mut here = [0.0; AREA];
    let mut here_mean = 0.0;
    for _ in 0..10 {
        if !inside(image, at) || !near(at, guess, 1.3 * HALF as f32) {
            return None;
        }
        here = patch(image, at);
        here_mean = here.iter().sum::<f32>() / AREA as f32;
        let (mut bx, mut by) = (0.0, 0.0);
        for i in 0..AREA {
            let e = (here[i] - here_mean) - (reference[i] - mean);
            bx += gx[i] * e;
            by += gy[i] * e;
        }
        let step = [(yy * bx - xy * by) / det, (xx * by - xy * bx) / det];
        at = [at[0] - step[0], at[1] - step[1]];
        if step[0].abs().max(step[1].abs()) < 0.01 {
            break;
        }
    }
    let (mut cross, mut a2, mut b2, mut residual) = (0.0, 0.0, 0.0, 0.0);
    for i in 0..AREA {
        let (a, b) = (here[i] - here_mean, reference[i] - mean);
        cross += a * b;
        a2 += a * a;
        b2 += b * b;
        residual += (a - b) * (a - b);
    }
    // σ² (JᵀJ)⁻¹, its larger axis, with σ² from what is left unexplained; and what interpolation leaves.
    let variance = residual / (AREA - 3) as f32;
    let half_trace = 0.5 * (xx + yy);
    let least = half_trace - (half_trace * half_trace - det).max(0.0).sqrt();
    let sigma = (variance / least.max(1e-6) + 0.03 * 0.03).sqrt();
    Some(Aligned { at, correlation: cross / (a2 * b2).sqrt().max(1e-6), sigma })
}

/// Central differences inside a patch; one-sided at its rim.
fn gradients(p: &[f32; AREA]) -> ([f32; AREA], [f32; AREA]) {
    let difference = |i: usize, k: usize, stride: usize| match k {
        0 => p[i + stride] - p[i],
        k if k == SIDE - 1 => p[i] - p[i - stride],
        _ => 0.5 * (p[i + stride] - p[i - stride]),
    };
    (
        std::array::from_fn(|i| difference(i, i % SIDE, 1)),
        std::array::from_fn(|i| difference(i, i / SIDE, SIDE)),
    )
}

/// The place in part `(u, v, w, h)` of a level with the largest smaller eigenvalue of the gradient matrix
/// (Shi and Tomasi 1994), in frame coordinates, off the occupied circles. Every second pixel is tried.
fn best_corner(
    level: Level<'_>,
    (u, v, w, h): (usize, usize, usize, usize),
    occupied: &[Circle],
    scores: &mut Vec<f64>,
) -> Option<(f32, [f32; 2])> {
    const REACH: usize = 3;
    let image = level.image;
    // Products of gradients, summed over squares through running sums along rows then columns.
    let margin = REACH + 1;
    let (u0, v0) = (u.max(margin), v.max(margin));
    let (u1, v1) = ((u + w).min(image.width - margin), (v + h).min(image.height - margin));
    if u0 >= u1 || v0 >= v1 {
        return None;
    }
    let (cols, rows) = (u1 - u0 + 2 * REACH, v1 - v0 + 2 * REACH);
    scores.clear();
    scores.resize(3 * cols * rows, 0.0);
    for y in 0..rows {
        let at = v0 - REACH + y;
        let (above, here, below) = (image.row(at - 1), image.row(at), image.row(at + 1));
        let mut sums = [0.0f64; 3];
        for x in 0..cols {
            let c = u0 - REACH + x;
            let gx = f64::from(here[c + 1]) - f64::from(here[c - 1]);
            let gy = f64::from(below[c]) - f64::from(above[c]);
            for (k, g) in [gx * gx, gx * gy, gy * gy].into_iter().enumerate() {
                sums[k] += g;
                let up = if y > 0 { scores[((y - 1) * cols + x) * 3 + k] } else { 0.0 };
                scores[(y * cols + x) * 3 + k] = up + sums[k];
            }
        }
    }
    let sum = |x: usize, y: usize, k: usize| {
        let s = |x: usize, y: usize| scores[(y * cols + x) * 3 + k];
        let d = 2 * REACH;
        let (left, top) = (x.checked_sub(1), y.checked_sub(1));
        s(x + d, y + d) - left.map_or(0.0, |l| s(l, y + d)) - top.map_or(0.0, |t| s(x + d, t))
            + left.zip(top).map_or(0.0, |(l, t)| s(l, t))
    };
    let mut best: Option<(f32, [f32; 2])> = None;
    for y in (0..v1 - v0).step_by(2) {
        for x in (0..u1 - u0).step_by(2) {
            let [xx, xy, yy] = [0, 1, 2].map(|k| sum(x, y, k) as f32);
            let half = 0.5 * (xx + yy);
            let least = half - (half * half - (xx * yy - xy * xy)).max(0.0).sqrt();
            if best.is_none_or(|b| least > b.0) && least > LEAST_CORNER {
                let at = [level.to_frame((u0 + x) as f32), level.to_frame((v0 + y) as f32)];
                if free(at, occupied) {
                    best = Some((least, at));
                }
            }
        }
    }
    best
}

/// Least smaller eigenvalue over 49 pixels, from differences two pixels apart: about six grey levels a pixel.
const LEAST_CORNER: f32 = 49.0 * 36.0 * 2.0;
