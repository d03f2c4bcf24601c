//! Frames to try a detector on, with the truth: two tags on a plate on textured ground seen from above, with
//! shadows that cross them, motion blur, noise, dark decoys; some frames without any tag.
//!
//! `cargo run --release --example detector_frames -- FOLDER COUNT SEED`, then `python3 benches/peers.py BIN FOLDER`.
//! All textures are computed; none is a photograph.

use std::path::PathBuf;

use nalgebra::{Matrix3, Unit, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use windhover_base::msg::TagFamily;
use windhover_detect::{TagPattern, tag_pattern};

const WIDTH: usize = 1280;
const HEIGHT: usize = 1024;
const FOCAL: f64 = 1020.0;
/// Radial distortion of the lens.
const LENS: f64 = -0.17;
/// Every fifth frame has no tag.
const BARE: usize = 5;

/// A mix of the bits of two integers, from 0 to 1.
fn hash(x: i64, y: i64, salt: u64) -> f64 {
    let mut h = (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f)
        ^ salt;
    h = (h ^ (h >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ (h >> 32)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (h >> 40) as f64 / (1u64 << 24) as f64
}

/// Smooth noise of one grain.
fn smooth(x: f64, y: f64, salt: u64) -> f64 {
    let (ix, iy) = (x.floor(), y.floor());
    let ease = |t: f64| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (ease(x - ix), ease(y - iy));
    let at = |dx: i64, dy: i64| hash(ix as i64 + dx, iy as i64 + dy, salt);
    let (top, bottom) = (at(0, 0) + fx * (at(1, 0) - at(0, 0)), at(0, 1) + fx * (at(1, 1) - at(0, 1)));
    top + fy * (bottom - top)
}

/// Noise of several grains, from 0 to 1.
fn rough(x: f64, y: f64, salt: u64) -> f64 {
    (0..5)
        .map(|k| smooth(x * f64::from(1 << k), y * f64::from(1 << k), salt + k as u64) / f64::from(2 << k))
        .sum()
}

/// Distances to the nearest and second nearest of scattered points, and a number of the nearest.
fn pebbles(x: f64, y: f64, salt: u64) -> (f64, f64, f64) {
    let (ix, iy) = (x.floor() as i64, y.floor() as i64);
    let (mut first, mut second, mut number) = (9.0, 9.0, 0.0);
    for cell in 0..9 {
        let (cx, cy) = (ix + cell % 3 - 1, iy + cell / 3 - 1);
        let (px, py) = (cx as f64 + hash(cx, cy, salt), cy as f64 + hash(cx, cy, salt ^ 77));
        let d = (px - x).hypot(py - y);
        if d < first {
            (second, first, number) = (first, d, hash(cx, cy, salt ^ 5));
        } else {
            second = second.min(d);
        }
    }
    (first, second, number)
}

/// Material of the ground.
#[derive(Clone, Copy, Debug)]
enum Ground {
    Mottled,
    Gravel,
    Bricks,
    Grass,
    Fields,
}

impl Ground {
    const ALL: [Self; 5] = [Self::Mottled, Self::Gravel, Self::Bricks, Self::Grass, Self::Fields];

    /// Reflectance at a place, metres.
    fn at(self, x: f64, y: f64, salt: u64) -> f64 {
        match self {
            Self::Mottled => 0.1 + 0.4 * rough(0.7 * x, 0.7 * y, salt),
            Self::Gravel => {
                let (first, second, number) = pebbles(5.0 * x, 5.0 * y, salt);
                let gap = ((second - first) * 5.0).min(1.0);
                0.08 + gap * (0.25 + 0.45 * number)
            }
            Self::Bricks => {
                let course = (y / 0.16).floor();
                let shifted = x + 0.2 * (course as i64 & 1) as f64;
                let joint = (y / 0.16 - course) < 0.12 || (shifted / 0.4).fract().abs() < 0.06;
                let tone = hash((shifted / 0.4).floor() as i64, course as i64, salt);
                (if joint { 0.55 } else { 0.2 + 0.2 * tone }) + 0.06 * rough(20.0 * x, 20.0 * y, salt)
            }
            Self::Grass => {
                let lean = 6.0 * smooth(3.0 * x, 3.0 * y, salt);
                let (s, c) = lean.sin_cos();
                let blade = smooth(30.0 * (c * x + s * y), 6.0 * (c * y - s * x), salt ^ 3);
                0.1 + 0.55 * blade * (0.6 + 0.4 * rough(x, y, salt ^ 9))
            }
            Self::Fields => {
                let (_, _, number) = pebbles(0.25 * x, 0.25 * y, salt);
                0.1 + 0.6 * number * (0.6 + 0.4 * rough(2.0 * x, 2.0 * y, salt))
            }
        }
    }
}

/// A rectangle on the ground: middle, half sizes, turn.
#[derive(Clone, Copy, Debug)]
struct Patch {
    middle: Vector2<f64>,
    half: Vector2<f64>,
    /// Cosine and sine of its turn.
    turn: (f64, f64),
    tone: f64,
}

impl Patch {
    fn inside(&self, p: Vector2<f64>) -> Option<Vector2<f64>> {
        let (c, s) = self.turn;
        let d = p - self.middle;
        let q = Vector2::new(c * d.x + s * d.y, c * d.y - s * d.x);
        (q.x.abs() <= self.half.x && q.y.abs() <= self.half.y).then_some(q)
    }

    fn ground_of(self, q: Vector2<f64>) -> Vector2<f64> {
        let (c, s) = self.turn;
        self.middle + Vector2::new(c * q.x - s * q.y, s * q.x + c * q.y)
    }
}

fn direction(rng: &mut ChaCha8Rng) -> (f64, f64) {
    let angle: f64 = rng.random_range(0.0..std::f64::consts::TAU);
    (angle.cos(), angle.sin())
}

/// A plate with its two tags (identity and pattern), and the edge of their borders.
type Plate = (Patch, f64, [(u32, TagPattern); 2]);

/// One scene: ground plane, camera above it.
struct Scene {
    ground: Ground,
    salt: u64,
    /// Ground (x, y, 1) to undistorted normalised image.
    view: Matrix3<f64>,
    back: Matrix3<f64>,
    patches: Vec<Patch>,
    plate: Option<Plate>,
    shadow: Option<(Patch, f64)>,
    gain: f64,
}

/// Where the tags lie along the plate, in edges of a tag's border.
const TAG_AT: f64 = 0.8;

impl Scene {
    fn random(rng: &mut ChaCha8Rng, bare: bool) -> Self {
        let height = rng.random_range(8.0..26.0);
        let towards = rng.random_range(0.0..std::f64::consts::TAU);
        let axis = Unit::new_normalize(Vector3::new(f64::cos(towards), f64::sin(towards), 0.0));
        let rotation = nalgebra::Rotation3::from_axis_angle(&axis, rng.random_range(0.0..0.35));
        let r = rotation.matrix();
        let view =
            Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), Vector3::new(0.0, 0.0, height)]);
        let reach = 0.55 * height;
        let patch = |rng: &mut ChaCha8Rng, size: std::ops::Range<f64>, thin: f64| {
            let size = rng.random_range(size);
            Patch {
                middle: Vector2::new(
                    rng.random_range(-reach..reach),
                    rng.random_range(-0.8 * reach..0.8 * reach),
                ),
                half: Vector2::new(size, size * thin),
                turn: direction(rng),
                tone: 0.0,
            }
        };
        let mut patches: Vec<Patch> = (0..6).map(|_| patch(rng, 0.5..0.3 * height, 0.03)).collect();
        patches.extend((0..3).map(|_| patch(rng, 0.15..0.6, 0.7)));
        let mut plate = patch(rng, 1.0..1.01, 0.5);
        plate.middle *= 0.85;
        let mut shadow = patch(rng, 2.0 * height..2.1 * height, 0.06);
        for p in &mut patches {
            p.tone = rng.random_range(0.04..0.7);
        }
        let side_px = 16.0 * (200.0f64 / 16.0).powf(rng.random_range(0.0..1.0f64).powf(1.3));
        let edge = side_px * height / FOCAL;
        plate.half = Vector2::new(1.65, 0.85) * edge;
        plate.tone = rng.random_range(0.3..0.6);
        if rng.random_bool(0.6) {
            // Its edge lies across a tag.
            let normal = Vector2::new(-shadow.turn.1, shadow.turn.0);
            let aim = plate.ground_of(Vector2::new(TAG_AT * edge, rng.random_range(-0.4..0.4) * edge));
            shadow.middle = aim + normal * shadow.half.y;
        }
        let tags =
            [0, 1].map(|_| rng.random_range(0..587)).map(|id| (id, tag_pattern(TagFamily::Tag36h11, id)));
        Self {
            ground: Ground::ALL[rng.random_range(0..Ground::ALL.len())],
            salt: rng.random(),
            view,
            back: view.try_inverse().unwrap_or_else(Matrix3::identity),
            patches,
            plate: (!bare).then_some((plate, edge, tags)),
            shadow: rng.random_bool(0.5).then(|| (shadow, rng.random_range(0.2..0.5))),
            gain: rng.random_range(0.6..1.0),
        }
    }

    fn reflectance(&self, p: Vector2<f64>) -> f64 {
        if let Some((plate, edge, tags)) = &self.plate
            && let Some(q) = plate.inside(p)
        {
            let (pattern, at) = if q.x < 0.0 { (&tags[0].1, -TAG_AT) } else { (&tags[1].1, TAG_AT) };
            let cell = edge / pattern.border as f64;
            let half = pattern.side() as f64 / 2.0;
            let (x, y) = ((q.x - at * edge) / cell + half, q.y / cell + half);
            if x >= 0.0 && y >= 0.0 && x < 2.0 * half && y < 2.0 * half {
                return if pattern.white(x as usize, y as usize) { 0.85 } else { 0.07 };
            }
            return plate.tone;
        }
        let ground = || self.ground.at(p.x, p.y, self.salt);
        self.patches
            .iter()
            .rev()
            .find(|patch| patch.inside(p).is_some())
            .map_or_else(ground, |patch| patch.tone)
    }

    /// Brightness of the place at a pixel.
    fn light(&self, u: f64, v: f64) -> f64 {
        let p = self.back * undistorted(u, v);
        let p = Vector2::new(p.x / p.z, p.y / p.z);
        let shade =
            self.shadow.map_or(1.0, |(patch, shade)| if patch.inside(p).is_some() { shade } else { 1.0 });
        self.reflectance(p) * shade * self.gain
    }

    /// Pixel corners of a tag, in the print's order, with its number.
    fn corners(&self) -> Vec<(u32, [Vector2<f64>; 4])> {
        let Some((plate, edge, tags)) = &self.plate else { return Vec::new() };
        let of = |k: usize| {
            let at = if k == 0 { -TAG_AT } else { TAG_AT };
            let corners = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)].map(|(x, y)| {
                let p = plate.ground_of(Vector2::new((at + x) * edge, y * edge));
                distorted(self.view * Vector3::new(p.x, p.y, 1.0))
            });
            (tags[k].0, corners)
        };
        vec![of(0), of(1)]
    }
}

