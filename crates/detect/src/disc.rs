//! Discs: round regions lighter, darker or of another colour than what surrounds them, their centres to a
//! fraction of a pixel, and which disc of the configuration each one is.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::binarise::{Binariser, Bitmap, Where};
use super::components::{Component, Labeller, Outline, Touch};
use super::quad::bilinear;
use super::simd::Simd;
use windhover_base::msg::ImageView;

/// A round region.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Blob {
    /// Centre of the ellipse.
    pub center: Vector2<f64>,
    /// Covariance of the centre, px².
    pub cov: Matrix2<f64>,
    /// Mean of the two axes.
    pub diameter: f64,
    /// Half axes, larger first, and the direction of the larger one.
    pub half_axes: [f64; 2],
    pub major: Vector2<f64>,
}

/// Smallest disc looked for, pixels: below it round and square are alike.
const LEAST_DIAMETER: f64 = 8.0;

/// Shorter axis over longer one: discs are seen from above, at most 60° off their normal.
const LEAST_AXES: f64 = 0.5;

/// Rays from the centre along which the rim is looked for.
const RAYS: usize = 48;

/// Rays that must meet the rim: a disc half hidden or cut by a shadow has no centre to give.
const LEAST_RAYS: usize = 42;

/// Finds discs; keeps its buffers.
#[derive(Clone, Debug)]
pub(super) struct DiscFinder {
    simd: Simd,
    binariser: Binariser,
    bits: Bitmap,
    labeller: Labeller,
}

impl DiscFinder {
    /// A finder.
    pub fn new() -> Self {
        Self {
            simd: Simd::best(),
            binariser: Binariser::default(),
            bits: Bitmap::default(),
            labeller: Labeller::default(),
        }
    }

    /// Appends the dark discs of an image whose diameter is within `sizes`, pixels.
    pub fn find(&mut self, image: ImageView<'_>, sizes: (f64, f64), out: &mut Vec<Blob>) {
        if image.width.min(image.height) < 8 {
            return;
        }
        let least = sizes.0.max(LEAST_DIAMETER);
        self.binariser.measure(image, (LEAST_STEP, LEAST_STEP), false, self.simd);
        self.binariser.mark(image, 128, Where::Everywhere, &mut self.bits, self.simd);
        let (width, height) = (image.width, image.height);
        let keep = |c: &Component| {
            let (w, h) = (c.width() as f64, c.height() as f64);
            let inside = c.left > 0
                && c.top > 0
                && usize::from(c.right) + 1 < width
                && usize::from(c.bottom) + 1 < height;
            inside
                && w.max(h) + 1.0 >= least
                && w.min(h) <= sizes.1 + 2.0
                && w.min(h) >= LEAST_AXES * 0.9 * w.max(h)
        };
        self.labeller.label(&self.bits, Touch::Corners, self.simd, keep);
        for (component, outline) in self.labeller.kept() {
            if let Some(rough) = ellipse_of(component, outline)
                && let Some(blob) = refine(image, &rough)
                && (least..=sizes.1).contains(&blob.diameter)
                && !out.iter().any(|b| (b.center - blob.center).norm() < 0.25 * blob.diameter)
            {
                out.push(blob);
            }
        }
    }
}

/// Least step from a disc to what surrounds it, grey levels.
const LEAST_STEP: u8 = 20;

/// An ellipse by its centre and the matrix of `(p − c)ᵀ M (p − c) = 1`.
#[derive(Clone, Copy, Debug)]
struct Ellipse {
    center: Vector2<f64>,
    shape: Matrix2<f64>,
}

impl Ellipse {
    /// Distance from the centre to the rim in a direction.
    fn radius(&self, d: Vector2<f64>) -> f64 {
        1.0 / (d.transpose() * self.shape * d)[0].max(1e-9).sqrt()
    }
}

