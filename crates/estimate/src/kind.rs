//! What a tilt sensor measures, decided by one statistic outside the filter: the slope of acceleration over what the
//! reading means.
//!
//! Were the reading z the tilt, the helicopter would accelerate by `u = Rz(ψ) (−g_z z₁, g_z z₂)`, `g_z = g/√(1 − |z|²)`,
//! give or take the wind. Over windows of a second the receiver tells the mean acceleration a; differences of windows in
//! a row, y = Δa and x = Δu, are free of wind, trim and slow errors. Their slope β = Σxy/Σx² is about one where attitude is
//! read (less in gusts, which tilt answers), below zero where specific force is felt (tilt hardly shows, and
//! acceleration shows reversed), and 1/k where a share k of the tilt is read. Three profile likelihoods with priors by what
//! is configured decide; the filter's own innovations could not (a scale of tilt that is wrong is taken up by the gusts).
//! The sums are part of the state, so that a late measurement makes them anew in its place.

use nalgebra::{Rotation3, Vector2, Vector3};

use windhover_base::geo::{ned_from_body_321, tilt_from_down};
use windhover_base::msg::FeltTilt;
use windhover_base::settings::TiltKind;
use windhover_base::time::MonoTime;

use super::own::GRAVITY;

/// What the filter takes the sensor to feel.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) enum Felt {
    /// Not known: taken as attitude with an error wide enough for any.
    #[default]
    Undecided,
    /// Attitude.
    Attitude,
    /// Specific force.
    Force,
    /// A share of the tilt.
    Share,
}

/// The kinds that can be decided, in the order of the likelihoods.
const KINDS: [Felt; 3] = [Felt::Attitude, Felt::Force, Felt::Share];

/// What a kind expects: slopes, and the largest scatter of acceleration about them, m/s².
const EXPECTED: [((f64, f64), f64); 3] = [
    // Gusts that are answered by tilt lower the slope; what is left over is gusts.
    ((0.15, 1.15), 0.4),
    // Tilt is not shown at all: any acceleration is possible.
    ((-1.15, 0.1), 3.0),
    // A share of 0.07 to 0.4.
    ((2.5, 14.0), 0.4),
];
/// Least scatter that is assumed, m/s².
const LEAST_SCATTER: f64 = 0.12;
/// Length of a window, s, and where it is too long or has too few readings.
const WINDOW_S: f64 = 0.99;
const LONGEST_S: f64 = 1.7;
const LEAST_FILLED: f64 = 0.8;
/// A reading is used for at most this long, s.
const LONGEST_READING_S: f64 = 0.2;
/// An acceleration beyond this is a wrong velocity, m/s².
const WILDEST_MPS2: f64 = 15.0;
/// Differences that the sums remember.
const MEMORY: f64 = 300.0;
/// Conditions of a decision: lead over the next hypothesis, nats; number of differences; number of windows in a row.
const LEAD: f64 = 2.0;
const FEWEST: f64 = 10.0;
const IN_A_ROW: u32 = 3;
/// Shares that a sensor may read.
const SHARES: (f64, f64) = (0.05, 0.4);
/// Error of a share: so much of it at the least.
const SHARE_ERROR: f64 = 0.15;

/// Slow errors of a reading, one sigma, rad, with their correlation times, s.
const AHRS_ERROR: (f64, f64) = (1.5 * DEGREE, 30.0);
const FORCE_ERROR: (f64, f64) = (0.3 * DEGREE, 20.0);
const SHARE_READING_ERROR: (f64, f64) = (0.15 * DEGREE, 20.0);
const UNDECIDED_TAU_S: f64 = 8.0;
/// Largest error of a reading whose meaning is not known, rad.
const UNDECIDED_MOST: f64 = 7.0 * DEGREE;
/// Likewise for an AHRS that was configured as another kind of sensor.
const MISNAMED: f64 = 2.0;
/// A sensor that reads 15 % errs by 5.7 times its reading.
const UNREAD: f64 = 5.7;
/// Accelerations taken as usual until windows show them, one sigma over both axes, m/s², and over how many windows
/// they are remembered.
const USUAL_MPS2: f64 = 0.5;
const NOISE_MPS2: f64 = 0.3;
const ADAPTED_OVER: f64 = 30.0;
const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// A window being filled: when and at which velocity it began, and the accelerations that the readings have implied
/// since.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Window {
    since: MonoTime,
    velocity: Vector2<f64>,
    meant: Vector2<f64>,
    filled_s: f64,
}

