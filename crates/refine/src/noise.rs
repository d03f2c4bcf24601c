//! Noise and motion factors from the flight itself.
//!
//! For the blocks of a source the expected sum of squares is `Σ (m − tr(J P Jᵀ))`: m rows less the part that the
//! unknowns absorb. The factor on its variance changes by the ratio of the observed to the expected sum (variance
//! components: Förstner 1979; equivalent to the evidence of MacKay 1992).

use crate::block::{Block, Noise, Source};
use crate::front::Back;

/// With fewer degrees of freedom than this a factor is not changed.
const FEWEST: f64 = 8.0;
/// Largest change of a motion factor in one round.
const AT_ONCE: f64 = 30.0;
/// Limits of motion factors.
const MOTION: (f64, f64) = (1e-6, 1e6);

/// Windows of time on either side over which a window's motion factor is fitted, the farther ones with less weight.
const REACH: usize = 3;
/// Weight of the whole flight's factor in each window, in rows.
const OF_WHOLE: f64 = 4.0;

/// Sums over the blocks of each source, in windows of time.
#[derive(Clone, Debug)]
pub(crate) struct Components {
    sums: Vec<Vec<Sum>>,
}

/// Sum of squares divided by the factor, the expected sum, and the first times the factor.
#[derive(Clone, Copy, Debug, Default)]
struct Sum {
    found: f64,
    due: f64,
    absolute: f64,
}

impl Sum {
    fn add(&mut self, other: &Self, weight: f64) {
        self.found += weight * other.found;
        self.due += weight * other.due;
        self.absolute += weight * other.absolute;
    }
}

impl Components {
    pub(crate) fn new(targets: usize, windows: usize) -> Self {
        Self { sums: vec![vec![Sum::default(); windows]; Source::count(targets)] }
    }

    /// Adds a block that has this weight in the solution, whitened with this factor.
    pub(crate) fn take(
        &mut self,
        source: Source,
        (window, figure, weight): (usize, f64, f64),
        block: &Block,
        back: &Back,
    ) {
        if source == Source::Known {
            return;
        }
        let width = block.columns.len();
        let taken: f64 = block.rows.chunks_exact(width).map(|row| back.variance(&block.columns, row)).sum();
        // Of the solution: as the linear model has it from here.
        let square = |(row, right): (&[f64], &f64)| (right - back.change(&block.columns, row)).powi(2);
        let found = weight * block.rows.chunks_exact(width).zip(&block.right).map(square).sum::<f64>();
        let due = (block.len() as f64 - taken).max(0.0);
        self.sums[source.index()][window].add(&Sum { found, due, absolute: found * figure }, 1.0);
    }

    /// Sum of squares and expected sum of some sources, over the whole flight.
    pub(crate) fn sums_of(&self, sources: &[Source]) -> [f64; 2] {
        let all = sources.iter().flat_map(|source| &self.sums[source.index()]);
        all.fold([0.0; 2], |[found, due], sum| [found + sum.found, due + sum.due])
    }

    /// Updates the factors; returns the largest change (its logarithm).
    pub(crate) fn fit(&self, targets: usize, noise: &mut Noise) -> f64 {
        let mut most = 0.0f64;
        for source in fitted(targets) {
            let windows = &self.sums[source.index()];
            let mut whole = Sum::default();
            windows.iter().for_each(|sum| whole.add(sum, 1.0));
            if whole.due < FEWEST {
                continue;
            }
            let (least, largest) = limits(source);
            let before = noise.of(source);
            let ratio = whole.absolute / whole.due / before;
            let after = (before * ratio.clamp(1.0 / AT_ONCE, AT_ONCE)).clamp(least, largest);
            most = most.max((after / before).ln().abs());
            noise.set(source, after);
            if source.is_local() {
                let local = |window| in_window(windows, window, after).clamp(least, largest);
                noise.set_local(source, &(0..windows.len()).map(local).collect::<Vec<_>>());
            }
        }
        most
    }
}

/// The motion factor in a window: from the blocks in and about it, with a small weight of the whole flight.
fn in_window(windows: &[Sum], window: usize, whole: f64) -> f64 {
    let mut sum = Sum { due: OF_WHOLE, absolute: OF_WHOLE * whole, found: 0.0 };
    let near = window.saturating_sub(REACH)..(window + REACH + 1).min(windows.len());
    for other in near {
        let weight = 1.0 - other.abs_diff(window) as f64 / (REACH + 1) as f64;
        sum.add(&windows[other], weight);
    }
    sum.absolute / sum.due
}

/// The sources whose factors are fitted.
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
        S::Vibration,
        S::Shake,
        S::ShakeRoll,
    ];
    own.into_iter().chain(
        (0..targets)
            .flat_map(|t| [S::Marker(t), S::Drive(t), S::Turn(t), S::Sway(t), S::Heave(t), S::Slip(t)]),
    )
}

/// Limits of a factor; for measurements relative to the configured variance.
fn limits(source: Source) -> (f64, f64) {
    match source {
        Source::GpsPosition | Source::GpsVelocity => (0.25, 25.0),
        Source::Heading => (0.25, 36.0),
        Source::Tilt => (0.25, 400.0),
        // Vibration under a rolling shutter makes pixels of tenths.
        Source::Marker(_) | Source::Feature => (0.01, 400.0),
        // Forces change within a step.
        Source::Vibration => (1e-5, 1.0),
        // Over the configured one: of a vehicle that rolls nothing is given away.
        Source::Slip(_) => (1.0, 1e4),
        // A hundredth of a pixel of a wide lens to ten of a long one, rad².
        Source::Shake | Source::ShakeRoll => (1e-11, 1e-4),
        // Displacements of a tenth of a millimetre to half a metre.
        Source::Sway(_) | Source::Heave(_) => (1e-8, 0.25),
        _ => MOTION,
    }
}

/// Initial displacement of the markers of a target that sways, m.
const SWAY_M: f64 = 0.01;

/// Least initial displacement of a frame whose camera shakes, rad.
const SHAKE_RAD: f64 = 2e-4;

/// Initial factors: intensities of jerk and its changes, variances of gusts and of the excess thrust.
pub(crate) fn first(targets: usize, gust_mps2: f64, thrust_mps2: f64, shake: Option<[f64; 2]>) -> Noise {
    let mut noise = Noise::new(targets);
    noise.set(Source::TiltMotion, 3.0);
    noise.set(Source::YawMotion, 0.5);
    noise.set(Source::Gust, gust_mps2.powi(2));
    noise.set(Source::Thrust, thrust_mps2.powi(2));
    noise.set(Source::Vibration, 0.02f64.powi(2));
    for (source, sigma) in [Source::Shake, Source::ShakeRoll].into_iter().zip(shake.unwrap_or([SHAKE_RAD; 2]))
    {
        noise.set(source, sigma.max(SHAKE_RAD).powi(2));
    }
    for target in 0..targets {
        noise.set(Source::Drive(target), 6.0);
        noise.set(Source::Turn(target), 2.0);
        [Source::Sway(target), Source::Heave(target)].iter().for_each(|s| noise.set(*s, SWAY_M.powi(2)));
    }
    noise
}