fn distorted(ray: Vector3<f64>) -> Vector2<f64> {
    let (x, y) = (ray.x / ray.z, ray.y / ray.z);
    let bend = 1.0 + LENS * (x * x + y * y);
    Vector2::new(FOCAL * x * bend + WIDTH as f64 / 2.0, FOCAL * y * bend + HEIGHT as f64 / 2.0)
}

fn undistorted(u: f64, v: f64) -> Vector3<f64> {
    let (xd, yd) = ((u - WIDTH as f64 / 2.0) / FOCAL, (v - HEIGHT as f64 / 2.0) / FOCAL);
    let (mut x, mut y) = (xd, yd);
    for _ in 0..12 {
        let bend = 1.0 + LENS * (x * x + y * y);
        (x, y) = (xd / bend, yd / bend);
    }
    Vector3::new(x, y, 1.0)
}

/// Light per pixel, 2×2 samples each.
fn render(scene: &Scene) -> Vec<f64> {
    let mut out = vec![0.0; WIDTH * HEIGHT];
    for (i, pixel) in out.iter_mut().enumerate() {
        let (u, v) = ((i % WIDTH) as f64, (i / WIDTH) as f64);
        let offsets = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)];
        *pixel = offsets.iter().map(|(du, dv)| scene.light(u + du, v + dv)).sum::<f64>() / 4.0;
    }
    out
}

