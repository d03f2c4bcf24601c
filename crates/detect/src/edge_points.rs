//! Where in the image the edges between a decoded tag's cells are, along their normals, and how the tag's parameters
//! move them; in single precision and in vectors, because there are many.

use super::quad::Point;
use super::simd::Kernel;
use windhover_base::msg::ImageView;

/// Number of parameters of a tag's model: a homography, a bow, a barrel, a twist, the effect of neighbouring cells on
/// edges along ξ and along η, and how far light spreads.
pub(super) const PARAMETERS: usize = 16;

/// Number of edges that are processed together, in loops that a compiler turns into vector instructions.
pub(super) const LANES: usize = 16;
pub(super) type Lanes = [f32; LANES];

/// A point on an edge between a dark and a light cell.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct EdgePoint {
    pub xi: f32,
    pub eta: f32,
    /// 1 where light is towards larger ξ or η, −1 where it is towards smaller.
    pub light: f32,
    /// 1 where the dark cell is one wide and the light one is not, −1 where it is the other way round.
    pub narrow: f32,
    /// The part of the tag in which it lies.
    pub block: u8,
}

/// Located edges, all crossed along ξ or all along η.
#[derive(Clone, Copy, Debug)]
pub(super) struct Located {
    /// ∂(distance along the normal)/∂parameters.
    pub rows: [Lanes; PARAMETERS],
    /// How far along the normal the image has the edge, pixels.
    pub residual: Lanes,
    /// Weight, inverse to its error; zero where no edge was found.
    pub strength: Lanes,
    /// Share of the edge's height that lies in its slope: 1 where the slope is narrow compared with the window, 0 where
    /// it fills the window.
    pub sharpness: Lanes,
    pub block: [u8; LANES],
    /// Crossed along ξ (0) or η (1).
    pub axis: usize,
    /// Number of edges found.
    pub count: usize,
}

/// The model in single precision, for the many edge points.
pub(super) struct NarrowModel {
    pub theta: [f32; PARAMETERS],
    pub sides: [Point; 2],
    pub origin: Point,
    /// 1 where light spreads from white cells, else 0.
    pub spreads: f32,
}

/// Edge points in the image: pixels, normals from dark to light, and how the parameters move them along the normals.
#[derive(Default)]
struct Projected {
    at: [Lanes; 2],
    normal: [Lanes; 2],
    /// How far neighbouring cells move the visible edge from there, along the normal.
    shift: Lanes,
    rows: [Lanes; PARAMETERS],
}

impl NarrowModel {
    #[inline(always)]
    fn project(&self, points: &[EdgePoint; LANES], axis: usize, to: &mut Projected) {
        let t = &self.theta;
        let [a, b] = self.sides;
        // Of the edge's own direction, to which the normal is perpendicular, and of the direction that crosses it.
        let (lx, ly) = if axis == 0 { (1.0, 0.0) } else { (0.0, 1.0) };
        let (xis, etas): (Lanes, Lanes) = (points.map(|p| p.xi), points.map(|p| p.eta));
        let lights: Lanes = points.map(|p| p.light);
        for lane in 0..LANES {
            let (xi, eta, light) = (xis[lane], etas[lane], lights[lane]);
            let w = 1.0 / (t[6] * xi + t[7] * eta + 1.0);
            let (u, v) = ((t[0] * xi + t[1] * eta + t[2]) * w, (t[3] * xi + t[4] * eta + t[5]) * w);
            let q = [xi * a[0] + eta * b[0], xi * a[1] + eta * b[1]];
            let far = q[0] * q[0] + q[1] * q[1] - 2.0;
            let bend = [t[8] + t[10] * q[0], t[9] + t[10] * q[1]];
            let (even, odd) = (q[0] * q[0] - q[1] * q[1], 2.0 * q[0] * q[1]);
            to.at[0][lane] = self.origin[0] + u + far * bend[0] + t[11] * even - t[12] * odd;
            to.at[1][lane] = self.origin[1] + v + far * bend[1] - t[11] * odd - t[12] * even;
            // Images of the directions of ξ and η; of the twist the effect is too small.
            let (farther_xi, farther_eta) =
                (2.0 * (q[0] * a[0] + q[1] * a[1]), 2.0 * (q[0] * b[0] + q[1] * b[1]));
            let bow = far * t[10];
            let d_xi = [
                (t[0] - u * t[6]) * w + farther_xi * bend[0] + bow * a[0],
                (t[3] - v * t[6]) * w + farther_xi * bend[1] + bow * a[1],
            ];
            let d_eta = [
                (t[1] - u * t[7]) * w + farther_eta * bend[0] + bow * b[0],
                (t[4] - v * t[7]) * w + farther_eta * bend[1] + bow * b[1],
            ];
            let along = [d_eta[0] * lx + d_xi[0] * ly, d_eta[1] * lx + d_xi[1] * ly];
            let towards = [d_xi[0] * lx + d_eta[0] * ly, d_xi[1] * lx + d_eta[1] * ly];
            let square = along[0] * along[0] + along[1] * along[1];
            let length = (if square > 1e-18 { square } else { 1e-18 }).sqrt();
            let side = (along[0] * towards[1] - along[1] * towards[0]) * light;
            let scale = if side < 0.0 { -1.0 / length } else { 1.0 / length };
            let n = [-along[1] * scale, along[0] * scale];
            (to.normal[0][lane], to.normal[1][lane]) = (n[0], n[1]);
            let across = -(u * n[0] + v * n[1]) * w;
            let (nx, ny) = (n[0] * w, n[1] * w);
            let rows = &mut to.rows;
            (rows[0][lane], rows[1][lane], rows[2][lane]) = (xi * nx, eta * nx, nx);
            (rows[3][lane], rows[4][lane], rows[5][lane]) = (xi * ny, eta * ny, ny);
            (rows[6][lane], rows[7][lane]) = (across * xi, across * eta);
            (rows[8][lane], rows[9][lane]) = (far * n[0], far * n[1]);
            rows[10][lane] = far * (q[0] * n[0] + q[1] * n[1]);
            let narrow = points[lane].narrow;
            (rows[11][lane], rows[12][lane]) = (even * n[0] - odd * n[1], -odd * n[0] - even * n[1]);
            (rows[13][lane], rows[14][lane]) = (narrow * lx, narrow * ly);
            rows[15][lane] = -self.spreads;
            to.shift[lane] = narrow * (lx * t[13] + ly * t[14]) - t[15];
        }
    }
}

