//! Results of a refinement.

use windhover_base::msg::{FeltTilt, MarkerId, Ownship, TargetEstimate};
use windhover_base::time::MonoTime;

use crate::block::Source;
use crate::unknowns::ConstantKind;

/// A constant of the flight, with its prior.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Constant {
    /// Its kind.
    pub kind: ConstantKind,
    /// Its value: rad, m, s, 1/s, a share.
    pub value: f64,
    /// One sigma, from the flight and the prior together.
    pub sigma: f64,
    /// The expected value.
    pub prior: f64,
    /// One sigma of the expected value; zero where it is not estimated.
    pub prior_sigma: f64,
}

/// A flight determines a constant where it reduces its sigma below this share of the prior's.
const DETERMINED: f64 = 0.8;

/// A difference below this share of the prior's sigma is no reason to change a configuration.
const MATTERS: f64 = 0.5;

impl Constant {
    /// Whether the flight determines it; otherwise it stays near its expected value.
    pub fn is_determined(&self) -> bool {
        self.prior_sigma > 0.0 && self.sigma < DETERMINED * self.prior_sigma
    }

    /// Whether the flight determines it to differ from its expected value, by more than three sigmas and by a relevant
    /// amount.
    pub fn is_settled(&self) -> bool {
        let off = (self.value - self.prior).abs();
        self.is_determined() && off > 3.0 * self.sigma && off > MATTERS * self.prior_sigma
    }
}

/// By how much the camera's delay is larger than another one: known far better than each of them, since only configured
/// latencies say anything of absolute time.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ClockDifference {
    /// The other delay.
    pub other: ConstantKind,
    /// The difference, s.
    pub late_s: f64,
    /// One sigma, s.
    pub sigma_s: f64,
}

impl ClockDifference {
    /// Whether it is no difference of careful latencies: beyond three sigmas, and larger than exposure times and drivers have.
    pub fn is_settled(&self) -> bool {
        self.late_s.abs() > LEAST_LATE_S.max(3.0 * self.sigma_s)
    }
}

/// Less is not reported, s.
const LEAST_LATE_S: f64 = 0.01;

/// A measurement that does not fit.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Outlier {
    /// Index of the recording.
    pub flight: usize,
    /// Time of the knot it belongs to.
    pub t: MonoTime,
    /// Its source.
    pub source: Source,
    /// Its marker.
    pub marker: Option<MarkerId>,
    /// Its normalised square over the gate.
    pub ratio: f64,
}

/// Number of measurements of a source, and of its outliers.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Tally {
    /// The source.
    pub source: Source,
    /// Measurements.
    pub taken: usize,
    /// Outliers among them.
    pub outliers: usize,
    /// The factor on the source's noise, or of its motion.
    pub figure: f64,
}

/// A refined flight, or several.
#[derive(Clone, Debug, Default)]
pub struct Refined {
    /// The helicopter at every knot, with the index of its recording.
    pub own: Vec<(usize, Ownship)>,
    /// The targets at every frame, with the index of the recording.
    pub targets: Vec<(usize, TargetEstimate)>,
    /// Constants of the flight.
    pub constants: Vec<Constant>,
    /// By how much the camera's delay is larger than that of the compass and of the receiver.
    pub clocks: Vec<ClockDifference>,
    /// EliminatedKind the tilt sensor was assumed to measure.
    pub felt: Option<FeltTilt>,
    /// The outliers, the largest first.
    pub outliers: Vec<Outlier>,
    /// By source.
    pub tallies: Vec<Tally>,
    /// Ground features that were used, and those that were dropped because they move.
    pub features: (usize, usize),
    /// Times at which a trajectory begins again after a silence, with the index of the recording.
    pub begins: Vec<(usize, MonoTime)>,
    /// Times at which the filter of the initial values was reset, and why.
    pub resets: Vec<(MonoTime, String)>,
}
