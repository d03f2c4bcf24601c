//! What a refined flight tells.

use windhover_base::msg::{FeltTilt, MarkerId, Ownship, TargetEstimate};
use windhover_base::time::MonoTime;

use crate::block::Source;
use crate::unknowns::ConstantKind;

/// A constant of the flight, with what was known of it before.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Constant {
    /// Which.
    pub kind: ConstantKind,
    /// Its value: rad, m, s, 1/s, a share.
    pub value: f64,
    /// One sigma, of the flight and what was known before together.
    pub sigma: f64,
    /// What was expected.
    pub prior: f64,
    /// One sigma of that; zero where it is not estimated.
    pub prior_sigma: f64,
}

/// A flight tells a constant where it makes its sigma smaller than this share of what it was.
const TOLD: f64 = 0.8;

/// What differs by less than this share of what was expected to be wrong is no reason to change a configuration.
const MATTERS: f64 = 0.5;

impl Constant {
    /// Whether the flight tells it; else it stays about where it was expected.
    pub fn is_told(&self) -> bool {
        self.prior_sigma > 0.0 && self.sigma < TOLD * self.prior_sigma
    }

    /// Whether the flight tells it to be other than expected, beyond three sigmas and by what matters.
    pub fn is_settled(&self) -> bool {
        let off = (self.value - self.prior).abs();
        self.is_told() && off > 3.0 * self.sigma && off > MATTERS * self.prior_sigma
    }
}

/// A measurement that nothing explains.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Outlier {
    /// Index of the recording.
    pub flight: usize,
    /// Time of the knot it belongs to.
    pub t: MonoTime,
    /// What it is of.
    pub source: Source,
    /// Which marker.
    pub marker: Option<MarkerId>,
    /// Its normalised square over the gate.
    pub ratio: f64,
}

/// How many measurements of a source there were, and how many of them nothing explains.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Tally {
    /// The source.
    pub source: Source,
    /// Measurements.
    pub taken: usize,
    /// Outliers among them.
    pub outliers: usize,
    /// The figure on the source's noise, or of its motion.
    pub figure: f64,
}

/// A refined flight, or several.
#[derive(Clone, Debug, Default)]
pub struct Refined {
    /// The helicopter at every knot, with the index of its recording.
    pub own: Vec<(usize, Ownship)>,
    /// The targets at every frame, likewise.
    pub targets: Vec<(usize, TargetEstimate)>,
    /// Constants of the flight.
    pub constants: Vec<Constant>,
    /// What the tilt sensor was taken to feel.
    pub felt: Option<FeltTilt>,
    /// What nothing explains, the worst first.
    pub outliers: Vec<Outlier>,
    /// By source.
    pub tallies: Vec<Tally>,
    /// Ground features that were used, and that were not since they move.
    pub features: (usize, usize),
    /// Times at which a trajectory begins anew behind a silence, with the index of the recording.
    pub begins: Vec<(usize, MonoTime)>,
    /// Times at which the filter that gave first values began again, and why.
    pub resets: Vec<(MonoTime, String)>,
}
