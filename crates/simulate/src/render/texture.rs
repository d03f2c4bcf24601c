//! The ground's picture: one seamless square of several octaves of noise, materials with edges
//! between them, stones, cracks, and objects that lie about.

use super::super::random::Stream;

/// Texels on a side; a power of two.
const SIDE: usize = 2048;
/// Its logarithm.
const SIDE_LOG2: usize = SIDE.trailing_zeros() as usize;
/// Noise octaves: cells of 1, 2, 4, … texels.
const OCTAVES: usize = 9;
/// Amplitude of the finest octave, grey levels rms, and by how much each coarser one grows.
const FINEST: (f32, f32) = (3.0, 1.26);

/// A seamless square of ground, repeated in both directions.
#[derive(Clone, Debug)]
pub(super) struct Tile {
    texels: Vec<u8>,
    /// Texels a metre.
    pub(super) per_m: f64,
}

impl Tile {
    /// Draws the ground with texels of `texel_m` metres and this many objects on 100 m².
    pub(super) fn new(texel_m: f64, objects: f64, stream: &mut Stream) -> Self {
        let mut grey = noise(stream);
        materials(&mut grey, stream);
        let area_m2 = (SIDE as f64 * texel_m).powi(2);
        let count = (objects * area_m2 / 100.0).round().max(0.0) as usize;
        for _ in 0..count {
            drop_object(&mut grey, texel_m, stream);
        }
        let texels = grey.iter().map(|x| x.clamp(0.0, 255.0) as u8).collect();
        Self { texels, per_m: 1.0 / texel_m }
    }

    /// Length after which the picture repeats, metres.
    pub(super) fn period_m(&self) -> f64 {
        SIDE as f64 / self.per_m
    }

    /// Grey level between texels; `x` and `y` in texels, not negative.
    #[inline]
    pub(super) fn at(&self, x: f32, y: f32) -> f32 {
        let (ix, iy) = (x as i32, y as i32);
        let (fx, fy) = (x - ix as f32, y - iy as f32);
        let (x0, y0) = (ix as usize & (SIDE - 1), iy as usize & (SIDE - 1));
        let (x1, y1) = ((x0 + 1) & (SIDE - 1), (y0 + 1) & (SIDE - 1));
        let texel = |x: usize, y: usize| f32::from(self.texels[(y << SIDE_LOG2 | x) & (SIDE * SIDE - 1)]);
        let top = texel(x0, y0) + fx * (texel(x1, y0) - texel(x0, y0));
        let bottom = texel(x0, y1) + fx * (texel(x1, y1) - texel(x0, y1));
        top + fy * (bottom - top)
    }
}

/// One octave: random values on a lattice, interpolated smoothly, added with this amplitude.
fn add_octave(grey: &mut [f32], cell: usize, amplitude: f32, stream: &mut Stream) {
    let count = SIDE / cell;
    // Uniform values have a sigma of 1/√12; interpolation loses some of it again.
    let scale = amplitude * 12.0_f32.sqrt() * if cell == 1 { 1.0 } else { 1.35 };
    let lattice: Vec<f32> =
        (0..count * count).map(|_| (stream.word() as f32 / u32::MAX as f32 - 0.5) * scale).collect();
    let ease: Vec<f32> = (0..cell)
        .map(|i| {
            let s = i as f32 / cell as f32;
            s * s * (3.0 - 2.0 * s)
        })
        .collect();
    let mut between = vec![0.0_f32; count + 1];
    for (y, row) in grey.chunks_exact_mut(SIDE).enumerate() {
        let (above, below) = (y / cell, (y / cell + 1) % count);
        let s = ease[y % cell];
        for x in 0..count {
            let (a, b) = (lattice[above * count + x], lattice[below * count + x]);
            between[x] = a + s * (b - a);
        }
        between[count] = between[0];
        for (pair, part) in between.windows(2).zip(row.chunks_exact_mut(cell)) {
            for (texel, s) in part.iter_mut().zip(&ease) {
                *texel += pair[0] + s * (pair[1] - pair[0]);
            }
        }
    }
}