/// Sums over differences of windows; each counts half, since two share a window.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
struct Sums {
    xx: f64,
    xy: f64,
    yy: f64,
    n: f64,
}

/// Everything that is known of what the sensor feels.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct TiltWatch {
    configured: TiltKind,
    pub(crate) felt: Felt,
    /// Share of the tilt that is read, and its error; one and zero except for [`Felt::Share`].
    pub(crate) share: f64,
    pub(crate) share_sigma: f64,
    /// When this was decided; `None` while it is what was configured.
    pub(crate) decided: Option<MonoTime>,
    /// The last reading: when, and down in the body frame as read.
    last: Option<(MonoTime, Vector3<f64>)>,
    window: Option<Window>,
    /// Means of the last whole window: acceleration, and the acceleration that the readings implied.
    before: Option<(Vector2<f64>, Vector2<f64>)>,
    sums: Sums,
    /// The kind that led in the last windows, and in how many in a row.
    leading: Option<(usize, u32)>,
    /// Mean squares over both axes of acceleration and of the acceleration that the readings implied, with the number
    /// of windows.
    squares: (f64, f64),
    windows: f64,
}

impl TiltWatch {
    /// As configured, before any reading.
    pub(crate) fn new(configured: TiltKind) -> Self {
        let felt = if configured == TiltKind::Inertial { Felt::Attitude } else { Felt::Undecided };
        Self { configured, felt, share: 1.0, ..Self::default() }
    }

    /// A sensor that is known to read this share of the tilt.
    pub(crate) fn known(share: f64) -> Self {
        let felt = if share == 1.0 { Felt::Attitude } else { Felt::Share };
        Self { felt, share, ..Self::new(TiltKind::Auto) }
    }

    /// What it is found to feel, for who reads it.
    pub(crate) fn found(&self) -> Option<FeltTilt> {
        match self.felt {
            Felt::Undecided => None,
            Felt::Attitude => Some(FeltTilt::Attitude),
            Felt::Force => Some(FeltTilt::Force),
            Felt::Share => Some(FeltTilt::Share(self.share)),
        }
    }

    /// Whether what was decided is something else than configured.
    pub(crate) fn is_misnamed(&self) -> bool {
        match self.configured {
            TiltKind::Auto => false,
            TiltKind::Inertial => matches!(self.felt, Felt::Force | Felt::Share),
            TiltKind::Gravity => self.felt == Felt::Attitude,
        }
    }

    /// Slope of acceleration over what the reading means.
    pub(crate) fn slope(&self) -> f64 {
        self.sums.xy / self.sums.xx.max(1e-12)
    }

    /// Variance and correlation time of the reading's slow error, rad² and s.
    pub(crate) fn reading_error(&self) -> (f64, f64) {
        let (sigma, tau_s) = match self.felt {
            Felt::Undecided => (self.undecided_sigma(), UNDECIDED_TAU_S),
            Felt::Attitude if self.is_misnamed() => (MISNAMED * AHRS_ERROR.0, AHRS_ERROR.1),
            Felt::Attitude => AHRS_ERROR,
            Felt::Force => FORCE_ERROR,
            Felt::Share => SHARE_READING_ERROR,
        };
        (sigma * sigma, tau_s)
    }

    /// What a reading of unknown meaning may be off by: an AHRS by its own error, one that feels force by the
    /// acceleration, one that reads 15 % by nearly six times the reading.
    fn undecided_sigma(&self) -> f64 {
        let (moved, meant) =
            if self.windows > 0.0 { self.squares } else { (2.0 * USUAL_MPS2.powi(2), self.squares.1) };
        let an_axis = |square: f64| 0.5 * square / GRAVITY.powi(2);
        let noise = if self.windows > 0.0 { NOISE_MPS2.powi(2) } else { 0.0 };
        let var = AHRS_ERROR.0.powi(2) + an_axis(moved + noise) + an_axis(UNREAD.powi(2) * meant);
        var.sqrt().clamp(AHRS_ERROR.0, UNDECIDED_MOST)
    }