/// The ellipse with the second moments of what an outline encloses; `None` where its area is not that of an
/// ellipse with these moments, `4π √det`.
fn ellipse_of(component: &Component, outline: Outline<'_>) -> Option<Ellipse> {
    let (mut n, mut sum, mut square) = (0.0, Vector2::zeros(), Matrix2::<f64>::zeros());
    let (u0, v0) = (f64::from(component.left), f64::from(component.top));
    for (row, &(left, right)) in outline.iter().enumerate() {
        let (a, b) = (f64::from(left) - u0, f64::from(right) - u0);
        let (count, middle, v) = (b - a + 1.0, 0.5 * (a + b), row as f64);
        n += count;
        sum += Vector2::new(count * middle, count * v);
        // Σ u² over a..=b is count (middle² + (count² − 1) / 12).
        let uu = count * (middle * middle + (count * count - 1.0) / 12.0);
        square += Matrix2::new(uu, count * middle * v, count * middle * v, count * v * v);
    }
    let center = sum / n;
    // A pixel is a square, not a point: a twelfth along each axis.
    let moments = square / n - center * center.transpose() + Matrix2::identity() / 12.0;
    let det = moments.determinant();
    if !(det > 0.0) {
        return None;
    }
    let area = 4.0 * std::f64::consts::PI * det.sqrt();
    let slack = 0.03 + 0.6 / n.sqrt();
    ((n / area - 1.0).abs() < slack)
        .then_some(Ellipse { center: center + Vector2::new(u0, v0), shape: (moments * 4.0).try_inverse()? })
}

/// Fits an ellipse to the rim found along rays, twice.
fn refine(image: ImageView<'_>, rough: &Ellipse) -> Option<Blob> {
    let mut ellipse = *rough;
    let mut fit = None;
    for _ in 0..3 {
        let (points, count) = rim(image, &ellipse);
        if count < LEAST_RAYS {
            return None;
        }
        let found = fit_conic(&points[..count], &ellipse)?;
        ellipse = found.0;
        fit = Some(found);
    }
    let (ellipse, rms, cov) = fit?;
    let eigen = ellipse.shape.symmetric_eigen();
    let axes = eigen.eigenvalues.map(|e| 1.0 / e.max(1e-12).sqrt());
    let larger = usize::from(axes[1] > axes[0]);
    let half_axes = [axes[larger], axes[1 - larger]];
    let round = half_axes[1] >= LEAST_AXES * half_axes[0];
    // What is no ellipse leaves residuals that grow with it: a square's are a tenth of its radius.
    let fits = rms <= 0.15 + 0.02 * half_axes[0];
    (round && fits && half_axes[0].is_finite()).then(|| Blob {
        center: ellipse.center,
        cov,
        diameter: half_axes[0] + half_axes[1],
        half_axes,
        major: eigen.eigenvectors.column(larger).into_owned(),
    })
}

/// Where the image steps from dark to light along rays from the centre.
fn rim(image: ImageView<'_>, ellipse: &Ellipse) -> ([Vector2<f64>; RAYS], usize) {
    const HALF: usize = 8;
    let mut points = [Vector2::zeros(); RAYS];
    let mut count = 0;
    for k in 0..RAYS {
        let (s, c) = (std::f64::consts::TAU * k as f64 / RAYS as f64).sin_cos();
        let d = Vector2::new(c, s);
        let radius = ellipse.radius(d);
        let spacing = (radius / 16.0).clamp(0.4, 1.0);
        let mut gradients = [0.0f64; 2 * HALF];
        let at = |i: usize| {
            let p = ellipse.center + d * (radius + (i as f64 - HALF as f64) * spacing);
            f64::from(bilinear(image, [p.x as f32, p.y as f32]))
        };
        let end = ellipse.center + d * (radius + HALF as f64 * spacing);
        if end.x < 0.0 || end.y < 0.0 || end.x > (image.width - 1) as f64 || end.y > (image.height - 1) as f64
        {
            continue;
        }
        let mut before = at(0);
        for (i, gradient) in gradients.iter_mut().enumerate() {
            let value = at(i + 1);
            *gradient = value - before;
            before = value;
        }
        // Centre of mass of the gradient under a window that follows it.
        let (mut center, mut mass, half) = (0.0, 0.0, HALF as f64 * 0.75);
        for _ in 0..3 {
            let (mut first, mut sum) = (0.0, 0.0);
            for (i, gradient) in gradients.iter().enumerate() {
                let x = i as f64 + 0.5 - HALF as f64 - center;
                let taper = (1.0 - (x / half).powi(2)).max(0.0).powi(2);
                first += gradient * taper * x;
                sum += gradient * taper;
            }
            if !(sum > f64::from(LEAST_STEP) / 2.0) {
                mass = 0.0;
                break;
            }
            mass = sum;
            center += (first / sum).clamp(-half, half);
        }
        if mass > 0.0 && center.abs() < 0.7 * HALF as f64 {
            points[count] = ellipse.center + d * (radius + center * spacing);
            count += 1;
        }
    }
    (points, count)
}

