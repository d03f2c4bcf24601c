//! Scores of a closed-loop flight for the pilot of a follower.

use nalgebra::{Vector2, Vector3};

use super::closed_loop::Moment;

/// Scores of a flight from a given time on.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Score {
    /// Horizontal distance of the helicopter from the vehicle, rms, metres.
    pub follow_rms_m: f64,
    /// The same, largest.
    pub follow_max_m: f64,
    /// Tilt, rms and largest, degrees.
    pub tilt_rms_deg: f64,
    /// The same, largest.
    pub tilt_max_deg: f64,
    /// Height over the vehicle, mean, metres.
    pub height_m: f64,
    /// Velocity in the messages less the true one, rms of its length, m/s.
    pub velocity_rms_mps: f64,
    /// Correlation of that error with the helicopter's own acceleration through its tilt; the larger of north and east
    /// by size.
    pub correlation: f64,
    /// By how much the positions in the messages are late, ms: their error regressed on the vehicle's velocity, both
    /// less their means.
    pub lag_ms: f64,
    /// Highest speed of the helicopter, m/s.
    pub speed_max_mps: f64,
    /// Number of messages.
    pub messages: usize,
}

impl Score {
    /// Of the moments from `from_s` on.
    pub fn of(moments: &[Moment], from_s: f64) -> Self {
        let moments: Vec<&Moment> = moments.iter().filter(|moment| moment.t_s >= from_s).collect();
        let mean = |of: &dyn Fn(&Moment) -> f64| {
            moments.iter().map(|moment| of(moment)).sum::<f64>() / moments.len().max(1) as f64
        };
        let most = |of: &dyn Fn(&Moment) -> f64| moments.iter().map(|moment| of(moment)).fold(0.0, f64::max);
        let away = |m: &Moment| (m.own.position_ned_m - m.vehicle.origin()).xy().norm();
        let tilt = |m: &Moment| (m.own.ned_from_body * Vector3::z()).z.clamp(-1.0, 1.0).acos().to_degrees();
        let (errors, tilts): (Vec<Vector2<f64>>, Vec<Vector2<f64>>) = moments
            .iter()
            .filter_map(|m| {
                let (s, c) = m.vehicle.heading_rad.sin_cos();
                let error = m.received?.velocity_mps.xy() - Vector2::new(c, s) * m.vehicle.speed_mps;
                Some((error, -(m.own.ned_from_body * Vector3::z()).xy()))
            })
            .unzip();
        let squares: f64 = errors.iter().map(Vector2::norm_squared).sum();
        let messages = errors.len();
        Self {
            follow_rms_m: mean(&|m| away(m).powi(2)).sqrt(),
            follow_max_m: most(&away),
            tilt_rms_deg: mean(&|m| tilt(m).powi(2)).sqrt(),
            tilt_max_deg: most(&tilt),
            height_m: mean(&|m| m.vehicle.origin().z - m.own.position_ned_m.z),
            velocity_rms_mps: (squares / messages.max(1) as f64).sqrt(),
            correlation: [0, 1]
                .map(|axis| correlation(errors.iter().map(|e| e[axis]), tilts.iter().map(|t| t[axis])))
                .into_iter()
                .fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a }),
            lag_ms: -1e3
                * slope(moments.iter().filter_map(|m| {
                    let (s, c) = m.vehicle.heading_rad.sin_cos();
                    let error = m.received?.position_m.xy() - m.vehicle.origin().xy();
                    Some((error, Vector2::new(c, s) * m.vehicle.speed_mps))
                })),
            speed_max_mps: most(&|m| m.own.velocity_ned_mps.norm()),
            messages,
        }
    }
}

/// Slope of the first on the second, both less their means; 0 where the second is constant.
fn slope(pairs: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone) -> f64 {
    let n = pairs.clone().count().max(1) as f64;
    let mean = pairs.clone().fold((Vector2::zeros(), Vector2::zeros()), |sum, (a, b)| (sum.0 + a, sum.1 + b));
    let (mean_a, mean_b) = (mean.0 / n, mean.1 / n);
    let (ab, bb) = pairs.fold((0.0, 0.0), |(ab, bb), (a, b)| {
        let (a, b): (Vector2<f64>, Vector2<f64>) = (a - mean_a, b - mean_b);
        (ab + a.dot(&b), bb + b.norm_squared())
    });
    if bb > 0.0 { ab / bb } else { 0.0 }
}

fn correlation(a: impl Iterator<Item = f64> + Clone, b: impl Iterator<Item = f64> + Clone) -> f64 {
    let n = a.clone().count().max(1) as f64;
    let (mean_a, mean_b) = (a.clone().sum::<f64>() / n, b.clone().sum::<f64>() / n);
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (x, y) in a.zip(b) {
        ab += (x - mean_a) * (y - mean_b);
        aa += (x - mean_a).powi(2);
        bb += (y - mean_b).powi(2);
    }
    if aa > 0.0 && bb > 0.0 { ab / (aa * bb).sqrt() } else { 0.0 }
}
