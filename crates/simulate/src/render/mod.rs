//! Camera frames: the ground through the lens, vehicles with their markers, light, blur and noise.
//!
//! The ground is sampled once a pixel (with several taps where the exposure smears it); vehicles are
//! ray-traced, with many samples spread over the lens's point spread and the exposure wherever an
//! edge is near. Rows are independent of each other: any number of threads gives the same frame.

mod body;
mod lens;
mod texture;

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use self::body::{Body, Hit, Placed};
use self::lens::Lens;
use self::texture::Tile;
use super::random::{Purpose, Stream};
use super::scenario::Scene;
use super::world::World;
use windhover_base::msg::GrayImage;
use windhover_base::time::{MonoTime, Span};

/// Samples of a pixel near an edge.
const SAMPLES: usize = 32;
/// Most moments an exposure is split into.
const MOST_SLOTS: usize = 16;
/// Entries of the noise table; a power of two.
const NOISE: usize = 1 << 16;
/// Movement over an exposure below which a frame is drawn sharp, pixels.
const SHARP_PX: f32 = 0.5;
/// Pixels in a run over which the ground is taken as straight.
const RUN: usize = 8;
/// Rows of a rolling shutter that are drawn as exposed together.
const BAND: usize = 4;
/// What is left of the light in shadow.
const SHADOW: f32 = 0.42;
/// Added to texture coordinates to keep them positive, in periods.
const POSITIVE: f64 = 4.0;
/// Farthest ground drawn, in flying heights; beyond it, haze of this level.
const HORIZON: (f32, f32) = (40.0, 150.0);

/// Draws the frames of a flight.
#[derive(Clone, Debug)]
pub struct Renderer {
    world: Arc<World>,
    scene: Scene,
    lens: Lens,
    tile: Tile,
    bodies: Vec<Body>,
    noise: Vec<f32>,
    /// Offsets of the samples from a pixel's centre, pixels.
    spread: [[f32; 2]; SAMPLES],
    threads: usize,
}

/// Camera and vehicles at one moment of an exposure.
#[derive(Clone, Debug)]
struct Moment {
    ned_from_camera: Matrix3<f32>,
    height: f32,
    /// The camera's place on the tile, texels.
    origin: (f32, f32),
    placed: Vec<Placed>,
}

/// Rows and columns in which a vehicle or its shadow may show: from, to (exclusive).
#[derive(Clone, Copy, Debug)]
struct Window {
    u: (usize, usize),
    v: (usize, usize),
}

/// One exposure, ready to draw.
struct Exposure {
    moments: Vec<Moment>,
    windows: Vec<Window>,
    gain: f32,
    frame: u64,
}

impl Renderer {
    /// A renderer for this world's camera and scene.
    pub fn new(world: Arc<World>) -> Self {
        let scenario = world.scenario();
        let camera = &world.rig().camera;
        let mut stream = Stream::of(world.seed(), Purpose::Scene);
        let scene = scenario.scene.clone();
        // A texel is a pixel on the ground at flying height: structure down to the pixel, no aliases.
        let texel_m = (scenario.helicopter.height_m / camera.intrinsics.fx).clamp(0.003, 0.2);
        let tile = Tile::new(texel_m, scene.objects, &mut stream);
        let noise = (0..NOISE).map(|_| stream.normal() as f32).collect();
        let spread = spread(scene.blur_px as f32);
        let bodies = (0..world.movers())
            .map(|index| match world.looks(index) {
                (target, None) => Body::new(target),
                (target, Some(looks)) => Body::of_companion(looks, target, index),
            })
            .collect();
        Self { lens: Lens::new(camera), scene, tile, bodies, noise, spread, threads: 1, world }
    }

    /// The same renderer drawing with this many threads; the frames stay the same.
    #[must_use]
    pub fn with_threads(mut self, threads: usize) -> Self {
        self.threads = threads.clamp(1, 64);
        self
    }

