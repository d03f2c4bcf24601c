//! A few rows of the least-squares problem, whitened, and their noise factors.

use crate::dense::{cholesky, forward};

/// The source of rows.
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
    /// Roll and pitch motion of the helicopter.
    TiltMotion,
    /// Yaw motion of the helicopter.
    YawMotion,
    /// Gusts on the helicopter.
    Gust,
    /// Vertical force on the helicopter.
    Thrust,
    /// Motion of a target along its course.
    Drive(usize),
    /// Turning of a target.
    Turn(usize),
    /// Roll and pitch of a target's body on its springs.
    Sway(usize),
    /// Heave of a target's body on its springs.
    Heave(usize),
    /// Side slip of a target.
    Slip(usize),
    /// External positions.
    Outside,
    /// Changes of the helicopter's velocity that are faster than a gust.
    Vibration,
    /// Displacements of the rows of a frame whose camera shakes.
    Shake,
    /// Roll of a frame about the optical axis, likewise.
    ShakeRoll,
    /// Rows with noise that is not fitted.
    Known,
}

impl Source {
    /// Whether it is a measurement, which may be an outlier.
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

    /// Whether it is motion whose intensity changes with time: starting and turning in differ from standing still.
    pub(crate) const fn is_local(self) -> bool {
        matches!(self, Self::TiltMotion | Self::YawMotion | Self::Drive(_) | Self::Turn(_) | Self::Slip(_))
    }

    /// The index of its factor.
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
            Self::Shake => 12,
            Self::ShakeRoll => 13,
            Self::Marker(target) => 14 + 6 * target,
            Self::Drive(target) => 15 + 6 * target,
            Self::Turn(target) => 16 + 6 * target,
            Self::Sway(target) => 17 + 6 * target,
            Self::Heave(target) => 18 + 6 * target,
            Self::Slip(target) => 19 + 6 * target,
        }
    }

    /// Number of sources with this many targets.
    pub(crate) const fn count(targets: usize) -> usize {
        14 + 6 * targets
    }
}

/// Rows `J x ≈ r` with noise of unit variance.
#[derive(Clone, Debug, Default)]
pub(crate) struct Block {
    pub(crate) columns: Vec<usize>,
    /// One value for each column, row after row.
    pub(crate) rows: Vec<f64>,
    pub(crate) right: Vec<f64>,
}

impl Block {
    /// Clears it for this number of rows.
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

    /// Multiplies by `L⁻¹` of the rows' covariance `L Lᵀ`, given row by row; `false` where it is not positive definite.
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

    /// Sum of the squared residuals.
    pub(crate) fn square(&self) -> f64 {
        self.right.iter().map(|r| r * r).sum()
    }
}

/// Variances, or intensities, by source: factors on the configured noise of measurements, values for motion.
#[derive(Clone, Debug)]
pub(crate) struct Noise {
    figures: Vec<f64>,
    /// By source, factors in each window of time: none where it is constant.
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

    /// The factor in a window of time.
    pub(crate) fn at(&self, source: Source, window: usize) -> f64 {
        self.of(source) * self.local[source.index()].get(window).unwrap_or(&1.0)
    }

    /// Sets a source's factors in the windows of time, in order.
    pub(crate) fn set_local(&mut self, source: Source, figures: &[f64]) {
        let whole = self.of(source);
        self.local[source.index()] = figures.iter().map(|figure| figure / whole).collect();
    }

    /// The same with the variances of some sources multiplied by a factor.
    pub(crate) fn scaled(&self, sources: &[Source], by: f64) -> Self {
        let mut scaled = self.clone();
        sources.iter().for_each(|source| scaled.figures[source.index()] *= by);
        scaled
    }

    pub(crate) fn set(&mut self, source: Source, value: f64) {
        self.figures[source.index()] = value;
    }
}

/// Robust loss: how large a block's square may be by its noise. Beyond the gate its weight falls as `gate/s²`, and its
/// loss grows as `gate (1 + ln(s²/gate))`, so that a gross error has little effect.
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
