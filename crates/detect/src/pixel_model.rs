//! What the pixels of a decoded tag show by a model of its print, and what the model's parameters change; in single
//! precision and in vectors, because there are many.
//!
//! A pixel at p, the image of the tag's point q = (ξ, η), shows `I = o(q) + g(q) L(q) + h G(q)`: o and g are linear in q
//! (light that falls off across the tag), L is the share of light cells under the pixel's blur and G that of cells whose
//! colour is not known, the ground's. Blur is Gaussian, with one sigma across edges crossed along ξ and one across those
//! crossed along η, so that a cell's share is a product of two differences of normal distributions. Their covariance c
//! (motion aslant) adds `c ∂²L/∂x∂y`, to first order.

use super::edge_points::{LANES, Lanes};
use super::pixel_patterns::Patterns;
use super::quad::Point;

/// Parameters: the homography's eight and the lens's five, as in `tag_model.rs`, two sigmas of the blur and their covariance,
/// the light of black, by how much white is lighter, and the ground's light over black. Each constant is a group's first
/// index.
pub(super) const LENS: usize = 8;
pub(super) const BLUR: usize = LENS + 5;
pub(super) const DARK: usize = BLUR + 3;
pub(super) const RANGE: usize = DARK + 3;
pub(super) const GROUND: usize = RANGE + 3;
pub(super) const UNKNOWNS: usize = GROUND + 1;

/// Most cells on a side that lie under a pixel's blur.
const MOST_CELLS: usize = 5;

/// Pixels that are processed together.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pixels {
    /// Places from the model's origin, pixels.
    pub at: [Lanes; 2],
    /// Grey levels.
    pub seen: Lanes,
    /// 1, or 0 in lanes without a pixel; these repeat the first.
    pub used: Lanes,
    /// The part of the tag in which each lies.
    pub block: [u8; LANES],
    pub count: usize,
}

impl Pixels {
    pub fn first(at: [f32; 2], seen: f32, block: u8) -> Self {
        let mut used = [0.0; LANES];
        used[0] = 1.0;
        Self { at: at.map(|c| [c; LANES]), seen: [seen; LANES], used, block: [block; LANES], count: 1 }
    }

    pub fn push(&mut self, at: [f32; 2], seen: f32, block: u8) {
        let lane = self.count;
        (self.at[0][lane], self.at[1][lane]) = (at[0], at[1]);
        (self.seen[lane], self.used[lane], self.block[lane]) = (seen, 1.0, block);
        self.count += 1;
    }
}

/// The parameters, the tag's half sides over their mean length, and the homography's inverse, row by row.
#[derive(Clone, Copy, Debug)]
pub(super) struct NarrowState {
    pub theta: [f32; UNKNOWNS],
    pub sides: [Point; 2],
    pub back: [f32; 9],
}

impl NarrowState {
    /// ξ and η at a pixel, without the lens.
    #[inline(always)]
    pub fn tag_point(&self, u: f32, v: f32) -> [f32; 2] {
        let m = &self.back;
        let z = 1.0 / (m[6] * u + m[7] * v + m[8]);
        [(m[0] * u + m[1] * v + m[2]) * z, (m[3] * u + m[4] * v + m[5]) * z]
    }

    /// By what the lens's parameters are multiplied at a tag point: bow, barrel along u and v, twist.
    #[inline(always)]
    fn bends(&self, [xi, eta]: [f32; 2]) -> Bends {
        let [a, b] = self.sides;
        let q = [xi * a[0] + eta * b[0], xi * a[1] + eta * b[1]];
        let bow = q[0] * q[0] + q[1] * q[1] - 2.0;
        Bends {
            bow,
            barrel: [bow * q[0], bow * q[1]],
            even: q[0] * q[0] - q[1] * q[1],
            odd: 2.0 * q[0] * q[1],
        }
    }

    /// By how much the lens moves what is at a tag point, pixels.
    #[inline(always)]
    fn bent(&self, at: [f32; 2]) -> [f32; 2] {
        let (t, k) = (&self.theta[LENS..], self.bends(at));
        [
            t[0] * k.bow + t[2] * k.barrel[0] + t[3] * k.even - t[4] * k.odd,
            t[1] * k.bow + t[2] * k.barrel[1] - t[3] * k.odd - t[4] * k.even,
        ]
    }
}

/// The lens's effects at a tag point, each for a parameter of one pixel.
struct Bends {
    bow: f32,
    barrel: [f32; 2],
    even: f32,
    odd: f32,
}