    /// Draws frame `frame`, exposed around `t`, into `image` (resized as needed).
    pub fn render(&self, t: MonoTime, frame: u32, image: &mut GrayImage) {
        let (width, height) = (self.lens.width, self.lens.height);
        (image.width, image.height, image.stride) = (width, height, width);
        image.data.resize(width * height, 0);
        let rows = height.div_ceil(self.threads);
        if self.world.scenario().camera.readout_ms != 0.0 {
            return self.in_parts(rows.next_multiple_of(BAND), image, |first_row, data| {
                self.draw_rolling(t, frame, first_row, data);
            });
        }
        let exposure = self.expose(t, frame);
        self.in_parts(rows, image, |first_row, data| self.draw_rows(&exposure, first_row, data));
    }

    /// Draws parts of so many rows, each on a thread of its own.
    fn in_parts(&self, rows: usize, image: &mut GrayImage, draw: impl Fn(usize, &mut [u8]) + Sync) {
        if self.threads == 1 {
            return draw(0, &mut image.data);
        }
        std::thread::scope(|scope| {
            for (part, data) in image.data.chunks_mut(rows * self.lens.width).enumerate() {
                let draw = &draw;
                scope.spawn(move || draw(part * rows, data));
            }
        });
    }

    /// Rows of a rolling shutter: each few of them are an exposure of their own.
    fn draw_rolling(&self, t: MonoTime, frame: u32, first_row: usize, data: &mut [u8]) {
        for (k, band) in data.chunks_mut(BAND * self.lens.width).enumerate() {
            let row = first_row + k * BAND;
            let middle = row as f64 + 0.5 * (BAND as f64 - 1.0);
            let exposure = self.expose(self.world.row_time(t, middle), frame);
            self.draw_rows(&exposure, row, band);
        }
    }

    fn expose(&self, t: MonoTime, frame: u32) -> Exposure {
        let half = Span::from_ms(0.5 * self.scene.exposure_ms);
        let (first, last) = (self.moment(t - half), self.moment(t + half));
        let smear_px = self.smear_px(&first, &last);
        // A power of two, so that every moment gets samples in pairs opposite each other.
        let slots = if smear_px < SHARP_PX { 1 } else { (1.5 * smear_px).ceil() as usize };
        let slots = slots.next_power_of_two().min(MOST_SLOTS);
        let moments: Vec<_> = (0..slots)
            .map(|k| {
                let share = (k as f64 + 0.5) / slots as f64 - 0.5;
                self.moment(t + Span::from_ms(share * self.scene.exposure_ms))
            })
            .collect();
        let windows = (0..self.bodies.len()).filter_map(|i| self.window(i, &first, &last)).collect();
        let t_s = self.world.seconds(t);
        let changed = self.scene.light_change.is_some_and(|(at_s, _)| t_s >= at_s);
        let gain = if changed { self.scene.light_change.map_or(1.0, |(_, gain)| gain) } else { 1.0 };
        Exposure { moments, windows, gain: gain as f32, frame: u64::from(frame) }
    }

