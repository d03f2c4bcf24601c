//! The approximate place in the next frame of a place in one frame: Lucas–Kanade from coarse levels to fine (Bouguet
//! 2000), started at the most similar of the likely shifts.

use super::pyramid::Pyramid;
use windhover_base::msg::ImageView;

/// Half width of the patch compared, pixels of a level.
const HALF: usize = 5;
const SIDE: usize = 2 * HALF + 1;
const AREA: usize = SIDE * SIDE;

/// Levels used: the frame itself is not, the coarsest has a sixteenth of its resolution.
const LEVELS: std::ops::Range<usize> = 1..5;

/// Level on which shifts are compared.
const COMPARED: usize = 3;

/// Below this correlation it is another place.
const LEAST_CORRELATION: f32 = 0.5;

type Patch = [f32; AREA];

/// Two frames, and the image of the later one.
pub(super) struct Flow<'a> {
    pub from: &'a Pyramid,
    pub to: &'a Pyramid,
    pub image: ImageView<'a>,
}

impl Flow<'_> {
    /// The place, to about half a pixel; as good as the best of the `likely` shifts where nothing is found.
    pub fn carry(&self, at: [f32; 2], likely: impl Iterator<Item = [f32; 2]>) -> [f32; 2] {
        let levels = self.from.len().min(self.to.len()).min(LEVELS.end);
        let mut shift = self.most_similar(at, likely);
        for n in (LEVELS.start..levels).rev() {
            let (a, b) = (self.from.level(self.image, n), self.to.level(self.image, n));
            let here = at.map(|c| a.of_frame(c));
            let guess = [here[0] + shift[0] / b.scale, here[1] + shift[1] / b.scale];
            if !inside(a.image, here) || !inside(b.image, guess) {
                continue;
            }
            if let Some(found) = align(b.image, &patch(a.image, here), guess) {
                shift = [(found[0] - here[0]) * b.scale, (found[1] - here[1]) * b.scale];
            }
        }
        [at[0] + shift[0], at[1] + shift[1]]
    }

    /// The shift under which the surroundings of a place look most alike.
    fn most_similar(&self, at: [f32; 2], likely: impl Iterator<Item = [f32; 2]>) -> [f32; 2] {
        let n = COMPARED.min(self.from.len() - 1).min(self.to.len() - 1);
        let (a, b) = (self.from.level(self.image, n), self.to.level(self.image, n));
        let here = at.map(|c| a.of_frame(c));
        if n == 0 || !inside(a.image, here) {
            return [0.0; 2];
        }
        let reference = patch(a.image, here);
        let unlike = |shift: &[f32; 2]| {
            let there = [here[0] + shift[0] / b.scale, here[1] + shift[1] / b.scale];
            if !inside(b.image, there) {
                return f32::INFINITY;
            }
            patch(b.image, there).iter().zip(&reference).map(|(s, r)| (s - r) * (s - r)).sum()
        };
        let rated = likely.map(|shift| (unlike(&shift), shift));
        rated.min_by(|a, b| a.0.total_cmp(&b.0)).map_or([0.0; 2], |(_, shift)| shift)
    }
}

fn near(a: [f32; 2], b: [f32; 2], radius: f32) -> bool {
    (a[0] - b[0]).abs() <= radius && (a[1] - b[1]).abs() <= radius
}

/// Whether a patch around a place lies within the image, with a margin for interpolation.
fn inside(image: ImageView<'_>, at: [f32; 2]) -> bool {
    let margin = (HALF + 2) as f32;
    at[0] >= margin
        && at[1] >= margin
        && at[0] + margin < image.width as f32
        && at[1] + margin < image.height as f32
}

/// Grey levels around a place that is inside the image: all samples have the same position between pixels.
fn patch(image: ImageView<'_>, at: [f32; 2]) -> Patch {
    let (u, v) = (at[0] as usize - HALF, at[1] as usize - HALF);
    let (fu, fv) = (at[0].fract(), at[1].fract());
    let weights = [(1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv];
    let mut patch = [0.0; AREA];
    for (y, to) in patch.chunks_exact_mut(SIDE).enumerate() {
        let row = |v: usize| &image.data[v * image.stride + u..][..SIDE + 1];
        let (above, below) = (row(v + y), row(v + y + 1));
        for (x, to) in to.iter_mut().enumerate() {
            let four = [above[x], above[x + 1], below[x], below[x + 1]].map(f32::from);
            *to = four.iter().zip(&weights).map(|(p, w)| p * w).sum();
        }
    }
    patch
}

/// Inverse compositional alignment of a patch, with the mean subtracted (Baker and Matthews 2004).
fn align(image: ImageView<'_>, reference: &Patch, guess: [f32; 2]) -> Option<[f32; 2]> {
    let (gx, gy) = gradients(reference);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (x, y) in gx.iter().zip(&gy) {
        xx += x * x;
        xy += x * y;
        yy += y * y;
    }
    let det = xx * yy - xy * xy;
    if !(det > 4e-5 * (xx + yy) * (xx + yy).max(1.0)) {
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
        if step[0].abs().max(step[1].abs()) < 0.03 {
            break;
        }
    }
    let (mut cross, mut a2, mut b2) = (0.0, 0.0, 0.0);
    for i in 0..AREA {
        let (a, b) = (here[i] - here_mean, reference[i] - mean);
        cross += a * b;
        a2 += a * a;
        b2 += b * b;
    }
    (cross >= LEAST_CORRELATION * (a2 * b2).sqrt()).then_some(at)
}

/// Central differences inside a patch; one-sided at its rim.
fn gradients(p: &Patch) -> (Patch, Patch) {
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
