//! A straight line under arrivals that are late by an unknown jitter, with its uncertainty.
//!
//! Arrival x at time t is a + b·t + jitter. The jitter is symmetric (normal of sigma s), or one-sided (exponential of
//! mean τ with a little normal noise: the exponentially modified Gaussian), or uniform up to a width w (arrivals that
//! wait for the next tick of a timer: USB adapters deliver every 16 ms). Its kind and size are not known: each
//! candidate is fitted by Newton's method (both log-densities are concave, so there is one maximum) and weighted by its
//! evidence in Laplace's approximation, and the line is the mean over all candidates. For symmetric jitter it runs
//! through the middle, for one-sided jitter along the lower edge, where nothing was late. A small share of the arrivals
//! may be anywhere, so that single outliers do not count.

/// A point: time in seconds, arrival in milliseconds.
pub(super) type Point = (f64, f64);

/// Sizes of jitter considered, milliseconds, each twice the one before.
const SIZES_MS: [f64; 8] = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0];
/// Widths of ticks considered, milliseconds: from 1, each √2 times the one before.
const TICKS: i32 = 11;
/// Normal noise at the edges of a tick, as a part of its width. So small that no point is near both edges.
const TICK_NOISE_PART: f64 = 1.0 / 16.0;
/// Normal noise beside one-sided jitter, as shares of it.
const NOISE_PARTS: [f64; 2] = [1.0 / 16.0, 0.2];
/// Least normal noise, milliseconds: the time to stamp a read.
const NOISE_MIN_MS: f64 = 0.1;
/// Points whose densities are multiplied before a logarithm is taken.
const PRODUCT: usize = 8;
/// Share of arrivals that are independent of the jitter, and their density over a second.
const WILD_PART: f64 = 0.01;
const WILD_DENSITY: f64 = WILD_PART / 1_000.0;
/// How much rarer outliers before the line are with ticks: nothing is delivered before it exists, and apparent cases
/// show that the ticks hid how late the others were.
const WILD_EARLY: f64 = 1e-4;
/// Prior log-odds of symmetric against one-sided jitter: operating systems and receivers are late, not early.
const LOG_SYMMETRIC: f64 = -3.0;
/// Most Newton steps; from the previous line one is enough.
const STEPS_MAX: usize = 30;
/// A step shorter than this share of the normal noise is the last one. A line through a hundred points is known to a
/// tenth of that noise, and what is left after such a step is of the order of its square.
const STEP_LAST: f64 = 0.05;
/// Candidates whose log-weight is below the largest by more than this are rarely fitted.
const LOG_WEIGHT_FAINT: f64 = -25.0;
/// They are fitted again after so many fits, and no more than these in one fit: all of them together would take a
/// millisecond of one arrival's time.
const FAINT_EVERY: u32 = 16;
const FAINT_PER_FIT: usize = 3;

/// Shape of the jitter, milliseconds.
#[derive(Clone, Copy, Debug)]
struct Shape {
    /// Normal part.
    sigma: f64,
    /// Mean of the one-sided part; 0 for none.
    tau: f64,
    /// Width of the uniform part, up to a tick; 0 for none.
    width: f64,
    /// Factor of the density: 1/(σ√2π), exp(σ²/2τ²)/τ or 1/width.
    scale: f64,
}

/// One candidate shape with its fitted line.
#[derive(Clone, Debug)]
struct Candidate {
    shape: Shape,
    /// Value at the fit's mean time, slope per second.
    line: (f64, f64),
    /// Covariance of (value, slope): var, cov, var.
    covariance: [f64; 3],
    log_weight: f64,
    /// Number of the fit in which it was fitted last; 0 for never.
    fits: u32,
}

/// The fit over all candidate shapes.
#[derive(Clone, Debug)]
pub(super) struct JitterFit {
    candidates: Vec<Candidate>,
    slope_sigma: f64,
    /// Density of outliers before the line.
    wild_early: f64,
    t_mean: f64,
    /// Number of fits.
    fits: u32,
}

impl JitterFit {
    /// `slope_sigma`: prior one-sigma of the slope, milliseconds a second.
    pub(super) fn new(slope_sigma: f64) -> Self {
        Self::of_shapes(slope_sigma, false)
    }

    /// The same for arrivals that may wait for a tick.
    pub(super) fn with_ticks(slope_sigma: f64) -> Self {
        Self::of_shapes(slope_sigma, true)
    }