/// Most places at which an edge's surroundings are sampled along its normal.
const MOST: usize = 15;

/// Least share of an edge's height in its slope that a step is divided by.
const LEAST_SLOPE: f32 = 0.25;

/// Least height of an edge in its window, grey levels.
const LEAST_HEIGHT: f32 = 3.0;

/// Places along the normals of edge points, `half` the half width of the window there.
struct Profile {
    half: f32,
    spacing: f32,
    reach: usize,
    /// Steps of grey levels from one place to the next.
    gradients: [Lanes; MOST - 1],
}

impl Profile {
    fn new(half: f32) -> Self {
        let spacing = (half * 0.25).max(0.5);
        let reach = ((half * 1.5 / spacing).ceil() as usize).min(MOST / 2);
        Self { half, spacing, reach, gradients: [[0.0; LANES]; MOST - 1] }
    }

    /// Samples the image along the normals; which of them lie in it, 1 or 0.
    #[inline(always)]
    fn sample(&mut self, image: ImageView<'_>, points: &Projected) -> Lanes {
        let (mut first, mut step) = ([[0.0; LANES]; 2], [[0.0; LANES]; 2]);
        let mut inside = [0.0; LANES];
        // A point is in the image where the pixel one further right and below is too.
        let (right, below) = (image.width as f32 - 1.01, image.height as f32 - 1.01);
        let reach = self.reach as f32;
        for lane in 0..LANES {
            let (du, dv) = (points.normal[0][lane] * self.spacing, points.normal[1][lane] * self.spacing);
            let (u, v) = (points.at[0][lane], points.at[1][lane]);
            let (us, vs) = ([u - reach * du, u + reach * du], [v - reach * dv, v + reach * dv]);
            let is_inside = (us[0] >= 0.0)
                & (us[1] >= 0.0)
                & (vs[0] >= 0.0)
                & (vs[1] >= 0.0)
                & (us[0] < right)
                & (us[1] < right)
                & (vs[0] < below)
                & (vs[1] < below);
            // A point outside is sampled in the corner and not used.
            first[0][lane] = if is_inside { us[0] } else { 0.0 };
            first[1][lane] = if is_inside { vs[0] } else { 0.0 };
            step[0][lane] = if is_inside { du } else { 0.0 };
            step[1][lane] = if is_inside { dv } else { 0.0 };
            inside[lane] = if is_inside { 1.0 } else { 0.0 };
        }
        if inside == [0.0; LANES] {
            return inside;
        }
        let mut before = bilinear(image, &first, &step, 0.0);
        for k in 0..2 * self.reach {
            let values = bilinear(image, &first, &step, (k + 1) as f32);
            for lane in 0..LANES {
                self.gradients[k][lane] = values[lane] - before[lane];
            }
            before = values;
        }
        inside
    }

