//! An autopilot that follows: it receives a vehicle's position and motion, and returns the acceleration that it wants.
//!
//! Standard control: received stamps are mapped to its own clock by the least observed delay, the state is extrapolated
//! to the present, a position error demands a velocity, a velocity error an acceleration; speed, acceleration and jerk
//! are limited, and after three seconds without a message it stops.

use nalgebra::Vector3;

use windhover_base::time::{MonoTime, Span};

/// A received state of a vehicle, in the follower's own position frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FollowTarget {
    /// The sender's stamp, on its own clock.
    pub stamp: Span,
    /// North, east, down, metres.
    pub position_m: Vector3<f64>,
    /// Velocity, m/s.
    pub velocity_mps: Vector3<f64>,
    /// Acceleration, m/s².
    pub acceleration_mps2: Vector3<f64>,
}

/// Gains and limits.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FollowerTuning {
    /// Demanded velocity for a position error, 1/s.
    pub position_gain: f64,
    /// Demanded acceleration for a velocity error, 1/s.
    pub velocity_gain: f64,
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// Largest horizontal acceleration, m/s².
    pub acceleration_mps2: f64,
    /// Largest change of it, m/s³.
    pub jerk_mps3: f64,
    /// It stops after this time without a message.
    pub timeout: Span,
    /// Height above the target, metres.
    pub height_m: f64,
}

impl Default for FollowerTuning {
    fn default() -> Self {
        Self {
            position_gain: 0.8,
            velocity_gain: 1.8,
            speed_mps: 12.0,
            acceleration_mps2: 4.0,
            jerk_mps3: 8.0,
            timeout: Span::from_ns(3_000_000_000),
            height_m: 12.0,
        }
    }
}

/// The follower.
///
/// ```
/// use nalgebra::Vector3;
/// use windhover_base::time::{MonoTime, Span};
/// use windhover_simulate::{FollowTarget, Follower, FollowerTuning};
///
/// let mut follower = Follower::new(FollowerTuning::default());
/// let (now, here) = (MonoTime::from_ns(1_000_000_000), Vector3::new(0.0, 0.0, -12.0));
/// // A vehicle 5 m north that stands: it accelerates north.
/// let target = FollowTarget {
///     stamp: Span::from_s(100.0),
///     position_m: Vector3::new(5.0, 0.0, 0.0),
///     velocity_mps: Vector3::zeros(),
///     acceleration_mps2: Vector3::zeros(),
/// };
/// follower.hear(&target, now);
/// follower.command(now, &here, &Vector3::zeros());
/// let wanted = follower.command(now + Span::from_ms(100.0), &here, &Vector3::zeros());
/// assert!(wanted.x > 0.0 && wanted.y.abs() < 1e-9);
/// ```
#[derive(Clone, Debug)]
pub struct Follower {
    tuning: FollowerTuning,
    latest: Option<(FollowTarget, MonoTime)>,
    /// Least arrival minus stamp.
    least: Option<Span>,
    /// Where it stays while there is no message.
    hold: Option<Vector3<f64>>,
    wanted: Vector3<f64>,
    last: Option<MonoTime>,
}

impl Follower {
    /// A follower without a message yet.
    pub fn new(tuning: FollowerTuning) -> Self {
        Self { tuning, latest: None, least: None, hold: None, wanted: Vector3::zeros(), last: None }
    }

    /// Takes a message that was received at `t`.
    pub fn hear(&mut self, target: &FollowTarget, t: MonoTime) {
        let apart = (t - MonoTime::default()) - target.stamp;
        let least = match self.least {
            // Clocks drift: the least delay increases by a millisecond a second. A step starts again.
            Some(least) if (apart - least).abs() < Span::from_ns(1_000_000_000) => {
                apart.min(least + Span::from_ns(100_000))
            }
            _ => apart,
        };
        self.least = Some(least);
        self.latest = Some((*target, MonoTime::default() + target.stamp + least));
    }

    /// The demanded acceleration at `now`, at `position_m` with `velocity_mps`; north, east, down.
    pub fn command(
        &mut self,
        now: MonoTime,
        position_m: &Vector3<f64>,
        velocity_mps: &Vector3<f64>,
    ) -> Vector3<f64> {
        let limits = self.tuning;
        let dt = self.last.map_or(0.0, |last| (now - last).s());
        self.last = Some(now);
        let fresh = self.latest.filter(|(_, t)| now - *t <= limits.timeout);
        let (place, velocity, acceleration) = match fresh {
            Some((target, t)) => {
                self.hold = None;
                let age = (now - t).s();
                let above = Vector3::z() * limits.height_m;
                let v = target.velocity_mps + target.acceleration_mps2 * age;
                let p = target.position_m
                    + target.velocity_mps * age
                    + target.acceleration_mps2 * (0.5 * age * age);
                (p - above, v, target.acceleration_mps2)
            }
            None => {
                let stop = position_m + velocity_mps * 1.0;
                (*self.hold.get_or_insert(stop), Vector3::zeros(), Vector3::zeros())
            }
        };
        let asked = velocity + (place - position_m) * limits.position_gain;
        let asked = asked.cap_magnitude(limits.speed_mps);
        let mut wanted = acceleration + (asked - velocity_mps) * limits.velocity_gain;
        let level = wanted.x.hypot(wanted.y);
        if level > limits.acceleration_mps2 {
            wanted.x *= limits.acceleration_mps2 / level;
            wanted.y *= limits.acceleration_mps2 / level;
        }
        wanted.z = wanted.z.clamp(-limits.acceleration_mps2, limits.acceleration_mps2);
        let change = (wanted - self.wanted).cap_magnitude(limits.jerk_mps3 * dt);
        self.wanted += change;
        self.wanted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Flies a point with this follower for `s` seconds; returns its final and its desired position.
    fn flown(s: f64, silent_from: f64) -> (Vector3<f64>, Vector3<f64>) {
        let mut follower = Follower::new(FollowerTuning::default());
        let (mut p, mut v) = (Vector3::new(0.0, 0.0, -12.0), Vector3::zeros());
        let at = |t: f64| Vector3::new(1.5 * t, 2.0, 0.0);
        let steps = (s / 0.005) as u32;
        for k in 0..steps {
            let t = f64::from(k) * 0.005;
            let now = MonoTime::default() + Span::from_s(100.0 + t);
            if k % 20 == 0 && t < silent_from {
                // Received 50 ms late, from another clock.
                let target = FollowTarget {
                    stamp: Span::from_s(7.0 + t),
                    position_m: at(t),
                    velocity_mps: Vector3::new(1.5, 0.0, 0.0),
                    acceleration_mps2: Vector3::zeros(),
                };
                follower.hear(&target, now);
            }
            let a = follower.command(now, &p, &v);
            v += a * 0.005;
            p += v * 0.005;
        }
        (p - at(s) + Vector3::z() * 12.0, v)
    }

    #[test]
    fn it_comes_above_what_moves_and_stays_there() {
        let (off, v) = flown(20.0, f64::INFINITY);
        assert!(off.norm() < 0.02 && (v.x - 1.5).abs() < 0.01, "{off} {v}");
    }

    #[test]
    fn without_messages_it_stops() {
        let (_, v) = flown(20.0, 10.0);
        assert!(v.norm() < 0.02, "{v}");
    }
}
