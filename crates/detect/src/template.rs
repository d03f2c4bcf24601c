//! The patch of ground of a feature's first frame, found again after the view has turned, come nearer or tilted: an
//! affine warp by inverse composition (Baker and Matthews 2004), with gain and offset of the light eliminated (Hager
//! and Belhumeur 1998).

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::simd::{Kernel, Simd};
use windhover_base::msg::ImageView;

/// Half width of the patch, pixels.
const HALF: usize = 12;
const SIDE: usize = 2 * HALF + 1;
/// The patch in whole vector lanes; the remainder is zero.
const LANES: usize = 8;
const AREA: usize = (SIDE * SIDE).div_ceil(LANES) * LANES;
/// The patch with a rim for smoothing.
const WIDE: usize = SIDE + 2;
/// Parameters of the warp: shift, then the matrix row by row.
const PARAMETERS: usize = 6;
/// Pixels on a side of a block, and blocks on a side of the patch.
const BLOCK: usize = 5;
const BLOCKS: usize = SIDE / BLOCK;
const STEPS: usize = 12;
/// Weight of the predicted matrix: residuals of four grey levels against a hundredth of its elements. A disc does not
/// show its turn, and a corner hardly shows its scale.
const MATRIX_WEIGHT: f32 = 4.0 * 4.0 * 1e4;
/// Farthest a patch may be from the initial guess, pixels.
const FARTHEST: f32 = 3.0;

type Patch = [f32; AREA];

/// Where a patch is: `image = at + matrix · offset in the patch`.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Warp {
    pub at: [f32; 2],
    /// Row by row.
    pub matrix: [f32; 4],
}

impl Warp {
    /// Neither turned nor scaled.
    pub fn upright(at: [f32; 2]) -> Self {
        Self { at, matrix: [1.0, 0.0, 0.0, 1.0] }
    }

    /// The same at another place, its matrix turned, scaled and slanted by `turn` (row by row) in addition.
    pub fn moved(&self, at: [f32; 2], turn: &[f32; 4]) -> Self {
        let ([a, b, c, d], [ta, tb, tc, td]) = (self.matrix, *turn);
        Self { at, matrix: [ta * a + tb * c, ta * b + tb * d, tc * a + td * c, tc * b + td * d] }
    }

    /// The matrix that leads from an earlier warp's to this one's: `self before⁻¹`.
    pub fn turn_since(&self, before: &Self) -> Option<[f32; 4]> {
        let [a, b, c, d] = self.matrix;
        let [oa, ob, oc, od] = before.matrix;
        let turn = Matrix2::new(a, b, c, d) * Matrix2::new(oa, ob, oc, od).try_inverse()?;
        Some([turn[(0, 0)], turn[(0, 1)], turn[(1, 0)], turn[(1, 1)]])
    }

    /// Whether the whole patch lies inside an image.
    fn is_inside(&self, image: ImageView<'_>) -> bool {
        let reach = (HALF + 1) as f32;
        let [a, b, c, d] = self.matrix;
        let (u, v) = (reach * (a.abs() + b.abs()) + 1.0, reach * (c.abs() + d.abs()) + 1.0);
        self.at[0] >= u
            && self.at[1] >= v
            && self.at[0] + u < (image.width - 1) as f32
            && self.at[1] + v < (image.height - 1) as f32
    }

    /// Whether it is neither so small, nor so large, nor so slanted that the patch no longer resembles itself.
    fn is_reasonable(&self) -> bool {
        let [a, b, c, d] = self.matrix;
        let determinant = a * d - b * c;
        let squares = a * a + b * b + c * c + d * d;
        // The singular values' ratio r has r + 1/r = squares / determinant.
        (0.3..3.0).contains(&determinant) && squares < 2.6 * determinant
    }

    /// The difference of its matrix from another's, in the patch's coordinates: `other⁻¹ self − 1`.
    fn apart(&self, other: &Self) -> Option<[f32; 4]> {
        let [a, b, c, d] = self.matrix;
        let [oa, ob, oc, od] = other.matrix;
        let apart = Matrix2::new(oa, ob, oc, od).try_inverse()? * Matrix2::new(a, b, c, d);
        Some([apart[(0, 0)] - 1.0, apart[(0, 1)], apart[(1, 0)], apart[(1, 1)] - 1.0])
    }