    fn moment(&self, t: MonoTime) -> Moment {
        let pose = self.world.camera_pose(t);
        let sun = self.sun();
        let texel = |x: f64| {
            let period = self.tile.period_m();
            ((x.rem_euclid(period) + POSITIVE * period) * self.tile.per_m) as f32
        };
        let placed = (0..self.bodies.len())
            .map(|target| {
                let vehicle = self.world.mover(target, t);
                let (s, c) = vehicle.heading_rad.sin_cos();
                let vehicle_from_ned = match vehicle.sways() {
                    true => vehicle.ned_from_vehicle().matrix().transpose(),
                    false => Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0),
                };
                let foot = vehicle.origin();
                Placed {
                    vehicle_from_camera: (vehicle_from_ned * pose.ned_from_camera.matrix()).cast(),
                    origin: (vehicle_from_ned * (pose.position_ned_m - foot)).cast(),
                    sun: (vehicle_from_ned * sun).cast(),
                    covered: std::array::from_fn(|marker| self.world.covered_share(target, marker, t) as f32),
                }
            })
            .collect();
        Moment {
            ned_from_camera: pose.ned_from_camera.matrix().cast(),
            height: -pose.position_ned_m.z as f32,
            origin: (texel(pose.position_ned_m.x), texel(pose.position_ned_m.y)),
            placed,
        }
    }

    /// Toward the sun, NED.
    fn sun(&self) -> Vector3<f64> {
        let (azimuth, elevation) = self.scene.sun_deg;
        let (s, c) = azimuth.to_radians().sin_cos();
        let (up, level) = elevation.to_radians().sin_cos();
        Vector3::new(level * c, level * s, -up)
    }

    /// How far the picture moves from one moment to another, pixels, at worst over the frame's corners.
    fn smear_px(&self, a: &Moment, b: &Moment) -> f32 {
        let texel_px = self.tile.per_m as f32 * a.height * self.lens.per_px.0;
        let corners = [(0, 0), (0, self.lens.height - 1)];
        let smear = corners.iter().flat_map(|&(_, v)| [0, self.lens.width - 1].map(|u| self.lens.row(v)[u]));
        let ground = smear
            .map(|ray| {
                let ((ax, ay), (bx, by)) = (self.texture_at(a, ray), self.texture_at(b, ray));
                (ax - bx).hypot(ay - by) / texel_px
            })
            .fold(0.0, f32::max);
        let vehicles = a.placed.iter().zip(&b.placed).map(|(a, b)| {
            let metres = (a.origin - b.origin).norm();
            metres / (a.origin.norm() * self.lens.per_px.0)
        });
        vehicles.fold(ground, f32::max)
    }

    /// Where a ray meets the tile, texels.
    #[inline]
    fn texture_at(&self, moment: &Moment, [x, y]: [f32; 2]) -> (f32, f32) {
        let r = &moment.ned_from_camera;
        let down = r[(2, 0)] * x + r[(2, 1)] * y + r[(2, 2)];
        let reach = (moment.height / down.max(1e-6)).min(HORIZON.0 * moment.height) * self.tile.per_m as f32;
        let north = moment.origin.0 + reach * (r[(0, 0)] * x + r[(0, 1)] * y + r[(0, 2)]);
        let east = moment.origin.1 + reach * (r[(1, 0)] * x + r[(1, 1)] * y + r[(1, 2)]);
        (north.max(0.0), east.max(0.0))
    }

    /// Where vehicle `index` and its shadow may show during an exposure.
    fn window(&self, index: usize, first: &Moment, last: &Moment) -> Option<Window> {
        let model = &self.world.rig().camera.intrinsics;
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for moment in [first, last] {
            let placed = &moment.placed[index];
            for point in self.bodies[index].outline(&placed.sun) {
                let in_camera = placed.vehicle_from_camera.transpose() * (point - placed.origin);
                let px = model.project(&in_camera.cast())?.px;
                for axis in 0..2 {
                    low[axis] = low[axis].min(px[axis]);
                    high[axis] = high[axis].max(px[axis]);
                }
            }
        }
        let clip = |axis: usize, size: usize| {
            let from = (low[axis] - 4.0).clamp(0.0, size as f64) as usize;
            let to = (high[axis] + 5.0).clamp(0.0, size as f64) as usize;
            (from, to)
        };
        let window = Window { u: clip(0, self.lens.width), v: clip(1, self.lens.height) };
        (window.u.0 < window.u.1 && window.v.0 < window.v.1).then_some(window)
    }

    fn draw_rows(&self, exposure: &Exposure, first_row: usize, data: &mut [u8]) {
        let width = self.lens.width;
        let rows = data.len() / width;
        let mut grey = vec![0.0_f32; data.len()];
        for (k, row) in grey.chunks_exact_mut(width).enumerate() {
            self.draw_ground(exposure, first_row + k, row);
        }
        for window in &exposure.windows {
            self.draw_vehicles(exposure, window, (first_row, rows), &mut grey);
        }
        for (k, (row, out)) in grey.chunks_exact(width).zip(data.chunks_exact_mut(width)).enumerate() {
            self.expose_row(exposure, first_row + k, row, out);
        }
    }

    /// Ground under a row of pixels: exact at every eighth pixel, straight between them (lens and
    /// perspective bend by less than 0.01 px over so short a run).
    fn draw_ground(&self, exposure: &Exposure, v: usize, row: &mut [f32]) {
        let rays = self.lens.row(v);
        let share = 1.0 / exposure.moments.len() as f32;
        let bands = self.scene.shadow_bands_m.map(|m| 1.0 / (m * self.tile.per_m) as f32);
        row.fill(0.0);
        for moment in &exposure.moments {
            let mut here = self.texture_at(moment, rays[0]);
            for (block, texels) in row.chunks_mut(RUN).enumerate() {
                let last = (block * RUN + texels.len()).min(rays.len() - 1);
                let next = self.texture_at(moment, rays[last]);
                let steps = (last - block * RUN).max(1) as f32;
                let step = ((next.0 - here.0) / steps, (next.1 - here.1) / steps);
                for (k, texel) in texels.iter_mut().enumerate() {
                    let (x, y) = (here.0 + k as f32 * step.0, here.1 + k as f32 * step.1);
                    *texel += share * self.tile.at(x, y) * bands.map_or(1.0, |scale| band(x * scale));
                }
                here = next;
            }
        }
    }

    /// What a ray of one moment meets.
    fn trace(&self, moment: &Moment, [x, y]: [f32; 2]) -> Hit {
        let ray = Vector3::new(x, y, 1.0);
        let mut nearest: Option<(f32, Hit)> = None;
        let mut shadow = false;
        for (body, placed) in self.bodies.iter().zip(&moment.placed) {
            let direction = placed.vehicle_from_camera * ray;
            match body.hit(placed, &direction) {
                Some(Hit::Surface { level, at }) if nearest.is_none_or(|(best, _)| at < best) => {
                    nearest = Some((at, Hit::Surface { level, at }));
                }
                _ => {
                    let ground = placed.origin - direction * (placed.origin.z / direction.z);
                    shadow |= body.shades(&ground, &placed.sun);
                }
            }
        }
        nearest.map_or(Hit::Ground { shadow }, |(_, hit)| hit)
    }

    /// Draws the vehicles over the ground within a window, in the rows at hand.
    fn draw_vehicles(&self, exposure: &Exposure, window: &Window, rows: (usize, usize), grey: &mut [f32]) {
        let (from, to) = (window.v.0.max(rows.0), window.v.1.min(rows.0 + rows.1));
        if from >= to {
            return;
        }
        // Classes of the pixels' centres, two pixels beyond what is drawn.
        let (u0, u1) = (window.u.0.saturating_sub(2), (window.u.1 + 2).min(self.lens.width));
        let (v0, v1) = (from.saturating_sub(2), (to + 2).min(self.lens.height));
        let middle = &exposure.moments[exposure.moments.len() / 2];
        let across = u1 - u0;
        let hits: Vec<Hit> = (v0..v1)
            .flat_map(|v| self.lens.row(v)[u0..u1].iter().map(|&ray| self.trace(middle, ray)))
            .collect();
        let reach = 2 + exposure.moments.len() / 2;
        for v in from..to {
            for u in window.u.0..window.u.1 {
                let hit = hits[(v - v0) * across + u - u0];
                let texel = &mut grey[(v - rows.0) * self.lens.width + u];
                let near_edge = (v.saturating_sub(reach).max(v0)..(v + reach + 1).min(v1)).any(|y| {
                    let (a, b) = (u.saturating_sub(reach).max(u0), (u + reach + 1).min(u1));
                    hits[(y - v0) * across + a - u0..(y - v0) * across + b - u0]
                        .iter()
                        .any(|other| other.class() != hit.class())
                });
                *texel = if near_edge {
                    self.blend(exposure, u, v, *texel)
                } else {
                    self.level(middle, self.lens.row(v)[u], hit, *texel)
                };
            }
        }
    }

    /// Grey level of what a ray met; `ground` is the ground's level there.
    fn level(&self, moment: &Moment, ray: [f32; 2], hit: Hit, ground: f32) -> f32 {
        match hit {
            Hit::Ground { shadow } => ground * if shadow { SHADOW } else { 1.0 },
            Hit::Surface { level, .. } => match self.scene.shadow_bands_m {
                Some(m) => level * band(self.texture_at(moment, ray).0 / (m * self.tile.per_m) as f32),
                None => level,
            },
        }
    }

    /// A pixel near an edge: samples over the point spread and the exposure.
    fn blend(&self, exposure: &Exposure, u: usize, v: usize, ground: f32) -> f32 {
        let mut sum = 0.0;
        for (k, offset) in self.spread.iter().enumerate() {
            let moment = &exposure.moments[k % exposure.moments.len()];
            let ray = self.lens.near(u, v, offset[0], offset[1]);
            sum += self.level(moment, ray, self.trace(moment, ray), ground);
        }
        sum / SAMPLES as f32
    }

    /// Light, vignetting, noise, and eight bits.
    fn expose_row(&self, exposure: &Exposure, v: usize, row: &[f32], out: &mut [u8]) {
        let start = mix(self.world.seed() ^ (exposure.frame << 24) ^ v as u64) as usize;
        let (sigma, gain) = (self.scene.noise_levels as f32, exposure.gain);
        let corner = self.lens.row(0)[0];
        let loss = self.scene.vignetting as f32 / (corner[0] * corner[0] + corner[1] * corner[1]).max(1e-6);
        for (u, ((texel, ray), out)) in row.iter().zip(self.lens.row(v)).zip(out).enumerate() {
            let falloff = 1.0 - loss * (ray[0] * ray[0] + ray[1] * ray[1]);
            let light = texel * gain * falloff.max(0.1);
            // Read noise and, growing with the light, shot noise.
            let noise = self.noise[(start + u) & (NOISE - 1)] * sigma * (0.7 + 0.3 * light * (1.0 / 128.0));
            // The cast saturates.
            *out = (light + noise + 0.5) as u8;
        }
    }
}

