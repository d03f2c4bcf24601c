//! Where in the image the edges between a decoded tag's cells are, along their normals, and what the tag's
//! parameters do there; in single precision, for there are many.

use super::quad::Point;
use super::simd::Kernel;
use crate::msg::ImageView;

/// Of a tag's model: a homography, a bow and a barrel.
pub(super) const PARAMETERS: usize = 11;
/// `PARAMETERS` in whole vector registers.
pub(super) const PADDED: usize = 12;

/// A point on an edge between a dark and a light cell.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct EdgePoint {
    pub xi: f32,
    pub eta: f32,
    /// From dark to light in tag coordinates.
    pub light: [f32; 2],
    /// Which part of the tag it is in.
    pub block: u8,
}

/// One located edge: `residual` px along the normal, ∂/∂parameters (padded), weight.
#[derive(Clone, Copy, Debug)]
pub(super) struct Located {
    pub row: [f32; PADDED],
    pub residual: f32,
    pub strength: f32,
    /// Share of the edge's height in its slope: 1 where it is narrow against the window, 0 where it fills it.
    pub sharpness: f32,
    /// Crossed along ξ (0) or η (1).
    pub axis: usize,
    pub block: u8,
}

/// The model in single precision, for the many edge points.
pub(super) struct NarrowModel {
    pub theta: [f32; PARAMETERS],
    pub sides: [Point; 2],
    pub origin: Point,
}

impl NarrowModel {
    /// An edge point's pixel, the normal of the edge there from dark to light, and what the parameters do along
    /// that normal.
    #[inline(always)]
    fn edge_at(&self, point: &EdgePoint) -> (Point, Point, [f32; PADDED]) {
        let (t, xi, eta) = (&self.theta, point.xi, point.eta);
        let [a, b] = self.sides;
        let w = 1.0 / (t[6] * xi + t[7] * eta + 1.0);
        let (u, v) = ((t[0] * xi + t[1] * eta + t[2]) * w, (t[3] * xi + t[4] * eta + t[5]) * w);
        let q = [xi * a[0] + eta * b[0], xi * a[1] + eta * b[1]];
        let far = q[0] * q[0] + q[1] * q[1] - 2.0;
        let bend = [t[8] + t[10] * q[0], t[9] + t[10] * q[1]];
        let p = [self.origin[0] + u + far * bend[0], self.origin[1] + v + far * bend[1]];
        // Images of the directions of ξ and η; the normal is across the one in which the edge runs.
        let bent = |side: Point| {
            let farther = 2.0 * (q[0] * side[0] + q[1] * side[1]);
            [0, 1].map(|k| farther * bend[k] + far * t[10] * side[k])
        };
        let (bent_xi, bent_eta) = (bent(a), bent(b));
        let d_xi = [(t[0] - u * t[6]) * w + bent_xi[0], (t[3] - v * t[6]) * w + bent_xi[1]];
        let d_eta = [(t[1] - u * t[7]) * w + bent_eta[0], (t[4] - v * t[7]) * w + bent_eta[1]];
        let [lx, ly] = point.light;
        let along = [d_eta[0] * lx - d_xi[0] * ly, d_eta[1] * lx - d_xi[1] * ly];
        let towards = [d_xi[0] * lx + d_eta[0] * ly, d_xi[1] * lx + d_eta[1] * ly];
        let length = (along[0] * along[0] + along[1] * along[1]).sqrt().max(1e-9);
        let side = along[0] * towards[1] - along[1] * towards[0];
        let scale = if side < 0.0 { -1.0 / length } else { 1.0 / length };
        let n = [-along[1] * scale, along[0] * scale];
        let across = -(u * n[0] + v * n[1]) * w;
        let (nx, ny) = (n[0] * w, n[1] * w);
        let row = [
            xi * nx,
            eta * nx,
            nx,
            xi * ny,
            eta * ny,
            ny,
            across * xi,
            across * eta,
            far * n[0],
            far * n[1],
            far * (q[0] * n[0] + q[1] * n[1]),
            0.0,
        ];
        (p, n, row)
    }
}

