//! A few rows of the least-squares problem, whitened, and the figures on their noise.

use crate::front::{cholesky, forward};

/// What rows are of.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Source {
    /// Positions of the receiver.
    GpsPosition,
    /// Velocities of the receiver.
    GpsVelocity,
    /// Headings of the compass.
    Heading,
    /// Tilt readings.
    Tilt,
    /// Markers of a target.
    Marker(usize),
    /// Ground features.
    Feature,
    /// Roll and pitch of the helicopter as it moves by itself.
    TiltMotion,
    /// Its turning.
    YawMotion,
    /// Its gusts.
    Gust,
    /// Its climbing.
    Thrust,
    /// How a target drives.
    Drive(usize),
    /// How a target turns.
    Turn(usize),
    /// Positions from outside.
    Outside,
    /// What is finer than a gust in the helicopter's velocity.
    Vibration,
    /// What has figures that are not fitted.
    Known,
}

impl Source {
    /// Whether it is a measurement, which may be wrong.
    pub(crate) const fn is_measured(self) -> bool {
        matches!(
            self,
            Self::GpsPosition
                | Self::GpsVelocity
                | Self::Heading
                | Self::Tilt
                | Self::Marker(_)
                | Self::Feature
                | Self::Outside
        )
    }

    /// Whether it is motion whose figure changes with time: driving on and turning in are other things than standing still.
    pub(crate) const fn is_local(self) -> bool {
        matches!(self, Self::TiltMotion | Self::YawMotion | Self::Drive(_) | Self::Turn(_))
    }

    /// Where its figure stands.
    pub(crate) const fn index(self) -> usize {
        match self {
            Self::GpsPosition => 0,
            Self::GpsVelocity => 1,
            Self::Heading => 2,
            Self::Tilt => 3,
            Self::Feature => 4,
            Self::TiltMotion => 5,
            Self::YawMotion => 6,
            Self::Gust => 7,
            Self::Thrust => 8,
            Self::Known => 9,
            Self::Vibration => 10,
            Self::Outside => 11,
            Self::Marker(target) => 12 + 3 * target,
            Self::Drive(target) => 13 + 3 * target,
            Self::Turn(target) => 14 + 3 * target,
        }
    }

    /// How many there are with so many targets.
    pub(crate) const fn count(targets: usize) -> usize {
        12 + 3 * targets
    }
}

/// Rows `J x ≈ r` with noise of unit variance.
#[derive(Clone, Debug, Default)]
pub(crate) struct Block {
    pub(crate) columns: Vec<usize>,
    /// A figure a column, one row behind the other.
    pub(crate) rows: Vec<f64>,
    pub(crate) right: Vec<f64>,
}

impl Block {
    /// Empties it for so many rows.
    pub(crate) fn begin(&mut self, rows: usize) {
        self.columns.clear();
        self.rows.clear();
        self.right.clear();
        self.right.resize(rows, 0.0);
    }

    /// Number of rows.
    pub(crate) fn len(&self) -> usize {
        self.right.len()
    }

    /// Names the columns; all entries are zero then.
    pub(crate) fn over(&mut self, columns: impl IntoIterator<Item = usize>) {
        self.columns.extend(columns);
        self.rows.resize(self.columns.len() * self.len(), 0.0);
    }

    /// An entry, by the place of its column.
    pub(crate) fn at(&mut self, row: usize, place: usize) -> &mut f64 {
        &mut self.rows[row * self.columns.len() + place]
    }

    /// Multiplies by `L⁻¹` of the rows' covariance `L Lᵀ`, given row by row; `false` where it is none.
    pub(crate) fn whiten(&mut self, covariance: &mut [f64]) -> bool {
        let n = self.len();
        if cholesky(covariance, n).is_err() {
            return false;
        }
        let width = self.columns.len();
        forward(covariance, n, &mut self.rows, width);
        forward(covariance, n, &mut self.right, 1);
        true
    }

    /// Sum of the squares of what is left over.
    pub(crate) fn square(&self) -> f64 {
        self.right.iter().map(|r| r * r).sum()
    }
}

/// Variances, or intensities, by source: factors on what is configured of measurements, figures of motion.
#[derive(Clone, Debug)]
pub(crate) struct Noise {
    figures: Vec<f64>,
    /// By source, factors on its figure in each window of time: none where it is the same at all times.
    local: Vec<Vec<f64>>,
}

impl Noise {
    pub(crate) fn new(targets: usize) -> Self {
        let n = Source::count(targets);
        Self { figures: vec![1.0; n], local: vec![Vec::new(); n] }
    }

    pub(crate) fn of(&self, source: Source) -> f64 {
        self.figures[source.index()]
    }

    /// The figure in a window of time.
    pub(crate) fn at(&self, source: Source, window: usize) -> f64 {
        self.of(source) * self.local[source.index()].get(window).unwrap_or(&1.0)
    }

    /// Puts a source's figures in the windows of time, one behind the other.
    pub(crate) fn set_local(&mut self, source: Source, figures: &[f64]) {
        let whole = self.of(source);
        self.local[source.index()] = figures.iter().map(|figure| figure / whole).collect();
    }

    pub(crate) fn set(&mut self, source: Source, value: f64) {
        self.figures[source.index()] = value;
    }
}

/// How far a block's square may be from what noise makes of it: beyond, its weight falls as `gate/s²`, and its loss grows as
/// `gate (1 + ln(s²/gate))`: what is grossly wrong hardly pulls.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Loss {
    pub(crate) weight: f64,
    pub(crate) cost: f64,
}

impl Loss {
    pub(crate) fn of(square: f64, gate: f64) -> Self {
        if square <= gate {
            return Self { weight: 1.0, cost: square };
        }
        let ratio = square / gate;
        Self { weight: 1.0 / ratio, cost: gate * (1.0 + ratio.ln()) }
    }
}