/// Least-squares ellipse through points by Gauss–Newton on radial distances from the one given, with the
/// RMS of what is left and the covariance of the centre. Cauchy weights: a twig over the rim must not pull.
fn fit_conic(points: &[Vector2<f64>], start: &Ellipse) -> Option<(Ellipse, f64, Matrix2<f64>)> {
    let mut ellipse = *start;
    let mut result = None;
    for round in 0..4 {
        let mut information = SMatrix::<f64, 5, 5>::zeros();
        let mut right = SVector::<f64, 5>::zeros();
        let (mut sum, mut weights) = (0.0, 0.0);
        for p in points {
            let d = p - ellipse.center;
            let m = ellipse.shape * d;
            let f = d.dot(&m).max(1e-12).sqrt();
            // Signed distance along the ray, nearly: (√(dᵀMd) − 1) r, r = |d| / √(dᵀMd).
            let scale = d.norm() / f;
            let residual = (f - 1.0) * scale;
            let row = SVector::<f64, 5>::from([
                -m.x / f * scale,
                -m.y / f * scale,
                0.5 * d.x * d.x / f * scale,
                d.x * d.y / f * scale,
                0.5 * d.y * d.y / f * scale,
            ]);
            let weight = if round == 0 { 1.0 } else { 1.0 / (1.0 + (residual / 0.5).powi(2)) };
            information += row * row.transpose() * weight;
            right -= row * (weight * residual);
            sum += residual * residual;
            weights += weight;
        }
        // Columns differ by the radius squared; scale before solving.
        let scale = information.diagonal().map(|d| 1.0 / d.max(1e-30).sqrt());
        let scaled = SMatrix::<f64, 5, 5>::from_fn(|i, j| information[(i, j)] * scale[i] * scale[j]);
        let inverse = scaled.cholesky()?.inverse();
        let step = (inverse * right.component_mul(&scale)).component_mul(&scale);
        ellipse.center += Vector2::new(step[0], step[1]);
        ellipse.shape += Matrix2::new(step[2], step[3], step[3], step[4]);
        if !(ellipse.shape.determinant() > 0.0 && ellipse.shape[(0, 0)] > 0.0) {
            return None;
        }
        let rms = (sum / points.len() as f64).sqrt();
        // Rays share pixels near small discs: count them as half as many; interpolation leaves its own.
        let variance = 2.0 * sum / (weights - 5.0).max(1.0);
        let cov = Matrix2::from_fn(|i, j| inverse[(i, j)] * scale[i] * scale[j]) * variance
            + Matrix2::identity() * 0.02 * 0.02;
        result = Some((ellipse, rms, cov));
    }
    result
}