/// Where along `n` from `p` the image steps up, pixels, and how well that is known (inverse to its error): where
/// the gradient is balanced under a biweight window of half width `half` (ψ(d) = d (1 − d²/h²)²). A blurred
/// edge is symmetric, and so is the window: the place is not biased by where the search began. An edge that
/// motion has smeared over more than the window is level inside it; it is found by Newton's steps, not by
/// the centre of mass, which would stay where it was put, and the slope of its balance tells what it is worth.
#[inline(always)]
fn edge_offset(image: ImageView<'_>, p: Point, n: Point, half: f32) -> Option<(f32, f32, f32)> {
    const MOST: usize = 16;
    let spacing = (half * 0.25).max(0.5);
    let reach = ((half * 1.5 / spacing).ceil() as usize).min(MOST / 2 - 1);
    let count = 2 * reach + 1;
    let step = [n[0] * spacing, n[1] * spacing];
    let start = [p[0] - reach as f32 * step[0], p[1] - reach as f32 * step[1]];
    let end = [p[0] + reach as f32 * step[0], p[1] + reach as f32 * step[1]];
    if !(is_inside(image, start) && is_inside(image, end)) {
        return None;
    }
    let mut gradients = [0.0f32; MOST];
    let mut before = sample(image, start);
    for (k, gradient) in gradients.iter_mut().enumerate().take(count - 1) {
        let along = (k + 1) as f32;
        let value = sample(image, [start[0] + along * step[0], start[1] + along * step[1]]);
        *gradient = value - before;
        before = value;
    }
    let (mut center, mut strength, mut sharpness) = (0.0f32, 0.0f32, 0.0f32);
    let per_half = 1.0 / half;
    for _ in 0..3 {
        // Eight sums side by side, so that they fit vector registers.
        let (mut firsts, mut sums, mut slopes) = ([0.0f32; LANES], [0.0f32; LANES], [0.0f32; LANES]);
        for (chunk, gradients) in gradients.chunks_exact(LANES).enumerate() {
            for lane in 0..LANES {
                let d = ((chunk * LANES + lane) as f32 + 0.5 - reach as f32) * spacing - center;
                let square = (d * per_half) * (d * per_half);
                let taper = (1.0 - square).max(0.0);
                let weight = gradients[lane] * taper;
                firsts[lane] += weight * taper * d;
                sums[lane] += weight * taper;
                slopes[lane] += weight * (taper - 4.0 * square);
            }
        }
        let (first, sum) = (total(firsts), total(sums));
        if !(sum > 3.0) {
            return None;
        }
        strength = total(slopes);
        sharpness = strength / sum;
        center += (first / strength.max(LEAST_SLOPE * sum)).clamp(-0.5 * half, 0.5 * half);
        if center.abs() > 0.6 * half {
            return None;
        }
    }
    (strength > 0.0).then_some((center, strength, sharpness))
}

/// Least share of an edge's height in its slope that a step is divided by.
const LEAST_SLOPE: f32 = 0.25;

const LANES: usize = 8;

#[inline(always)]
fn total(x: [f32; LANES]) -> f32 {
    let four: [f32; 4] = std::array::from_fn(|i| x[i] + x[i + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

/// Finds the edge at each `every`-th point.
pub(super) struct Locate<'a> {
    pub points: &'a [EdgePoint],
    pub located: &'a mut Vec<Located>,
    pub image: ImageView<'a>,
    pub model: NarrowModel,
    /// Half widths of the window for edges that are crossed along ξ and along η, pixels.
    pub half: [f32; 2],
    pub every: usize,
}

impl Kernel for Locate<'_> {
    #[inline(always)]
    fn run(self) {
        self.located.clear();
        for point in self.points.iter().step_by(self.every) {
            let (p, n, row) = self.model.edge_at(point);
            let axis = usize::from(point.light[0] == 0.0);
            if let Some((residual, strength, sharpness)) = edge_offset(self.image, p, n, self.half[axis]) {
                let block = point.block;
                self.located.push(Located { row, residual, strength, sharpness, axis, block });
            }
        }
    }
}

/// Whether a point and one a pixel further right and below are in the image.
#[inline(always)]
fn is_inside(image: ImageView<'_>, [u, v]: Point) -> bool {
    u >= 0.0 && v >= 0.0 && u < image.width as f32 - 1.01 && v < image.height as f32 - 1.01
}

/// Bilinear pixel value at a point that `is_inside`.
#[inline(always)]
fn sample(image: ImageView<'_>, [u, v]: Point) -> f32 {
    let (iu, iv) = (u as i32, v as i32);
    let (fu, fv) = (u - iu as f32, v - iv as f32);
    let at = iv as usize * image.stride + iu as usize;
    let block = &image.data[at..at + image.stride + 2];
    let (above, below) =
        ([block[0], block[1]].map(f32::from), [block[image.stride], block[image.stride + 1]].map(f32::from));
    let top = above[0] + fu * (above[1] - above[0]);
    let bottom = below[0] + fu * (below[1] - below[0]);
    top + fv * (bottom - top)
}