    /// Takes a reading: true heading and down in the body frame as read.
    pub(crate) fn reading(&mut self, t: MonoTime, heading: f64, down: &Vector3<f64>) {
        let meant = accelerates(heading, down);
        if !meant.iter().all(|x| x.is_finite()) {
            return;
        }
        let stood_s = self.last.map_or(0.0, |(before, _)| (t - before).s().clamp(0.0, LONGEST_READING_S));
        self.last = Some((t, *down));
        if let Some(window) = &mut self.window {
            window.meant += meant * stood_s;
            window.filled_s += stood_s;
        } else {
            self.squares.1 = meant.norm_squared();
        }
    }

    /// Takes the receiver's horizontal velocity; whether another meaning is decided by it.
    pub(crate) fn velocity(&mut self, t: MonoTime, velocity: Vector2<f64>) -> bool {
        let next = Window { since: t, velocity, meant: Vector2::zeros(), filled_s: 0.0 };
        let Some(window) = self.window.filter(|w| t >= w.since) else {
            self.window = Some(next);
            return false;
        };
        let length_s = (t - window.since).s();
        if length_s < WINDOW_S {
            return false;
        }
        self.window = Some(next);
        if length_s > LONGEST_S || window.filled_s < LEAST_FILLED * length_s {
            self.before = None;
            return false;
        }
        let moved = (velocity - window.velocity) / length_s;
        if !(moved.norm() < WILDEST_MPS2) {
            self.before = None;
            return false;
        }
        let meant = window.meant / window.filled_s;
        self.adapt(&moved, &meant);
        let Some((moved_before, meant_before)) = self.before.replace((moved, meant)) else { return false };
        self.sums.take(&(meant - meant_before), &(moved - moved_before));
        self.decide(t)
    }

    fn adapt(&mut self, moved: &Vector2<f64>, meant: &Vector2<f64>) {
        self.windows = (self.windows + 1.0).min(ADAPTED_OVER);
        let gain = 1.0 / self.windows;
        self.squares.0 += gain * (moved.norm_squared() - self.squares.0);
        self.squares.1 += gain * (meant.norm_squared() - self.squares.1);
    }

    fn decide(&mut self, t: MonoTime) -> bool {
        let scores = self.sums.likelihoods();
        let scores: [f64; 3] = std::array::from_fn(|i| scores[i] + prior(self.configured)[i].ln());
        let best = (0..3).max_by(|a, b| scores[*a].total_cmp(&scores[*b])).unwrap_or(0);
        let next = (0..3).filter(|i| *i != best).map(|i| scores[i]).fold(f64::NEG_INFINITY, f64::max);
        let leads = scores[best] - next > LEAD && self.sums.n >= FEWEST;
        let so_far = self.leading.filter(|(kind, _)| *kind == best).map_or(0, |(_, n)| n);
        self.leading = leads.then_some((best, so_far + 1));
        if so_far + 1 < IN_A_ROW || !leads || KINDS[best] == self.felt {
            return false;
        }
        self.felt = KINDS[best];
        self.decided = Some(t);
        (self.share, self.share_sigma) = (1.0, 0.0);
        if self.felt == Felt::Share {
            let share = (self.sums.xx / self.sums.xy).clamp(SHARES.0, SHARES.1);
            self.share = share;
            self.share_sigma = f64::max(SHARE_ERROR * share, self.sums.slope_error() * share * share);
        }
        true
    }

    /// The attitude that a reading means, with a heading.
    pub(crate) fn attitude(&self, heading: f64, down: &Vector3<f64>) -> Rotation3<f64> {
        let (pitch, roll) = match self.felt {
            Felt::Undecided | Felt::Attitude => tilt_from_down(down),
            // In calm air it shows nothing, hanging in the wind all of it.
            Felt::Force => {
                let (pitch, roll) = tilt_from_down(down);
                (0.5 * pitch, 0.5 * roll)
            }
            Felt::Share => {
                let read = |d: f64| (d / self.share).clamp(-STEEPEST, STEEPEST);
                let across = Vector2::new(read(down.x), read(down.y));
                let across = across * (STEEPEST / across.norm().max(STEEPEST));
                tilt_from_down(&Vector3::new(across.x, across.y, (1.0 - across.norm_squared()).sqrt()))
            }
        };
        ned_from_body_321(heading, pitch, roll)
    }