fn noise(stream: &mut Stream) -> Vec<f32> {
    let mut grey = vec![96.0; SIDE * SIDE];
    for octave in 0..OCTAVES {
        let amplitude = FINEST.0 * FINEST.1.powi(octave as i32);
        add_octave(&mut grey, 1 << octave, amplitude, stream);
    }
    grey
}

/// Turns the noise into grass, gravel and asphalt, with edges between them.
fn materials(grey: &mut [f32], stream: &mut Stream) {
    let mut mask = vec![0.0_f32; SIDE * SIDE];
    for cell in [SIDE / 4, SIDE / 8, SIDE / 32, SIDE / 128] {
        add_octave(&mut mask, cell, cell as f32 / (SIDE / 4) as f32, stream);
    }
    for (texel, m) in grey.iter_mut().zip(&mask) {
        if *m > 0.75 {
            // Asphalt: dark, with less contrast.
            *texel = 66.0 + 0.45 * (*texel - 96.0);
        } else if *m < -0.6 {
            // Gravel: light, with grains.
            let grain = (stream.word() >> 24) as f32;
            *texel = 122.0 + 0.8 * (*texel - 96.0) + if grain > 215.0 { 26.0 } else { 0.0 };
        }
    }
}

/// An object's outline: signed distance from its edge, texels, negative inside.
#[derive(Clone, Copy)]
enum Outline {
    Disc { radius: f32 },
    Rectangle { half: (f32, f32) },
}

impl Outline {
    fn distance(self, x: f32, y: f32) -> f32 {
        match self {
            Self::Disc { radius } => x.hypot(y) - radius,
            Self::Rectangle { half } => (x.abs() - half.0).max(y.abs() - half.1),
        }
    }

    fn reach(self) -> f32 {
        match self {
            Self::Disc { radius } => radius,
            Self::Rectangle { half } => half.0.hypot(half.1),
        }
    }
}

/// Lays one object on the ground: a stone, a board, a crack, or a square within a square, which a
/// detector of markers must not take for one.
fn drop_object(grey: &mut [f32], texel_m: f64, stream: &mut Stream) {
    let centre = (stream.uniform(0.0, SIDE as f64) as f32, stream.uniform(0.0, SIDE as f64) as f32);
    let angle = stream.uniform(0.0, std::f64::consts::TAU) as f32;
    let kind = stream.uniform(0.0, 1.0);
    let size = (stream.uniform(0.06, 0.40) / texel_m) as f32;
    let level = stream.uniform(20.0, 215.0) as f32;
    let other = if level > 115.0 { level - 85.0 } else { level + 85.0 };
    let square = |half: f32| Outline::Rectangle { half: (half, half) };
    match kind {
        k if k < 0.35 => paint(grey, centre, angle, Outline::Disc { radius: 0.4 * size }, level),
        k if k < 0.55 => paint(grey, centre, angle, square(size), level),
        k if k < 0.80 => {
            let thin = (0.012 / texel_m).max(0.6) as f32;
            paint(grey, centre, angle, Outline::Rectangle { half: (3.0 * size, thin) }, level);
        }
        _ => {
            paint(grey, centre, angle, square(size), level);
            paint(grey, centre, angle + 0.6 * level, square(0.55 * size), other);
        }
    }
}

fn paint(grey: &mut [f32], (cx, cy): (f32, f32), angle: f32, outline: Outline, level: f32) {
    let (s, c) = angle.sin_cos();
    let reach = outline.reach().ceil() as i32 + 2;
    let (ix, iy) = (cx as i32, cy as i32);
    let wrap = |i: i32| i.rem_euclid(SIDE as i32) as usize;
    for y in iy - reach..=iy + reach {
        for x in ix - reach..=ix + reach {
            let (dx, dy) = (x as f32 - cx, y as f32 - cy);
            let cover = (0.5 - outline.distance(c * dx + s * dy, c * dy - s * dx)).clamp(0.0, 1.0);
            if cover > 0.0 {
                let texel = &mut grey[wrap(y) * SIDE + wrap(x)];
                // A quarter of the ground's structure shows through, as it does on worn paint.
                let painted = level + 0.25 * (*texel - 96.0);
                *texel += cover * (painted - *texel);
            }
        }
    }
}
