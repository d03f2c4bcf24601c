//! Figures on noise and motion from the flight itself.
//!
//! Of the blocks of a source the expected sum of squares is `Σ (m − tr(J P Jᵀ))`: what is left over of m rows once the unknowns
//! have taken their part. The figure on its variance moves by the ratio of what is found to that (variance components: Förstner
//! 1979; the same as the evidence of MacKay 1992).

use crate::block::{Block, Noise, Source};
use crate::front::Back;

/// Fewer rows that are free to tell something than this leave a figure as it is.
const FEWEST: f64 = 8.0;
/// A figure of motion moves by no more than this at once.
const AT_ONCE: f64 = 30.0;
/// Limits of figures of motion.
const MOTION: (f64, f64) = (1e-9, 1e6);

/// Sums over the blocks of each source.
#[derive(Clone, Debug)]
pub(crate) struct Components {
    found: Vec<f64>,
    due: Vec<f64>,
}

impl Components {
    pub(crate) fn new(targets: usize) -> Self {
        let n = Source::count(targets);
        Self { found: vec![0.0; n], due: vec![0.0; n] }
    }

    /// Takes a block that is no outlier.
    pub(crate) fn take(&mut self, source: Source, block: &Block, back: &Back) {
        let width = block.columns.len();
        let taken: f64 =
            block.rows.chunks_exact(width).map(|row| back.product(&block.columns, row, row)).sum();
        self.found[source.index()] += block.square();
        self.due[source.index()] += (block.len() as f64 - taken).max(0.0);
    }

    /// Moves the figures; by how much the one that moved most did (its logarithm).
    pub(crate) fn fit(&self, targets: usize, noise: &mut Noise) -> f64 {
        let mut most = 0.0f64;
        for source in fitted(targets) {
            let (found, due) = (self.found[source.index()], self.due[source.index()]);
            if due < FEWEST {
                continue;
            }
            let ratio = (found / due).clamp(1.0 / AT_ONCE, AT_ONCE);
            let (least, largest) = limits(source);
            let before = noise.of(source);
            let after = (before * ratio).clamp(least, largest);
            most = most.max((after / before).ln().abs());
            noise.set(source, after);
        }
        most
    }
}

/// The sources whose figures are fitted.
fn fitted(targets: usize) -> impl Iterator<Item = Source> {
    use Source as S;
    let own = [
        S::GpsPosition,
        S::GpsVelocity,
        S::Heading,
        S::Tilt,
        S::Feature,
        S::TiltMotion,
        S::YawMotion,
        S::Gust,
        S::Thrust,
    ];
    own.into_iter().chain((0..targets).flat_map(|t| [S::Marker(t), S::Drive(t), S::Turn(t)]))
}

/// Limits of a figure: of measurements, factors on the variance configured.
fn limits(source: Source) -> (f64, f64) {
    match source {
        Source::GpsPosition | Source::GpsVelocity => (0.25, 25.0),
        Source::Heading => (0.25, 36.0),
        Source::Tilt => (0.25, 400.0),
        Source::Marker(_) | Source::Feature => (0.01, 25.0),
        _ => MOTION,
    }
}

/// Figures to begin with: intensities of jerk, variances of gusts and of the thrust's excess.
pub(crate) fn first(targets: usize, gust_mps2: f64, thrust_mps2: f64) -> Noise {
    let mut noise = Noise::new(targets);
    noise.set(Source::TiltMotion, 3.0);
    noise.set(Source::YawMotion, 0.5);
    noise.set(Source::Gust, gust_mps2.powi(2));
    noise.set(Source::Thrust, thrust_mps2.powi(2));
    for target in 0..targets {
        noise.set(Source::Drive(target), 0.5);
        noise.set(Source::Turn(target), 0.2);
    }
    noise
}