    /// Where along the normal the image steps up, pixels, the strength of this result (inverse to its error; zero where
    /// there is no step), and the edge's sharpness: where the gradient is balanced under a biweight window (ψ(d) = d (1
    /// − d²/h²)²). A blurred edge is symmetric, and so is the window: the place is not biased by where the search
    /// began. An edge that motion has smeared over more than the window is level inside it; it is found by Newton's
    /// steps, not by the centre of mass, which would stay where the search began; the slope of its balance gives its
    /// accuracy.
    #[inline(always)]
    fn balance(&self, inside: &Lanes) -> (Lanes, Lanes, Lanes) {
        let (mut center, mut strength, mut sharpness) = ([0.0; LANES], *inside, [0.0; LANES]);
        let (per_half, most_step) = (1.0 / self.half, 0.5 * self.half);
        for _ in 0..3 {
            let (mut firsts, mut sums, mut slopes) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
            for (k, gradients) in self.gradients[..2 * self.reach].iter().enumerate() {
                let place = (k as f32 + 0.5 - self.reach as f32) * self.spacing;
                for lane in 0..LANES {
                    let d = place - center[lane];
                    let square = (d * per_half) * (d * per_half);
                    let taper = if square < 1.0 { 1.0 - square } else { 0.0 };
                    let weight = gradients[lane] * taper;
                    firsts[lane] += weight * taper * d;
                    sums[lane] += weight * taper;
                    slopes[lane] += weight * (taper - 4.0 * square);
                }
            }
            for lane in 0..LANES {
                let (sum, slope) = (sums[lane], slopes[lane]);
                let least = LEAST_SLOPE * sum;
                let step = firsts[lane] / if slope > least { slope } else { least };
                let step = if step > most_step { most_step } else { step };
                let moved = center[lane] + if step < -most_step { -most_step } else { step };
                let is_found = (sum > LEAST_HEIGHT)
                    & (strength[lane] != 0.0)
                    & (moved < 0.6 * self.half)
                    & (moved > -0.6 * self.half);
                center[lane] = if is_found { moved } else { 0.0 };
                strength[lane] = if is_found { slope } else { 0.0 };
                sharpness[lane] = if is_found { slope / sum } else { 0.0 };
            }
        }
        for strength in &mut strength {
            *strength = if *strength > 0.0 { *strength } else { 0.0 };
        }
        (center, strength, sharpness)
    }
}

/// Added to a number from 0 to 2²², it leaves the nearest whole number in the low bits.
const WHOLE: f32 = 12_582_912.0;

/// Pixel values between pixels, `along` steps from the first places.
#[inline(always)]
fn bilinear(image: ImageView<'_>, first: &[Lanes; 2], step: &[Lanes; 2], along: f32) -> Lanes {
    let (mut fu, mut fv, mut at) = ([0.0; LANES], [0.0; LANES], [0u32; LANES]);
    let stride = image.stride as u32;
    for lane in 0..LANES {
        let (u, v) = (first[0][lane] + along * step[0][lane], first[1][lane] + along * step[1][lane]);
        // The whole number below; where a place is exactly on a pixel, that one or the one before it.
        let (below_u, below_v) = (u - 0.5 + WHOLE, v - 0.5 + WHOLE);
        (fu[lane], fv[lane]) = (u - (below_u - WHOLE), v - (below_v - WHOLE));
        let [iu, iv] = [below_u, below_v].map(|x| x.to_bits().wrapping_sub(WHOLE.to_bits()));
        at[lane] = iv.wrapping_mul(stride).wrapping_add(iu);
    }
    let (mut above, mut below) = ([0i32; LANES], [0i32; LANES]);
    for lane in 0..LANES {
        let at = at[lane] as usize;
        let pair = |at: usize| {
            let pair = &image.data[at..at + 2];
            i32::from(u16::from_le_bytes([pair[0], pair[1]]))
        };
        (above[lane], below[lane]) = (pair(at), pair(at + image.stride));
    }
    let mut values = [0.0; LANES];
    for lane in 0..LANES {
        let both = |pair: i32| ((pair & 255) as f32, (pair >> 8) as f32);
        let ((a, b), (c, d)) = (both(above[lane]), both(below[lane]));
        let top = a + fu[lane] * (b - a);
        let bottom = c + fu[lane] * (d - c);
        values[lane] = top + fv[lane] * (bottom - top);
    }
    values
}

/// Finds the edge at each `every`-th point.
pub(super) struct Locate<'a> {
    /// On edges crossed along ξ, and along η.
    pub points: &'a [Vec<EdgePoint>; 2],
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
        let mut projected = Projected::default();
        for (axis, points) in self.points.iter().enumerate() {
            let mut profile = Profile::new(self.half[axis]);
            for chunk in points.chunks(LANES * self.every) {
                // Missing points of the last chunk are filled with its first point, which is not counted again.
                let lanes = std::array::from_fn(|lane| *chunk.get(lane * self.every).unwrap_or(&chunk[0]));
                self.model.project(&lanes, axis, &mut projected);
                let mut inside = profile.sample(self.image, &projected);
                inside[chunk.len().div_ceil(self.every)..].fill(0.0);
                if inside == [0.0; LANES] {
                    continue;
                }
                let (mut residual, strength, sharpness) = profile.balance(&inside);
                for lane in 0..LANES {
                    residual[lane] -= projected.shift[lane];
                }
                let count = strength.iter().filter(|s| **s > 0.0).count();
                let (rows, block) = (projected.rows, lanes.map(|p| p.block));
                if count > 0 {
                    self.located.push(Located { rows, residual, strength, sharpness, block, axis, count });
                }
            }
        }
    }
}