/// What some pixels show, and from what it was computed.
#[derive(Clone, Debug)]
pub(super) struct Shown {
    /// ∂I/∂parameters.
    pub rows: [Lanes; UNKNOWNS],
    /// Seen less shown, grey levels.
    pub residual: Lanes,
    q: [Lanes; 2],
    /// Where pixels would be without the lens.
    at: [Lanes; 2],
    /// Cells from the border's corner, then from the corner of the cell in which a pixel lies.
    cell: [Lanes; 2],
    /// ∂x/∂u, ∂x/∂v, ∂y/∂u, ∂y/∂v, in cells a pixel.
    slope: [[Lanes; 2]; 2],
    /// Lengths of the rows of that.
    length: [Lanes; 2],
    bits: [[u32; LANES]; 2],
    shares: [Shares; 2],
    sums: [Sums; 2],
}

impl Default for Shown {
    fn default() -> Self {
        let none = [0.0; LANES];
        Self {
            rows: [none; UNKNOWNS],
            residual: none,
            q: [none; 2],
            at: [none; 2],
            cell: [none; 2],
            slope: [[none; 2]; 2],
            length: [none; 2],
            bits: [[0; LANES]; 2],
            shares: [Shares::default(), Shares::default()],
            sums: [[none; 6]; 2],
        }
    }
}

impl Shown {
    /// What pixels show, with `N` cells a side (3 or 5) under the blur of a pixel.
    #[inline(always)]
    pub fn show<const N: usize>(&mut self, state: &NarrowState, patterns: &Patterns, pixels: &Pixels) {
        self.place(state, pixels, 0.5 * patterns.width);
        patterns.look_up(&mut self.cell, &mut self.bits);
        for k in 0..2 {
            self.shares[k].fill::<N>(&self.cell[k], &self.length[k], state.theta[BLUR + k]);
        }
        sum_shares::<N>(&self.bits[0], &self.shares, &mut self.sums[0]);
        if self.bits[1] == [0; LANES] {
            self.sums[1] = [[0.0; LANES]; 6];
        } else {
            sum_shares::<N>(&self.bits[1], &self.shares, &mut self.sums[1]);
        }
        self.light(state, pixels);
    }

    /// Tag points of the pixels.
    #[inline(always)]
    fn place(&mut self, state: &NarrowState, pixels: &Pixels, half: f32) {
        let m = &state.back;
        for lane in 0..LANES {
            let (u, v) = (pixels.at[0][lane], pixels.at[1][lane]);
            // The lens moves so little that it does not matter whether it is asked for here or beside.
            let bent = state.bent(state.tag_point(u, v));
            let (u, v) = (u - bent[0], v - bent[1]);
            (self.at[0][lane], self.at[1][lane]) = (u, v);
            let z = 1.0 / (m[6] * u + m[7] * v + m[8]);
            let (xi, eta) = ((m[0] * u + m[1] * v + m[2]) * z, (m[3] * u + m[4] * v + m[5]) * z);
            (self.q[0][lane], self.q[1][lane]) = (xi, eta);
            (self.cell[0][lane], self.cell[1][lane]) = ((xi + 1.0) * half, (eta + 1.0) * half);
            let z = z * half;
            let (x_u, x_v) = ((m[0] - xi * m[6]) * z, (m[1] - xi * m[7]) * z);
            let (y_u, y_v) = ((m[3] - eta * m[6]) * z, (m[4] - eta * m[7]) * z);
            (self.slope[0][0][lane], self.slope[0][1][lane]) = (x_u, x_v);
            (self.slope[1][0][lane], self.slope[1][1][lane]) = (y_u, y_v);
            self.length[0][lane] = (x_u * x_u + x_v * x_v).sqrt();
            self.length[1][lane] = (y_u * y_u + y_v * y_v).sqrt();
        }
    }

    /// Residuals and rows, from the shares of light and ground.
    #[inline(always)]
    fn light(&mut self, state: &NarrowState, pixels: &Pixels) {
        let t = &state.theta;
        let Self { rows, residual, q, at, slope, length, sums: [lit, ground], .. } = self;
        for lane in 0..LANES {
            let (xi, eta) = (q[0][lane], q[1][lane]);
            let dark = t[DARK] + t[DARK + 1] * xi + t[DARK + 2] * eta;
            let range = t[RANGE] + t[RANGE + 1] * xi + t[RANGE + 2] * eta;
            let of = |k: usize| range * lit[k][lane] + t[GROUND] * ground[k][lane];
            let (dx, dy) = (of(1), of(2));
            let both = length[0][lane] * length[1][lane];
            let aslant = t[BLUR + 2] * both;
            let by_u = -(slope[0][0][lane] * dx + slope[1][0][lane] * dy);
            let by_v = -(slope[0][1][lane] * dx + slope[1][1][lane] * dy);
            let w = 1.0 / (t[6] * xi + t[7] * eta + 1.0);
            let (nu, nv) = (by_u * w, by_v * w);
            let across = -(nu * at[0][lane] + nv * at[1][lane]);
            (rows[0][lane], rows[1][lane], rows[2][lane]) = (nu * xi, nu * eta, nu);
            (rows[3][lane], rows[4][lane], rows[5][lane]) = (nv * xi, nv * eta, nv);
            (rows[6][lane], rows[7][lane]) = (across * xi, across * eta);
            let k = state.bends([xi, eta]);
            (rows[LENS][lane], rows[LENS + 1][lane]) = (k.bow * by_u, k.bow * by_v);
            rows[LENS + 2][lane] = k.barrel[0] * by_u + k.barrel[1] * by_v;
            rows[LENS + 3][lane] = k.even * by_u - k.odd * by_v;
            rows[LENS + 4][lane] = -k.odd * by_u - k.even * by_v;
            rows[BLUR][lane] = of(3) * length[0][lane];
            rows[BLUR + 1][lane] = of(4) * length[1][lane];
            rows[BLUR + 2][lane] = of(5) * both;
            let (light, unknown) =
                (lit[0][lane] + aslant * lit[5][lane], ground[0][lane] + aslant * ground[5][lane]);
            (rows[DARK][lane], rows[DARK + 1][lane], rows[DARK + 2][lane]) = (1.0, xi, eta);
            (rows[RANGE][lane], rows[RANGE + 1][lane], rows[RANGE + 2][lane]) =
                (light, light * xi, light * eta);
            rows[GROUND][lane] = unknown;
            residual[lane] = pixels.seen[lane] - dark - range * light - t[GROUND] * unknown;
        }
    }
}