/// How far the image of a disc's centre lies from the centre of its image, pixels.
///
/// A circle of radius ρ on a plane whose normal is θ off the line of sight, at distance Z and focal length f:
/// half axes a = fρ/Z and b = a cos θ, and the far half looks smaller, so that the ellipse's centre lies
/// nearer by a² sin θ cos θ / f, hence `a b √(1 − b²/a²) / f`, along the short axis. Which side is farther the
/// ellipse does not tell. For a disc that faces along the optical axis it is the one farther off the axis, and θ
/// is the angle off it; where θ is more than that, the camera is tilted by the rest, one way or the other. The
/// shift is taken in that share and the rest becomes covariance.
pub(super) fn center_shift(
    blob: &Blob,
    focal_px: f64,
    principal: Vector2<f64>,
) -> (Vector2<f64>, Matrix2<f64>) {
    let [a, b] = blob.half_axes;
    let size = a * b * (1.0 - (b / a).powi(2)).max(0.0).sqrt() / focal_px;
    let minor = Vector2::new(-blob.major.y, blob.major.x);
    // Below a pixel's worth of flattening the direction of the short axis is noise.
    if a - b < 0.02 * a {
        return (Vector2::zeros(), Matrix2::identity() * size * size);
    }
    let off_axis = (minor.dot(&(blob.center - principal)) / focal_px).atan();
    let share = (off_axis / (b / a).acos()).clamp(-1.0, 1.0);
    (minor * (size * share), minor * minor.transpose() * (size * size * (1.0 - share * share)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::GrayImage;

    /// A dark ellipse on light ground, 8×8 samples a pixel.
    fn drawn(center: (f64, f64), axes: (f64, f64), turn: f64, hide: f64) -> GrayImage {
        let mut image = GrayImage::new(96, 96);
        let (s, c) = turn.sin_cos();
        for (i, p) in image.data.iter_mut().enumerate() {
            let mut light = 0.0;
            for k in 0..64 {
                let u = (i % 96) as f64 + (f64::from(k % 8) + 0.5) / 8.0 - 0.5 - center.0;
                let v = (i / 96) as f64 + (f64::from(k / 8) + 0.5) / 8.0 - 0.5 - center.1;
                let (x, y) = (c * u + s * v, c * v - s * u);
                let dark = (x / axes.0).powi(2) + (y / axes.1).powi(2) < 1.0 && u < hide;
                light += if dark { 40.0 } else { 180.0 } / 64.0;
            }
            *p = (light + (i * 7919 % 13) as f64 - 6.0) as u8;
        }
        image
    }

    #[test]
    fn centres_of_ellipses_are_found_to_a_twentieth() {
        for (k, axes) in [(15.0, 15.0), (15.0, 11.0), (22.0, 18.0), (7.0, 6.5)].into_iter().enumerate() {
            let center = (47.3 + 0.21 * k as f64, 49.8 - 0.37 * k as f64);
            let image = drawn(center, axes, 0.4 * k as f64, f64::MAX);
            let mut found = Vec::new();
            DiscFinder::new().find(image.view(), (8.0, 60.0), &mut found);
            assert_eq!(found.len(), 1, "{axes:?}");
            let error = (found[0].center - Vector2::new(center.0, center.1)).norm();
            assert!(error < 0.06, "{axes:?}: {error}");
            assert!((found[0].diameter - axes.0 - axes.1).abs() < 0.4, "{}", found[0].diameter);
        }
    }

    #[test]
    fn half_hidden_discs_and_squares_are_refused() {
        let mut found = Vec::new();
        DiscFinder::new().find(drawn((48.0, 48.0), (16.0, 16.0), 0.0, 3.0).view(), (8.0, 60.0), &mut found);
        let mut square = GrayImage::from_vec(64, 64, vec![180; 4096]).expect("size");
        for v in 20..44 {
            (20..44).for_each(|u| square.data[v * 64 + u] = 40);
        }
        DiscFinder::new().find(square.view(), (8.0, 60.0), &mut found);
        assert_eq!(found, []);
    }
}