    /// `self ∘ (x ↦ (1 + D) x + d)⁻¹`
    fn less(&self, step: &SVector<f32, PARAMETERS>) -> Option<Self> {
        let inverse = Matrix2::new(1.0 + step[2], step[3], step[4], 1.0 + step[5]).try_inverse()?;
        let [a, b, c, d] = self.matrix;
        let matrix = Matrix2::new(a, b, c, d) * inverse;
        let shift = matrix * step.fixed_rows::<2>(0);
        Some(Self {
            at: [self.at[0] - shift[0], self.at[1] - shift[1]],
            matrix: [matrix[(0, 0)], matrix[(0, 1)], matrix[(1, 0)], matrix[(1, 1)]],
        })
    }
}

/// A patch found.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    pub warp: Warp,
    pub correlation: f32,
    /// Its contrast over that of the patch looked for.
    pub gain: f32,
    /// One sigma of the place along its worse axis, pixels.
    pub sigma: f32,
}

/// The patch that is searched, with everything that can be computed once.
#[derive(Clone, Debug)]
pub(super) struct Template {
    /// Grey levels less their mean.
    grey: Patch,
    power: f32,
    /// Grey levels' derivatives by the parameters, without the part that gain and offset of the light explain.
    steepest: [Patch; PARAMETERS],
    /// `(Σ sᵀ s + Λ)⁻¹` with the steepest descent s and the weight Λ of the predicted matrix.
    inverse: SMatrix<f32, PARAMETERS, PARAMETERS>,
    /// How far a residual moves the found place along u and along v, pixels a grey level.
    influence: [Patch; 2],
    /// Larger variance of the place for residuals of variance one.
    spread: f32,
}

impl Template {
    /// Whether the patch around a place lies inside an image.
    pub fn fits(image: ImageView<'_>, at: [f32; 2]) -> bool {
        Warp::upright(at).is_inside(image)
    }

    /// The patch around the point at which its edges point, nearest to a place, at a whole pixel, so that the patch
    /// itself is not interpolated; `None` where it has too little structure.
    pub fn new(image: ImageView<'_>, near: [f32; 2], simd: Simd) -> Option<(Self, Warp)> {
        let mut warp = Warp::upright(near.map(f32::round));
        let mut gradient = gradients(image, &warp, simd)?;
        for _ in 0..2 {
            let Some(middle) = pointed_at(&gradient) else { break };
            let moved = Warp::upright([warp.at[0] + middle[0].round(), warp.at[1] + middle[1].round()]);
            if moved == warp {
                break;
            }
            (gradient, warp) = (gradients(image, &moved, simd)?, moved);
        }
        let mut grey = [0.0; AREA];
        sample(image, &warp, &mut grey, simd);
        center(&mut grey);
        let mut steepest = [[0.0; AREA]; PARAMETERS];
        for i in 0..SIDE * SIDE {
            let offset = offset(i);
            for axis in 0..2 {
                steepest[axis][i] = gradient[axis][i];
                steepest[2 + 2 * axis][i] = gradient[axis][i] * offset[0];
                steepest[3 + 2 * axis][i] = gradient[axis][i] * offset[1];
            }
        }
        let power = dot(&grey, &grey);
        for image in &mut steepest {
            center(image);
            let share = dot(image, &grey) / power.max(1e-6);
            image.iter_mut().zip(&grey).for_each(|(s, g)| *s -= share * g);
        }
        let hessian = SMatrix::<f64, PARAMETERS, PARAMETERS>::from_fn(|i, j| {
            f64::from(dot(&steepest[i], &steepest[j]))
        });
        let place = hessian.cholesky()?.inverse().fixed_view::<2, 2>(0, 0).into_owned();
        let prior =
            SVector::<f64, PARAMETERS>::from_fn(|i, _| if i < 2 { 0.0 } else { f64::from(MATRIX_WEIGHT) });
        let inverse = (hessian + SMatrix::from_diagonal(&prior)).cholesky()?.inverse();
        let spread = place.symmetric_eigenvalues().max() as f32;
        if !(spread.is_finite() && spread > 0.0) {
            return None;
        }
        let inverse: SMatrix<f32, PARAMETERS, PARAMETERS> = inverse.cast();
        let mut influence = [[0.0; AREA]; 2];
        for (axis, influence) in influence.iter_mut().enumerate() {
            for (k, steepest) in steepest.iter().enumerate() {
                let weight = inverse[(axis, k)];
                influence.iter_mut().zip(steepest).for_each(|(w, s)| *w += weight * s);
            }
        }
        Some((Self { grey, power, steepest, inverse, influence, spread }, warp))
    }

