//! Time scales kept apart by type: host time, spans of it, and UTC.
//!
//! Host time ([`MonoTime`]) is what every stamp in the program uses: CLOCK_MONOTONIC plus one
//! constant fixed when recording starts, so it never steps and stays close to UTC. UTC
//! ([`UtcTime`]) comes only from the receiver and never enters arithmetic with host time except
//! through the fit between them.

mod fit;
#[cfg(test)]
mod fit_tests;
mod frames;
mod jitter;
mod pulse;
mod remote;
mod steady;
mod utc;

pub use fit::{ClockFit, GnssClock};
pub use frames::FrameClock;
pub use pulse::PulseTrouble;
pub use remote::RemoteClock;
pub use steady::SteadyClock;
pub use utc::{Civil, EARLIEST_UTC, UtcTime, days_in_month};

use std::fmt;
use std::ops::{Add, AddAssign, Neg, Sub, SubAssign};

/// Nanoseconds in a second.
pub const NS_PER_S: i64 = 1_000_000_000;

/// A point in host time, in nanoseconds: CLOCK_MONOTONIC plus the recording's constant.
///
/// ```
/// use windhover_base::time::{MonoTime, Span};
///
/// let t = MonoTime::from_ns(1_000_000_000);
/// assert_eq!(t + Span::from_ms(20.0), MonoTime::from_ns(1_020_000_000));
/// assert_eq!(MonoTime::from_ns(3_000_000_000) - t, Span::from_s(2.0));
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct MonoTime(i64);

/// A signed length of host time, in nanoseconds.
///
/// ```
/// use windhover_base::time::Span;
///
/// assert_eq!((Span::from_s(1.5).ms(), Span::from_ms(-2.0).abs().ns()), (1_500.0, 2_000_000));
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Span(i64);

impl MonoTime {
    /// The instant `ns` nanoseconds after the scale's zero.
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// A time `ns` nanoseconds after the scale's zero, as an unsigned number, as in MCAP files and from the kernel; a
    /// value that does not fit becomes the last time.
    pub fn from_unsigned_ns(ns: impl TryInto<i64>) -> Self {
        Self(ns.try_into().unwrap_or(i64::MAX))
    }

    /// Nanoseconds since the scale's zero.
    pub const fn ns(self) -> i64 {
        self.0
    }
}

impl Span {
    /// The span of length zero.
    pub const ZERO: Self = Self(0);

    /// A span of `ns` nanoseconds.
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// A span of `ms` milliseconds, rounded to a nanosecond; NaN gives zero.
    pub fn from_ms(ms: f64) -> Self {
        Self((ms * 1e6).round() as i64)
    }

    /// A span of `s` seconds, rounded to a nanosecond; NaN gives zero.
    pub fn from_s(s: f64) -> Self {
        Self((s * 1e9).round() as i64)
    }

    /// Nanoseconds.
    pub const fn ns(self) -> i64 {
        self.0
    }

    /// Milliseconds.
    pub fn ms(self) -> f64 {
        self.0 as f64 * 1e-6
    }

    /// Seconds.
    pub fn s(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// The same length without its sign.
    pub const fn abs(self) -> Self {
        Self(self.0.saturating_abs())
    }
}

impl Sub for MonoTime {
    type Output = Span;
    fn sub(self, earlier: Self) -> Span {
        Span(self.0.saturating_sub(earlier.0))
    }
}

impl Add<Span> for MonoTime {
    type Output = Self;
    fn add(self, span: Span) -> Self {
        Self(self.0.saturating_add(span.0))
    }
}

impl Sub<Span> for MonoTime {
    type Output = Self;
    fn sub(self, span: Span) -> Self {
        Self(self.0.saturating_sub(span.0))
    }
}

impl AddAssign<Span> for MonoTime {
    fn add_assign(&mut self, span: Span) {
        *self = *self + span;
    }
}

impl SubAssign<Span> for MonoTime {
    fn sub_assign(&mut self, span: Span) {
        *self = *self - span;
    }
}

impl Add for Span {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }
}

impl Sub for Span {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0.saturating_sub(other.0))
    }
}

impl Neg for Span {
    type Output = Self;
    fn neg(self) -> Self {
        Self(self.0.saturating_neg())
    }
}

impl fmt::Debug for MonoTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:09}", self.0.div_euclid(NS_PER_S), self.0.rem_euclid(NS_PER_S))
    }
}

impl fmt::Debug for Span {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ms", self.ms())
    }
}