/// Spreads neighbouring numbers over all 64 bits (the finaliser of SplitMix64).
fn mix(x: u64) -> u64 {
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Light in bands of shadow, as under trees or between buildings; `x` in periods.
#[inline]
fn band(x: f32) -> f32 {
    let distance = (x - x.floor() - 0.5).abs() - 0.25;
    SHADOW + (1.0 - SHADOW) * (distance * 60.0 + 0.5).clamp(0.0, 1.0)
}

/// Points spread as a Gaussian of `sigma_px` convolved with the pixel: half of them from a
/// low-discrepancy set, the others opposite, so that edges stay where they are.
fn spread(sigma_px: f32) -> [[f32; 2]; SAMPLES] {
    // A square pixel has a sigma of 1/√12.
    let sigma = sigma_px.hypot(1.0 / 12.0_f32.sqrt());
    let half = SAMPLES / 2;
    std::array::from_fn(|k| {
        let i = k % half;
        let radical = (i as u32).reverse_bits() as f32 / u32::MAX as f32;
        let share = (i as f32 + 0.5) / half as f32;
        // Box–Muller: radius from one, angle (over a half turn) from the other.
        let radius = sigma * (-2.0 * share.ln()).sqrt();
        let (s, c) = (std::f32::consts::PI * (radical + 0.5 / half as f32)).sin_cos();
        let sign = if k < half { 1.0 } else { -1.0 };
        [sign * radius * c, sign * radius * s]
    })
}

#[cfg(test)]
mod tests;