    fn of_shapes(slope_sigma: f64, with_ticks: bool) -> Self {
        let symmetric = SIZES_MS.iter().map(|&sigma| Shape::new(sigma, 0.0, 0.0));
        let one_sided = SIZES_MS.iter().flat_map(|&tau| {
            NOISE_PARTS.iter().map(move |part| Shape::new((tau * part).max(NOISE_MIN_MS), tau, 0.0))
        });
        let ticks = (0..if with_ticks { TICKS } else { 0 }).map(|n| {
            let width = (f64::from(n) * 0.5).exp2();
            Shape::new(width * TICK_NOISE_PART, 0.0, width)
        });
        let candidates = symmetric
            .chain(one_sided)
            .chain(ticks)
            .map(|shape| Candidate {
                shape,
                line: (0.0, 0.0),
                covariance: [0.0; 3],
                log_weight: 0.0,
                fits: 0,
            })
            .collect();
        let wild_early = WILD_DENSITY * if with_ticks { WILD_EARLY } else { 1.0 };
        Self { candidates, slope_sigma, wild_early, t_mean: 0.0, fits: 0 }
    }

    /// Fits the line to these points, starting from the previous fit.
    pub(super) fn fit(&mut self, points: &[Point]) {
        if points.is_empty() {
            return;
        }
        let count = points.len() as f64;
        let t_mean = points.iter().map(|p| p.0).sum::<f64>() / count;
        let x_mean = points.iter().map(|p| p.1).sum::<f64>() / count;
        let moved = t_mean - self.t_mean;
        self.t_mean = t_mean;
        self.fits = self.fits.wrapping_add(1);
        let mut faint = 0;
        for candidate in &mut self.candidates {
            if candidate.fits == 0 {
                candidate.line = (x_mean - candidate.shape.late(), 0.0);
            } else {
                candidate.line.0 += candidate.line.1 * moved;
                if candidate.log_weight == f64::NEG_INFINITY {
                    let due = self.fits.wrapping_sub(candidate.fits) >= FAINT_EVERY && faint < FAINT_PER_FIT;
                    faint += usize::from(due);
                    if !due {
                        continue;
                    }
                }
            }
            candidate.maximise(points, t_mean, (self.slope_sigma, self.wild_early));
            candidate.fits = self.fits;
        }
        let heaviest = self.candidates.iter().map(|c| c.log_weight).fold(f64::NEG_INFINITY, f64::max);
        for candidate in &mut self.candidates {
            let log_weight = candidate.log_weight - heaviest;
            candidate.log_weight = if log_weight < LOG_WEIGHT_FAINT { f64::NEG_INFINITY } else { log_weight };
        }
    }

    /// The line and its one-sigma at time `t`, milliseconds.
    pub(super) fn at(&self, t: f64) -> (f64, f64) {
        let dt = t - self.t_mean;
        let value = |candidate: &Candidate| candidate.line.0 + candidate.line.1 * dt;
        let mean = self.weighted(value);
        let variance = self.weighted(|candidate| {
            let [vv, vs, ss] = candidate.covariance;
            vv + 2.0 * vs * dt + ss * dt * dt + (value(candidate) - mean).powi(2)
        });
        (mean, variance.max(0.0).sqrt())
    }

    /// The slope, milliseconds a second.
    pub(super) fn slope(&self) -> f64 {
        self.weighted(|candidate| candidate.line.1)
    }

    /// Size of the jitter: normal sigma and mean lateness, milliseconds.
    pub(super) fn jitter_ms(&self) -> (f64, f64) {
        (self.weighted(|candidate| candidate.shape.sigma), self.weighted(|candidate| candidate.shape.late()))
    }

    fn weighted(&self, of: impl Fn(&Candidate) -> f64) -> f64 {
        let (mut sum, mut weights) = (0.0, 0.0);
        for candidate in self.candidates.iter().filter(|candidate| candidate.fits > 0) {
            let weight = candidate.log_weight.exp();
            sum += weight * of(candidate);
            weights += weight;
        }
        if weights > 0.0 { sum / weights } else { 0.0 }
    }
}

/// Log-likelihood with its slope and curvature over (value, slope) of the line.
struct Quadratic {
    log: f64,
    gradient: [f64; 2],
    /// Negative second derivatives: aa, ab, bb.
    curvature: [f64; 3],
}

impl Quadratic {
    /// To the maximum of this quadratic.
    fn step(&self) -> (f64, f64) {
        let [aa, ab, bb] = self.curvature;
        let det = aa * bb - ab * ab;
        let [ga, gb] = self.gradient;
        ((bb * ga - ab * gb) / det, (aa * gb - ab * ga) / det)
    }
}