    /// Variance of tilt where it was just read off the sensor, rad². The reading is also fused.
    pub(crate) fn tilt_var(&self) -> f64 {
        if self.felt == Felt::Force { HALF_READ_TILT.powi(2) } else { UNKNOWN_TILT.powi(2) }
    }

    /// The last reading's down in the body frame.
    pub(crate) fn last_down(&self) -> Option<Vector3<f64>> {
        self.last.map(|(_, down)| down)
    }
}

/// Tilt that only a reading shows, one sigma, rad: whatever a helicopter flies with.
const UNKNOWN_TILT: f64 = 0.35;
/// The same where half of a reading is taken for it: a sensor of the specific force shows none of it or all.
const HALF_READ_TILT: f64 = 0.15;
/// Sine of the steepest tilt that is read off a share.
const STEEPEST: f64 = 0.6;

/// The horizontal acceleration, NED, m/s², of a helicopter that is tilted as a reading indicates.
fn accelerates(heading: f64, down: &Vector3<f64>) -> Vector2<f64> {
    let upright = (1.0 - down.x * down.x - down.y * down.y).max(0.2).sqrt();
    let (s, c) = heading.sin_cos();
    let along = down.xy() * (GRAVITY / upright);
    Vector2::new(c * along.x - s * along.y, s * along.x + c * along.y)
}

/// Probabilities of the kinds before anything was measured.
fn prior(configured: TiltKind) -> [f64; 3] {
    match configured {
        TiltKind::Auto => [0.6, 0.2, 0.2],
        TiltKind::Inertial => [0.7, 0.15, 0.15],
        TiltKind::Gravity => [0.2, 0.4, 0.4],
    }
}

impl Sums {
    fn take(&mut self, x: &Vector2<f64>, y: &Vector2<f64>) {
        let kept = (-1.0 / MEMORY).exp();
        self.xx = kept * self.xx + 0.5 * x.norm_squared();
        self.xy = kept * self.xy + 0.5 * x.dot(y);
        self.yy = kept * self.yy + 0.5 * y.norm_squared();
        self.n = kept * self.n + 1.0;
    }

    fn left_over(&self, slope: f64) -> f64 {
        (self.yy - 2.0 * slope * self.xy + slope * slope * self.xx).max(0.0)
    }

    /// Profile log-likelihoods of the kinds: slope and scatter at their best within what the kind expects.
    fn likelihoods(&self) -> [f64; 3] {
        let slope = self.xy / self.xx.max(1e-12);
        EXPECTED.map(|((least, most), scatter)| {
            let left = self.left_over(slope.clamp(least, most));
            let var = (left / self.n.max(1.0)).clamp(LEAST_SCATTER.powi(2), scatter * scatter);
            -0.5 * self.n * var.ln() - 0.5 * left / var
        })
    }