/// The shares of up to five cells along an axis under the blur, and their slopes along the axis and with the sigma in
/// cells.
#[derive(Clone, Debug, Default)]
struct Shares {
    share: [Lanes; MOST_CELLS],
    along: [Lanes; MOST_CELLS],
    wider: [Lanes; MOST_CELLS],
}

impl Shares {
    /// For places within the middle one of `N` cells; the outermost take what is beyond them too.
    #[inline(always)]
    fn fill<const N: usize>(&mut self, from: &Lanes, length: &Lanes, sigma: f32) {
        let none = [0.0; LANES];
        (self.share[N - 1], self.along[N - 1], self.wider[N - 1]) = (none, none, none);
        for k in 0..N - 1 {
            let edge = k as f32 - (N as f32 - 3.0) / 2.0;
            for lane in 0..LANES {
                let per = 1.0 / (sigma * length[lane]);
                let t = (from[lane] - edge) * per;
                let (below, density) = normal(t);
                let density = density * per;
                (self.share[k][lane], self.along[k][lane]) = (below, density);
                self.wider[k][lane] = -t * density;
            }
        }
        for lane in 0..LANES {
            let (mut share, mut along, mut wider) = (1.0, 0.0, 0.0);
            for k in 0..N {
                let after = (self.share[k][lane], self.along[k][lane], self.wider[k][lane]);
                self.share[k][lane] = share - after.0;
                self.along[k][lane] = along - after.1;
                self.wider[k][lane] = wider - after.2;
                (share, along, wider) = after;
            }
        }
    }
}

/// The share of some cells in a pixel, its slopes along either axis and with either sigma, and that along both.
type Sums = [Lanes; 6];

/// Sums over the cells whose bits are set.
#[inline(always)]
fn sum_shares<const N: usize>(bits: &[u32; LANES], [across, down]: &[Shares; 2], sums: &mut Sums) {
    *sums = [[0.0; LANES]; 6];
    let first = (MOST_CELLS - N) / 2;
    for j in 0..N {
        let (mut share, mut along, mut wider) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
        for i in 0..N {
            let bit = MOST_CELLS * (first + j) + first + i;
            for lane in 0..LANES {
                let is_set = (bits[lane] >> bit & 1) as i32 as f32;
                share[lane] += is_set * across.share[i][lane];
                along[lane] += is_set * across.along[i][lane];
                wider[lane] += is_set * across.wider[i][lane];
            }
        }
        for lane in 0..LANES {
            sums[0][lane] += share[lane] * down.share[j][lane];
            sums[1][lane] += along[lane] * down.share[j][lane];
            sums[2][lane] += share[lane] * down.along[j][lane];
            sums[3][lane] += wider[lane] * down.share[j][lane];
            sums[4][lane] += share[lane] * down.wider[j][lane];
            sums[5][lane] += along[lane] * down.along[j][lane];
        }
    }
}

/// How much of a normal distribution is below `t`, to 2.5e-4, and the slope of that (Abramowitz and Stegun 26.2.18).
#[inline(always)]
fn normal(t: f32) -> (f32, f32) {
    const C: [f32; 4] = [0.196_854, 0.115_194, 0.000_344, 0.019_527];
    let x = if t < 0.0 { -t } else { t };
    let p = 1.0 + x * (C[0] + x * (C[1] + x * (C[2] + x * C[3])));
    let slope = C[0] + x * (2.0 * C[1] + x * (3.0 * C[2] + x * 4.0 * C[3]));
    let per = 1.0 / p;
    let above = 0.5 * (per * per) * (per * per);
    (if t < 0.0 { above } else { 1.0 - above }, 4.0 * slope * above * per)
}