impl Candidate {
    fn maximise(&mut self, points: &[Point], t_mean: f64, beliefs: (f64, f64)) {
        let reach = 4.0 * (self.shape.sigma + self.shape.late());
        let half_s = 0.5 * (points[points.len() - 1].0 - points[0].0);
        let mut line = self.line;
        let mut here = self.quadratic(points, t_mean, beliefs, line);
        for _ in 0..STEPS_MAX {
            let mut step = here.step();
            if step.0.abs() + step.1.abs() * half_s < STEP_LAST * self.shape.sigma {
                // So near to the maximum the function is its own quadratic.
                line = (line.0 + step.0, line.1 + step.1);
                here.log += 0.5 * (here.gradient[0] * step.0 + here.gradient[1] * step.1);
                break;
            }
            let long = (step.0.abs() / reach).max(1.0);
            step = (step.0 / long, step.1 / long);
            let mut better = None;
            for _ in 0..8 {
                let next = (line.0 + step.0, line.1 + step.1);
                let there = self.quadratic(points, t_mean, beliefs, next);
                if there.log >= here.log - 1e-9 {
                    better = Some((next, there));
                    break;
                }
                step = (step.0 * 0.5, step.1 * 0.5);
            }
            let Some((next, there)) = better else {
                break;
            };
            (line, here) = (next, there);
        }
        let [aa, ab, bb] = here.curvature;
        let det = aa * bb - ab * ab;
        self.line = line;
        self.covariance = [bb / det, -ab / det, aa / det];
        let belief = if self.shape.late() == 0.0 { LOG_SYMMETRIC } else { 0.0 };
        self.log_weight = here.log - 0.5 * det.ln() + belief;
    }

    fn quadratic(
        &self,
        points: &[Point],
        t_mean: f64,
        (slope_sigma, wild_early): (f64, f64),
        line: (f64, f64),
    ) -> Quadratic {
        let prior = 1.0 / (slope_sigma * slope_sigma);
        let mut sum = Quadratic {
            log: -0.5 * prior * line.1 * line.1,
            gradient: [0.0, -prior * line.1],
            // A lower limit keeps the value determined where the density is flat (all points far above, or all between
            // the edges of a tick).
            curvature: [if self.shape.width > 0.0 { self.shape.width.powi(-2) } else { 1e-9 }, 0.0, prior],
        };
        for some in points.chunks(PRODUCT) {
            // One logarithm of a product for some points: each factor is at least the density of outliers.
            let mut product = 1.0;
            for &(t, x) in some {
                let dt = t - t_mean;
                let off = x - line.0 - line.1 * dt;
                let (density, slope, bend) = self.shape.density(off);
                // In addition to the jitter, a few arrivals may be anywhere; the weight of a point is its probability of
                // not being one of these.
                let density = (1.0 - WILD_PART) * density;
                let mixed = density + if off < 0.0 { wild_early } else { WILD_DENSITY };
                let trust = density / mixed;
                let (slope, bend) = (trust * slope, trust * bend);
                product *= mixed;
                sum.gradient[0] -= slope;
                sum.gradient[1] -= slope * dt;
                sum.curvature[0] -= bend;
                sum.curvature[1] -= bend * dt;
                sum.curvature[2] -= bend * dt * dt;
            }
            sum.log += product.ln();
        }
        sum
    }
}

impl Shape {
    fn new(sigma: f64, tau: f64, width: f64) -> Self {
        let scale = if width > 0.0 {
            1.0 / width
        } else if tau > 0.0 {
            (0.5 * (sigma / tau).powi(2)).exp() / tau
        } else {
            1.0 / (sigma * SQRT_2PI)
        };
        Self { sigma, tau, width, scale }
    }

    /// Mean lateness.
    fn late(self) -> f64 {
        self.tau + 0.5 * self.width
    }

    /// Density of the jitter `u`, with the first and second derivative of its logarithm.
    ///
    /// One-sided: f = exp(s²/2τ² − u/τ) Φ(z) / τ, z = u/s − s/τ.
    /// Up to a tick: f = Φ(z) / w, z of the nearer edge, u/s or (w − u)/s.
    fn density(self, u: f64) -> (f64, f64, f64) {
        let Self { sigma, tau, width, scale } = self;
        if width > 0.0 {
            let (inside, sign) = if u < 0.5 * width { (u, 1.0) } else { (width - u, -1.0) };
            let z = inside / sigma;
            let (phi, mills) = normal_cdf(z, 0.0);
            return (scale * phi, sign * mills / sigma, -mills * (z + mills) / (sigma * sigma));
        }
        if tau == 0.0 {
            let z = u / sigma;
            return (scale * (-0.5 * z * z).exp(), -z / sigma, -1.0 / (sigma * sigma));
        }
        let z = u / sigma - sigma / tau;
        let (phi, mills) = normal_cdf(z, -u / tau);
        (scale * phi, mills / sigma - 1.0 / tau, -mills * (z + mills) / (sigma * sigma))
    }
}