    fn slope_error(&self) -> f64 {
        let slope = self.xy / self.xx.max(1e-12);
        (self.left_over(slope) / self.n.max(1.0) / self.xx.max(1e-12)).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use windhover_base::time::Span;

    use super::*;

    /// What a sensor makes of a flight.
    type Sensor = fn(tilt: Vector2<f64>, acceleration: Vector2<f64>) -> Vector2<f64>;

    /// A minute of a helicopter that weaves in gusts, with heading 30°: what is decided, and when.
    fn flown(configured: TiltKind, sensor: Sensor) -> (TiltWatch, Option<f64>) {
        let mut watch = TiltWatch::new(configured);
        let (mut velocity, mut decided_s) = (Vector2::zeros(), None);
        let begin = MonoTime::from_ns(5_000_000_000);
        for k in 0..3000 {
            let t_s = 0.02 * f64::from(k);
            let t = begin + Span::from_s(t_s);
            // Tilt in the level frame of the body, forward and right: what acceleration over g it means.
            let tilt = Vector2::new(0.15 * (0.9 * t_s).sin(), 0.1 * (1.3 * t_s).sin() + 0.05);
            let gust = Vector2::new(0.3 * (2.1 * t_s).cos(), 0.2 * (1.7 * t_s).sin());
            let (s, c) = 0.5f64.sin_cos();
            let pushed = tilt * GRAVITY + gust - Vector2::new(0.0, 0.5);
            velocity += Vector2::new(c * pushed.x - s * pushed.y, s * pushed.x + c * pushed.y) * 0.02;
            let read = sensor(tilt, pushed / GRAVITY);
            let down = Vector3::new(read.x, read.y, 1.0).normalize();
            watch.reading(t, 0.5, &down);
            if k % 10 == 0 && watch.velocity(t, velocity) {
                decided_s = decided_s.or(Some(t_s));
            }
        }
        (watch, decided_s)
    }

    const AHRS: Sensor = |tilt, _| tilt;
    const ACCELEROMETER: Sensor = |tilt, moved| tilt - moved;
    const FLUID: Sensor = |tilt, _| tilt * 0.15;

    #[test]
    fn each_kind_is_found_out_within_half_a_minute_whatever_is_configured() {
        for configured in [TiltKind::Auto, TiltKind::Inertial, TiltKind::Gravity] {
            for (sensor, felt) in [(AHRS, Felt::Attitude), (ACCELEROMETER, Felt::Force), (FLUID, Felt::Share)]
            {
                let (watch, decided_s) = flown(configured, sensor);
                assert_eq!(watch.felt, felt, "{configured:?}: {watch:?}");
                let as_configured = TiltWatch::new(configured).felt == felt;
                assert!(
                    as_configured || decided_s.is_some_and(|t| t < 30.0),
                    "{configured:?}: {decided_s:?}"
                );
                let wrong = match configured {
                    TiltKind::Auto => false,
                    TiltKind::Inertial => felt != Felt::Attitude,
                    TiltKind::Gravity => felt == Felt::Attitude,
                };
                assert_eq!(watch.is_misnamed(), wrong, "{configured:?}, {felt:?}");
            }
        }
    }

    #[test]
    fn the_share_that_is_read_is_found() {
        let (watch, _) = flown(TiltKind::Gravity, FLUID);
        assert!((watch.share - 0.15).abs() < 2.0 * watch.share_sigma, "{watch:?}");
    }

    #[test]
    fn the_error_of_a_reading_of_unknown_kind_covers_every_kind() {
        let (mut watch, _) = flown(TiltKind::Auto, FLUID);
        watch.felt = Felt::Undecided;
        // 15 % is read of tilts of some 7° rms an axis.
        let (var, _) = watch.reading_error();
        assert!((4.0..7.1).contains(&var.sqrt().to_degrees()), "{}", var.sqrt().to_degrees());
        let (var, _) = TiltWatch::new(TiltKind::Auto).reading_error();
        assert!((2.0..5.0).contains(&var.sqrt().to_degrees()), "{}", var.sqrt().to_degrees());
    }

    #[test]
    fn gaps_and_wild_velocities_are_left_out() {
        let mut watch = TiltWatch::new(TiltKind::Auto);
        for k in 0..100 {
            let t = MonoTime::from_ns(1_000_000_000) + Span::from_s(0.2 * f64::from(k));
            // Received once a second only, and a velocity that leaps.
            if k % 5 == 0 {
                watch.reading(t, 0.0, &Vector3::z());
            }
            watch.velocity(t, Vector2::new(if k > 50 { 100.0 } else { 0.0 }, 0.0));
        }
        assert_eq!(watch.sums.n, 0.0, "{watch:?}");
    }

    #[test]
    fn a_reading_is_turned_into_the_attitude_that_its_kind_means() {
        let mut watch = TiltWatch::new(TiltKind::Auto);
        let down = Vector3::new(-0.03, 0.0, 1.0).normalize();
        for (felt, share, pitch) in
            [(Felt::Attitude, 1.0, 0.03), (Felt::Force, 1.0, 0.015), (Felt::Share, 0.15, 0.2)]
        {
            (watch.felt, watch.share) = (felt, share);
            let d = watch.attitude(1.0, &down).inverse() * Vector3::z();
            assert!((d.x + pitch).abs() < 2e-3, "{felt:?}: {d:?}");
        }
    }
}
