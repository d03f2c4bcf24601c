//! Corners that can be followed: places where the picture changes in both directions (Shi and Tomasi 1994).

use super::pyramid::Level;
use super::simd::{Kernel, Simd};

/// Half width of the square over which gradients are summed, pixels of the level.
const REACH: usize = 3;
const SIDE: usize = 2 * REACH + 1;
/// Distance between places that are tried, in both directions, pixels.
const STEP: usize = 2;
/// Least smaller eigenvalue over the square, from differences two pixels apart: about six grey levels a pixel.
const LEAST: f32 = (SIDE * SIDE) as f32 * 36.0 * 2.0;

/// A part of a level: first column and row, width, height.
pub(super) type Part = (usize, usize, usize, usize);

/// A corner: how good it is, and where in the frame.
pub(super) type Corner = (f32, [f32; 2]);

/// The search's buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Corners {
    /// Products of the gradients along u and v: u u, u v, v v, row by row.
    products: [Vec<i32>; 3],
    /// Their sums over the rows of the square being tested.
    sums: [Vec<i32>; 3],
}

impl Corners {
    /// The place of a part of a level with the largest smaller eigenvalue of the gradients' matrix, of those that are
    /// `wanted` (given in frame coordinates).
    pub fn best(
        &mut self,
        level: Level<'_>,
        part: Part,
        simd: Simd,
        wanted: impl Fn([f32; 2]) -> bool,
    ) -> Option<Corner> {
        let mut best = None;
        simd.run(Search { corners: self, level, part, wanted, best: &mut best });
        best
    }
}

struct Search<'a, F> {
    corners: &'a mut Corners,
    level: Level<'a>,
    part: Part,
    wanted: F,
    best: &'a mut Option<Corner>,
}

impl<F: Fn([f32; 2]) -> bool> Kernel for Search<'_, F> {
    #[inline(always)]
    fn run(self) {
        let image = self.level.image;
        let (u, v, w, h) = self.part;
        let margin = REACH + 1;
        let (u0, v0) = (u.max(margin), v.max(margin));
        let (right, bottom) = (image.width.saturating_sub(margin), image.height.saturating_sub(margin));
        let (u1, v1) = ((u + w).min(right), (v + h).min(bottom));
        if u0 >= u1 || v0 >= v1 {
            return;
        }
        let (cols, rows) = (u1 - u0 + 2 * REACH, v1 - v0 + 2 * REACH);
        let Corners { products, sums } = self.corners;
        for plane in products.iter_mut() {
            plane.resize(cols * rows, 0);
        }
        for sum in sums.iter_mut() {
            sum.clear();
            sum.resize(cols, 0);
        }
        let [uu, uv, vv] = products;
        for y in 0..rows {
            let at = v0 - REACH + y;
            let part = |v: usize, from: usize| &image.row(v)[from..from + cols];
            let left = u0 - REACH;
            let (before, after) = (part(at, left - 1), part(at, left + 1));
            let (above, below) = (part(at - 1, left), part(at + 1, left));
            let line = y * cols..(y + 1) * cols;
            let (uu, uv, vv) = (&mut uu[line.clone()], &mut uv[line.clone()], &mut vv[line]);
            for x in 0..cols {
                let gu = i32::from(after[x]) - i32::from(before[x]);
                let gv = i32::from(below[x]) - i32::from(above[x]);
                (uu[x], uv[x], vv[x]) = (gu * gu, gu * gv, gv * gv);
            }
        }
        for y in 0..rows {
            for (sum, plane) in sums.iter_mut().zip([&*uu, &*uv, &*vv]) {
                let new = &plane[y * cols..(y + 1) * cols];
                sum.iter_mut().zip(new).for_each(|(s, p)| *s += p);
                if y >= SIDE {
                    let old = &plane[(y - SIDE) * cols..(y - SIDE + 1) * cols];
                    sum.iter_mut().zip(old).for_each(|(s, p)| *s -= p);
                }
            }
            let Some(row) = (y + 1).checked_sub(SIDE).filter(|row| row % STEP == 0) else { continue };
            for x in (0..u1 - u0).step_by(STEP) {
                let [uu, uv, vv] = [0, 1, 2].map(|k| sums[k][x..x + SIDE].iter().sum::<i32>() as f32);
                let half = 0.5 * (uu + vv);
                let least = half - (half * half - (uu * vv - uv * uv)).max(0.0).sqrt();
                if least > self.best.map_or(LEAST, |b| b.0) {
                    let to_frame = |c: usize| self.level.to_frame(c as f32);
                    let at = [to_frame(u0 + x), to_frame(v0 + row)];
                    if (self.wanted)(at) {
                        *self.best = Some((least, at));
                    }
                }
            }
        }
    }
}