    /// Sigma of the place where pixels have noise of one grey level, pixels.
    pub fn sigma_a_level(&self) -> f32 {
        self.spread.sqrt()
    }

    /// The patch near a guess, whose matrix is the predicted one; `None` where the search diverges or leaves the image.
    pub fn find(&self, image: ImageView<'_>, guess: Warp, simd: Simd) -> Option<Found> {
        let mut warp = guess;
        let mut seen = [0.0; AREA];
        for _ in 0..STEPS {
            if !warp.is_inside(image) || !warp.is_reasonable() {
                return None;
            }
            sample(image, &warp, &mut seen, simd);
            let gain = dot(&seen, &self.grey) / self.power;
            if !(gain > 0.05) {
                return None;
            }
            let astray = warp.apart(&guess)?;
            let pull = SVector::<f32, PARAMETERS>::from_fn(|i, _| {
                let prior = i.checked_sub(2).map_or(0.0, |i| MATRIX_WEIGHT * astray[i]);
                dot(&self.steepest[i], &seen) / gain + prior
            });
            let step = self.inverse * pull;
            warp = warp.less(&step)?;
            let far = (warp.at[0] - guess.at[0]).abs().max((warp.at[1] - guess.at[1]).abs());
            if !(far < FARTHEST) {
                return None;
            }
            let turned = step.iter().skip(2).fold(0.0f32, |most, x| most.max(x.abs()));
            if step[0].abs().max(step[1].abs()) < 0.003 && turned * (HALF as f32) < 0.01 {
                break;
            }
        }
        if !warp.is_inside(image) || !warp.is_reasonable() {
            return None;
        }
        center(&mut seen);
        let (cross, power) = (dot(&seen, &self.grey), dot(&seen, &seen));
        let correlation = cross / (power * self.power).sqrt().max(1e-6);
        let gain = cross / self.power;
        let sigma = self.sigma(&seen, gain);
        Some(Found { warp, correlation, gain, sigma })
    }

    /// One sigma of the place along its worse axis, from the residuals. Pixels near each other have common errors (blur
    /// has changed, the ground is not flat), so the effect of whole blocks on the place is summed: `Σ (Σ w e)²`, the
    /// inner sum over a block, with the influence w of a residual e.
    fn sigma(&self, seen: &Patch, gain: f32) -> f32 {
        let mut pulls = [[0.0f32; BLOCKS * BLOCKS]; 2];
        for i in 0..SIDE * SIDE {
            let residual = seen[i] / gain - self.grey[i];
            let block = i / SIDE / BLOCK * BLOCKS + i % SIDE / BLOCK;
            for (pulls, influence) in pulls.iter_mut().zip(&self.influence) {
                pulls[block] += influence[i] * residual;
            }
        }
        let product = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        let (uu, vv, uv) =
            (product(&pulls[0], &pulls[0]), product(&pulls[1], &pulls[1]), product(&pulls[0], &pulls[1]));
        let half = 0.5 * (uu + vv);
        let most = half + (half * half - (uu * vv - uv * uv)).max(0.0).sqrt();
        // The fit has absorbed its share of them.
        let share = (BLOCKS * BLOCKS) as f32 / (BLOCKS * BLOCKS - PARAMETERS) as f32;
        (share * most).sqrt()
    }
}