/// Value between pixels.
fn between(image: &[f64], u: f64, v: f64) -> f64 {
    let (u, v) = (u.clamp(0.0, WIDTH as f64 - 1.001), v.clamp(0.0, HEIGHT as f64 - 1.001));
    let (iu, iv) = (u as usize, v as usize);
    let (fu, fv) = (u - iu as f64, v - iv as f64);
    let at = |du: usize, dv: usize| image[(iv + dv) * WIDTH + iu + du];
    let top = at(0, 0) + fu * (at(1, 0) - at(0, 0));
    top + fv * (at(0, 1) + fu * (at(1, 1) - at(0, 1)) - top)
}

/// The mean of an image shifted along a direction; `shifts` are symmetric about zero, with weights.
fn smear(image: &[f64], direction: Vector2<f64>, shifts: &[(f64, f64)]) -> Vec<f64> {
    let total: f64 = shifts.iter().map(|s| s.1).sum();
    (0..image.len())
        .map(|i| {
            let (u, v) = ((i % WIDTH) as f64, (i / WIDTH) as f64);
            shifts
                .iter()
                .map(|(d, w)| w * between(image, u + d * direction.x, v + d * direction.y))
                .sum::<f64>()
                / total
        })
        .collect()
}

/// One frame and the truth about it.
fn frame(rng: &mut ChaCha8Rng, number: usize) -> (image::GrayImage, serde_json::Value) {
    let scene = Scene::random(rng, number % BARE == BARE - 1);
    let (blur, motion, noise) =
        (rng.random_range(0.6..1.1f64), rng.random_range(0.0..5.0f64), rng.random_range(2.0..7.0));
    let along = rng.random_range(0.0..std::f64::consts::TAU);
    let gauss: Vec<(f64, f64)> =
        (-3..=3).map(|k| (f64::from(k), (-0.5 * (f64::from(k) / blur).powi(2)).exp())).collect();
    let drag: Vec<(f64, f64)> = (0..9).map(|k| ((f64::from(k) - 4.0) / 9.0 * motion, 1.0)).collect();
    let sharp = render(&scene);
    let blurred = smear(&smear(&sharp, Vector2::x(), &gauss), Vector2::y(), &gauss);
    let moved = smear(&blurred, Vector2::new(along.cos(), along.sin()), &drag);
    let pixels = moved
        .iter()
        .map(|light| {
            let grain: f64 = StandardNormal.sample(rng);
            (240.0 * light + noise * grain + 0.5).clamp(0.0, 255.0) as u8
        })
        .collect();
    let tags: Vec<serde_json::Value> = scene
        .corners()
        .into_iter()
        .filter(|(_, corners)| {
            corners.iter().all(|c| (4.0..WIDTH as f64 - 4.0).contains(&c.x) && (4.0..HEIGHT as f64 - 4.0).contains(&c.y))
        })
        .map(|(id, corners)| {
            let side = (0..4).map(|i| (corners[i] - corners[(i + 1) % 4]).norm()).sum::<f64>() / 4.0;
            let half = scene.shadow.is_some_and(|(shadow, _)| {
                let inside = corners.iter().filter(|c| {
                    let p = scene.back * undistorted(c.x, c.y);
                    shadow.inside(Vector2::new(p.x / p.z, p.y / p.z)).is_some()
                });
                (1..4).contains(&inside.count())
            });
            serde_json::json!({ "id": id, "corners": corners.map(|c| [c.x, c.y]), "side": side, "half": half })
        })
        .collect();
    let truth = serde_json::json!({
        "frame": number, "ground": format!("{:?}", scene.ground), "blur": blur, "motion": motion, "noise": noise,
        "gain": scene.gain, "shadow": scene.shadow.is_some(), "tags": tags,
    });
    (image::GrayImage::from_raw(WIDTH as u32, HEIGHT as u32, pixels).unwrap_or_default(), truth)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, count, seed] = arguments.as_slice() else { return Err("FOLDER COUNT SEED".into()) };
    let (folder, count, seed) = (PathBuf::from(folder), count.parse::<usize>()?, seed.parse()?);
    std::fs::create_dir_all(&folder)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut frames = Vec::new();
    for number in 0..count {
        let (image, truth) = frame(&mut rng, number);
        image.save(folder.join(format!("frame_{number:03}.png")))?;
        frames.push(truth);
    }
    std::fs::write(
        folder.join("truth.json"),
        serde_json::to_string(&serde_json::json!({ "frames": frames }))?,
    )?;
    Ok(())
}