/// √(2π).
const SQRT_2PI: f64 = 2.506_628_274_631_000_5;

/// exp(e) Φ(z) and φ(z)/Φ(z) of the normal distribution, for any z. The exponent is added to that of Φ, whose product
/// with exp(e) may be moderate where neither of the two is.
fn normal_cdf(z: f64, e: f64) -> (f64, f64) {
    let scaled = scaled_erfc(z.abs() * std::f64::consts::FRAC_1_SQRT_2);
    if z < 0.0 {
        // Φ(z) = ½ exp(−z²/2) erfcx(−z/√2)
        let mills = (2.0 / std::f64::consts::PI).sqrt() / scaled;
        return (0.5 * scaled * (e - 0.5 * z * z).exp(), mills);
    }
    let gauss = (-0.5 * z * z).exp();
    let phi = 1.0 - 0.5 * gauss * scaled;
    let raised = if e == 0.0 { 1.0 } else { e.exp() };
    (raised * phi, gauss / (SQRT_2PI * phi))
}

/// exp(x²)·erfc(x) for x ≥ 0, to 1.2·10⁻⁷ of its value (Chebyshev fit, Numerical Recipes 6.2).
fn scaled_erfc(x: f64) -> f64 {
    const C: [f64; 10] = [
        -1.265_512_23,
        1.000_023_68,
        0.374_091_96,
        0.096_784_18,
        -0.186_288_06,
        0.278_868_07,
        -1.135_203_98,
        1.488_515_87,
        -0.822_152_23,
        0.170_872_77,
    ];
    let t = 1.0 / (1.0 + 0.5 * x);
    t * C.iter().rev().fold(0.0, |sum, c| sum * t + c).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_tail_is_accurate() {
        // Φ(0) = ½, Φ(1) = 0.841344746, ln Φ(−10) = −53.23128515
        assert!((normal_cdf(0.0, 0.0).0 - 0.5).abs() < 1e-6);
        assert!((normal_cdf(1.0, 0.0).0 - 0.841_344_746).abs() < 1e-6);
        assert!((normal_cdf(-10.0, 0.0).0.ln() + 53.231_285_15).abs() < 1e-5);
        assert!((normal_cdf(-1e3, 5e5).0 - 3.989_42e-4).abs() < 1e-8, "φ(0)/1000");
        assert!(normal_cdf(-1e4, 0.0).0 == 0.0 && normal_cdf(1e4, 0.0).1 == 0.0);
    }

    #[test]
    fn derivatives_agree_with_differences() {
        for shape in [Shape::new(2.0, 0.0, 0.0), Shape::new(1.0, 8.0, 0.0), Shape::new(1.0, 0.0, 16.0)] {
            for u in [-5.0, -0.5, 0.0, 1.0, 20.0] {
                let h = 1e-3;
                let (below, here, above) = (shape.density(u - h), shape.density(u), shape.density(u + h));
                assert!(((above.0.ln() - below.0.ln()) / (2.0 * h) - here.1).abs() < 1e-3, "{shape:?} {u}");
                assert!(((above.1 - below.1) / (2.0 * h) - here.2).abs() < 1e-3, "{shape:?} {u}");
                assert!(here.2 <= 0.0, "concave");
            }
        }
    }

    #[test]
    fn points_on_a_line_give_the_line() {
        let mut fit = JitterFit::new(1.0);
        let points: Vec<Point> = (0..50).map(|i| f64::from(i) * 0.2).map(|t| (t, 3.0 + 0.5 * t)).collect();
        fit.fit(&points);
        let (value, sigma) = fit.at(9.8);
        // Jitter below the smallest candidate size cannot be distinguished from none.
        assert!((value - 7.9).abs() < 0.2 && sigma < 0.1, "{value} ± {sigma}");
        assert!((fit.slope() - 0.5).abs() < 0.01, "{}", fit.slope());
    }

    #[test]
    fn one_wild_point_does_not_count() {
        let mut fit = JitterFit::new(1.0);
        let late = |i: u32| if i == 30 { -200.0 } else { 4.0 * f64::from(i * 7 % 10) / 10.0 };
        let points: Vec<Point> = (0..50).map(|i| (f64::from(i) * 0.2, late(i))).collect();
        fit.fit(&points);
        assert!(fit.at(9.8).0 > -2.0, "{:?}", fit.at(9.8));
    }
}