/// Where in the patch a sample lies.
fn offset(i: usize) -> [f32; 2] {
    [(i % SIDE) as f32 - HALF as f32, (i / SIDE) as f32 - HALF as f32]
}

/// Derivatives by u and v of a patch that lies inside, by central differences.
fn gradients(image: ImageView<'_>, warp: &Warp, simd: Simd) -> Option<[Patch; 2]> {
    if !warp.is_inside(image) {
        return None;
    }
    let moved = |axis: usize, by: f32| {
        let mut warp = *warp;
        warp.at[axis] += by;
        let mut patch = [0.0; AREA];
        sample(image, &warp, &mut patch, simd);
        patch
    };
    Some([0, 1].map(|axis| {
        let (before, after) = (moved(axis, -1.0), moved(axis, 1.0));
        std::array::from_fn(|i| 0.5 * (after[i] - before[i]))
    }))
}

/// The point with the least weighted sum of squared distances from the lines across the gradients, `(Σ g gᵀ)⁻¹ Σ g gᵀ
/// x` (Förstner and Gülch 1987): scaling a patch about it does not shift the patch.
fn pointed_at(gradient: &[Patch; 2]) -> Option<[f32; 2]> {
    let (mut matrix, mut sum) = (Matrix2::<f32>::zeros(), Vector2::zeros());
    for i in 0..SIDE * SIDE {
        let g = Vector2::new(gradient[0][i], gradient[1][i]);
        let outer = g * g.transpose();
        matrix += outer;
        sum += outer * Vector2::from(offset(i));
    }
    let point = matrix.try_inverse()? * sum;
    (point.amax() < HALF as f32).then_some([point.x, point.y])
}

fn center(patch: &mut Patch) {
    let mean = patch.iter().sum::<f32>() / (SIDE * SIDE) as f32;
    patch[..SIDE * SIDE].iter_mut().for_each(|x| *x -= mean);
}

/// Sums lane by lane, so that every instruction set gives the same result.
fn dot(a: &Patch, b: &Patch) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for k in 0..LANES {
            sums[k] += a[k] * b[k];
        }
    }
    sums.iter().sum()
}

/// Grey levels under a warp that is inside the image, smoothed by 1 2 1 each way.
fn sample(image: ImageView<'_>, warp: &Warp, out: &mut Patch, simd: Simd) {
    simd.run(Sampling { image, warp, out });
}

struct Sampling<'a> {
    image: ImageView<'a>,
    warp: &'a Warp,
    out: &'a mut Patch,
}

impl Kernel for Sampling<'_> {
    #[inline(always)]
    fn run(self) {
        let [a, b, c, d] = self.warp.matrix;
        let mut wide = [[0.0f32; WIDE]; WIDE];
        for (y, row) in wide.iter_mut().enumerate() {
            let y = y as f32 - (HALF + 1) as f32;
            let (u0, v0) = (self.warp.at[0] + b * y, self.warp.at[1] + d * y);
            for (x, to) in row.iter_mut().enumerate() {
                let x = x as f32 - (HALF + 1) as f32;
                let (u, v) = (u0 + a * x, v0 + c * x);
                let (iu, iv) = (u as i32, v as i32);
                let (fu, fv) = (u - iu as f32, v - iv as f32);
                let at = iv as usize * self.image.stride + iu as usize;
                let data = self.image.data;
                let (above, below) = (&data[at..at + 2], &data[at + self.image.stride..][..2]);
                let p = [above[0], above[1], below[0], below[1]].map(f32::from);
                let top = p[0] + fu * (p[1] - p[0]);
                let bottom = p[2] + fu * (p[3] - p[2]);
                *to = top + fv * (bottom - top);
            }
        }
        for y in 0..SIDE {
            let (above, here, below) = (&wide[y], &wide[y + 1], &wide[y + 2]);
            let column: [f32; WIDE] = std::array::from_fn(|x| above[x] + 2.0 * here[x] + below[x]);
            for (x, to) in self.out[y * SIDE..(y + 1) * SIDE].iter_mut().enumerate() {
                *to = (column[x] + 2.0 * column[x + 1] + column[x + 2]) * (1.0 / 16.0);
            }
        }
    }
}
