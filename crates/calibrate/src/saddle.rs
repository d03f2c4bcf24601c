//! Saddle points of an image's brightness: where four squares of a board meet.

use nalgebra::{Matrix2, Vector2};

use windhover_base::msg::ImageView;

/// A single-channel image of floats, rows packed.
#[derive(Clone, Debug)]
pub(super) struct FloatImage {
    pub(super) width: usize,
    pub(super) height: usize,
    data: Vec<f32>,
}

impl FloatImage {
    pub(super) fn of(image: ImageView<'_>) -> Self {
        let data = (0..image.height).flat_map(|v| image.row(v).iter().map(|&p| f32::from(p))).collect();
        Self { width: image.width, height: image.height, data }
    }

    pub(super) fn at(&self, u: usize, v: usize) -> f32 {
        self.data[v * self.width + u]
    }

    /// Bilinear value; `None` outside the centres of the outermost pixels.
    pub(super) fn sample(&self, px: Vector2<f64>) -> Option<f64> {
        if !(px.x >= 0.0 && px.y >= 0.0) {
            return None;
        }
        let (u, v) = (px.x as usize, px.y as usize);
        if u + 1 >= self.width || v + 1 >= self.height {
            return None;
        }
        let (a, b) = (px.x - u as f64, px.y - v as f64);
        let value = |du: usize, dv: usize| f64::from(self.at(u + du, v + dv));
        let upper = value(0, 0) * (1.0 - a) + value(1, 0) * a;
        let lower = value(0, 1) * (1.0 - a) + value(1, 1) * a;
        Some(upper * (1.0 - b) + lower * b)
    }

    /// Distance from a point to the border, pixels; negative outside.
    pub(super) fn to_border(&self, px: Vector2<f64>) -> f64 {
        let (right, bottom) = (self.width as f64 - 1.0 - px.x, self.height as f64 - 1.0 - px.y);
        px.x.min(px.y).min(right).min(bottom)
    }

    /// Half the size: each pixel the mean of four. Its pixel (u, v) is at (2u + ½, 2v + ½) here.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut data = Vec::with_capacity(width * height);
        for v in 0..height {
            for u in 0..width {
                let sum = self.at(2 * u, 2 * v)
                    + self.at(2 * u + 1, 2 * v)
                    + self.at(2 * u, 2 * v + 1)
                    + self.at(2 * u + 1, 2 * v + 1);
                data.push(0.25 * sum);
            }
        }
        Self { width, height, data }
    }

    /// Blurred by a Gaussian of `sigma` pixels; the border repeats.
    pub(super) fn blurred(&self, sigma: f64) -> Self {
        let radius = (3.0 * sigma).ceil() as isize;
        let weights: Vec<f32> = {
            let raw: Vec<f64> =
                (-radius..=radius).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
            let sum: f64 = raw.iter().sum();
            raw.iter().map(|w| (w / sum) as f32).collect()
        };
        let clamp = |k: isize, n: usize| k.clamp(0, n as isize - 1) as usize;
        let mut along_rows = vec![0f32; self.data.len()];
        for v in 0..self.height {
            let row = &self.data[v * self.width..(v + 1) * self.width];
            for u in 0..self.width {
                let taps = (-radius..=radius).map(|k| row[clamp(u as isize + k, self.width)]);
                along_rows[v * self.width + u] = taps.zip(&weights).map(|(p, w)| p * w).sum();
            }
        }
        let mut data = vec![0f32; self.data.len()];
        for v in 0..self.height {
            let out = &mut data[v * self.width..(v + 1) * self.width];
            for (k, &w) in (-radius..=radius).zip(&weights) {
                let from = clamp(v as isize + k, self.height) * self.width;
                for (o, p) in out.iter_mut().zip(&along_rows[from..from + self.width]) {
                    *o += w * p;
                }
            }
        }
        Self { width: self.width, height: self.height, data }
    }
}

/// A point where two edges cross, with light and dark alternating around it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Saddle {
    /// Its place, pixels.
    pub(super) px: Vector2<f64>,
    /// Directions (radians, u toward v) of the four edges outward, ascending around the circle.
    pub(super) edges: [f64; 4],
    /// Whether it gets lighter across the first edge as the direction grows; the others alternate.
    pub(super) first_rises: bool,
}

/// Samples on the ring around a candidate.
const RING: usize = 40;
/// Least difference from the centre, grey levels, in each of the four quarters around a saddle.
const LEAST_CONTRAST: f64 = 3.0;
/// Least contrast of the weakest quarter, as a share of the strongest.
const LEAST_BALANCE: f64 = 0.2;
/// Largest deviation of opposite edges from a straight line, radians.
const MOST_BEND: f64 = 0.45;
/// Least angle between neighbouring edges, radians.
const LEAST_SECTOR: f64 = 0.30;
/// Response of the weakest examined candidate, as a share of the strongest: a board half in deep shadow has a tenth of
/// the contrast there, and the response is proportional to its square.
const LEAST_RESPONSE: f32 = 0.002;
/// Most candidates that are examined closely.
const MOST_CANDIDATES: usize = 4_000;

impl Saddle {
    /// The saddle at `px` of a blurred image, examined on a ring of `radius` pixels; `None` where the ring does not
    /// show two straight crossing edges.
    pub(super) fn at(blurred: &FloatImage, px: Vector2<f64>, radius: f64) -> Option<Self> {
        let center = blurred.sample(px)?;
        let angle = |k: f64| k * std::f64::consts::TAU / RING as f64;
        let mut ring = [0.0; RING];
        for (k, value) in ring.iter_mut().enumerate() {
            let (s, c) = angle(k as f64).sin_cos();
            *value = blurred.sample(px + Vector2::new(c, s) * radius)? - center;
        }
        let mut edges = [0.0; 4];
        let mut rises = [false; 4];
        let mut count = 0;
        for k in 0..RING {
            let (a, b) = (ring[k], ring[(k + 1) % RING]);
            if (a < 0.0) != (b < 0.0) {
                if count == 4 {
                    return None;
                }
                edges[count] = angle(k as f64 + a / (a - b));
                rises[count] = b > a;
                count += 1;
            }
        }
        let saddle = Self { px, edges, first_rises: rises[0] };
        (count == 4 && saddle.is_straight() && quarters_are_even(&ring)).then_some(saddle)
    }

    fn is_straight(&self) -> bool {
        let [a, b, c, d] = self.edges;
        let pi = std::f64::consts::PI;
        let sectors = [b - a, c - b, d - c, a + 2.0 * pi - d];
        (c - a - pi).abs() < MOST_BEND
            && (d - b - pi).abs() < MOST_BEND
            && sectors.iter().all(|s| *s > LEAST_SECTOR)
    }

    /// Whether it gets lighter across edge `k` as the direction grows.
    pub(super) fn rises(&self, k: usize) -> bool {
        self.first_rises == k.is_multiple_of(2)
    }
}

/// Whether each of the four quarters between sign changes shows enough contrast.
fn quarters_are_even(ring: &[f64; RING]) -> bool {
    let start = (0..RING).find(|&k| (ring[k] < 0.0) != (ring[(k + RING - 1) % RING] < 0.0)).unwrap_or(0);
    let mut peaks: Vec<f64> = vec![0.0];
    for k in 0..RING {
        let (value, before) = (ring[(start + k) % RING], ring[(start + k + RING - 1) % RING]);
        if k > 0 && (value < 0.0) != (before < 0.0) {
            peaks.push(0.0);
        }
        if let Some(peak) = peaks.last_mut() {
            *peak = value.abs().max(*peak);
        }
    }
    let weakest = peaks.iter().copied().fold(f64::INFINITY, f64::min);
    let strongest = peaks.iter().copied().fold(0.0, f64::max);
    weakest > LEAST_CONTRAST && weakest > LEAST_BALANCE * strongest
}

/// Every saddle of a blurred image, examined on a ring of `radius` pixels.
pub(super) fn saddles(blurred: &FloatImage, radius: f64) -> Vec<Saddle> {
    let (width, height) = (blurred.width, blurred.height);
    if width < 8 || height < 8 {
        return Vec::new();
    }
    let response = responses(blurred);
    let strongest = response.iter().copied().fold(0f32, f32::max);
    let mut peaks: Vec<(f32, usize, usize)> = Vec::new();
    for v in 3..height - 3 {
        for u in 3..width - 3 {
            let here = response[v * width + u];
            if here > LEAST_RESPONSE * strongest && is_peak(&response, width, u, v) {
                peaks.push((here, u, v));
            }
        }
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    peaks.truncate(MOST_CANDIDATES);
    let mut found: Vec<Saddle> = Vec::new();
    for (_, u, v) in peaks {
        let Some(px) = settle(blurred, u, v) else { continue };
        let Some(saddle) = Saddle::at(blurred, px, radius) else { continue };
        if found.iter().all(|other| (other.px - px).norm() > 0.7 * radius) {
            found.push(saddle);
        }
    }
    found
}

/// `Ixy² − Ixx Iyy`, positive at saddles.
fn responses(image: &FloatImage) -> Vec<f32> {
    let (width, height) = (image.width, image.height);
    let mut out = vec![0f32; width * height];
    for v in 1..height - 1 {
        for u in 1..width - 1 {
            let [xx, xy, yy] = second_derivatives(image, u, v);
            out[v * width + u] = (xy * xy - xx * yy).max(0.0);
        }
    }
    out
}

fn second_derivatives(image: &FloatImage, u: usize, v: usize) -> [f32; 3] {
    let at = |du: isize, dv: isize| image.at((u as isize + du) as usize, (v as isize + dv) as usize);
    let center = at(0, 0);
    let xx = at(1, 0) + at(-1, 0) - 2.0 * center;
    let yy = at(0, 1) + at(0, -1) - 2.0 * center;
    let xy = 0.25 * (at(1, 1) + at(-1, -1) - at(1, -1) - at(-1, 1));
    [xx, xy, yy]
}

fn is_peak(response: &[f32], width: usize, u: usize, v: usize) -> bool {
    let here = response[v * width + u];
    (v - 2..=v + 2).all(|y| {
        (u - 2..=u + 2).all(|x| {
            let other = response[y * width + x];
            // Of two equal neighbours the earlier one counts.
            other < here || (other == here && (y, x) >= (v, u))
        })
    })
}

/// The stationary point near a pixel, by one Newton step on the quadratic through its neighbours.
fn settle(image: &FloatImage, u: usize, v: usize) -> Option<Vector2<f64>> {
    let [xx, xy, yy] = second_derivatives(image, u, v).map(f64::from);
    let gradient = 0.5
        * Vector2::new(
            f64::from(image.at(u + 1, v) - image.at(u - 1, v)),
            f64::from(image.at(u, v + 1) - image.at(u, v - 1)),
        );
    let step = Matrix2::new(xx, xy, xy, yy).try_inverse()? * -gradient;
    (step.norm() < 2.0).then(|| Vector2::new(u as f64, v as f64) + step)
}
