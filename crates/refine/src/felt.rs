//! What the tilt sensor measures, where the filter could not decide it: by the whole flight.
//!
//! At a solution to which the readings contributed little, each reading z is compared with what each kind of sensor would read: down
//! in the body (attitude), the direction against the specific force, a share of the former. Means over windows and
//! differences of neighbouring windows are free of biases and slow errors; the kind with the largest likelihood leads, the
//! noise of each at its best: `−½ n ln Σ |Δz − Δw|²`.

use nalgebra::Vector2;

use windhover_base::msg::FeltTilt;

use crate::problem::Pass;
use crate::unknowns::{constant, knot};
use crate::values::{Aside, Knot, Values};

/// Length of a window, s.
const WINDOW_S: f64 = 0.5;
/// Lead over the next kind, nats.
const LEAD: f64 = 4.0;
/// Differences that are needed.
const FEWEST: usize = 10;
/// Noise of a difference that is assumed at the least, rad.
const LEAST_NOISE: f64 = 0.002;
/// Shares that a sensor may read.
const SHARES: std::ops::RangeInclusive<f64> = 0.05..=0.5;

/// Pitch and roll: as read, as a sensor of attitude would read them, and as one of the specific force.
type Three = [Vector2<f64>; 3];

/// The kind of the sensor; `None` where no kind leads.
pub(crate) fn felt(pass: &mut Pass<'_>, values: &Values) -> Option<FeltTilt> {
    pass.begin(values);
    let windows = windows(pass, values);
    let differences: Vec<Three> = windows
        .windows(2)
        .filter_map(|pair| match pair {
            [Some(a), Some(b)] => Some(std::array::from_fn(|i| b[i] - a[i])),
            _ => None,
        })
        .collect();
    decided(&differences)
}

fn decided(differences: &[Three]) -> Option<FeltTilt> {
    if differences.len() < FEWEST {
        return None;
    }
    let sum = |of: &dyn Fn(&Three) -> f64| differences.iter().map(of).sum::<f64>();
    let (xy, xx) = (sum(&|[z, d, _]| z.dot(d)), sum(&|[_, d, _]| d.norm_squared()));
    let share = (xy / xx.max(1e-12)).clamp(*SHARES.start(), *SHARES.end());
    // Two differences share a window, and have two components.
    let n = differences.len() as f64;
    let score = |square: f64| -0.5 * n * (square / (2.0 * n) + LEAST_NOISE.powi(2)).ln();
    let mut scores = [
        (score(sum(&|[z, d, _]| (z - d).norm_squared())), FeltTilt::Attitude),
        (score(sum(&|[z, _, u]| (z - u).norm_squared())), FeltTilt::Force),
        (score(sum(&|[z, d, _]| (z - d * share).norm_squared())), FeltTilt::Share(share)),
    ];
    scores.sort_by(|a, b| b.0.total_cmp(&a.0));
    (scores[0].0 - scores[1].0 > LEAD).then_some(scores[0].1)
}

/// Means over windows of time; `None` where one has no reading, and where a trajectory begins.
fn windows(pass: &mut Pass<'_>, values: &Values) -> Vec<Option<Three>> {
    let problem = pass.problem;
    let (mut all, mut sum, mut n, mut since) = (Vec::new(), Three::default(), 0.0, None);
    for (k, stop) in problem.plan.stops.iter().enumerate() {
        let begun = *since.get_or_insert(stop.t);
        if stop.begins || (stop.t - begun).s() >= WINDOW_S {
            all.push((n > 0.0).then(|| sum.map(|sum: Vector2<f64>| sum / n)));
            if stop.begins {
                all.push(None);
            }
            (sum, n, since) = (Three::default(), 0.0, Some(stop.t));
        }
        for index in &stop.readings {
            if let Some(three) = three(pass, values, k, *index) {
                sum.iter_mut().zip(three).for_each(|(sum, x)| *sum += x);
                n += 1.0;
            }
        }
    }
    all
}

fn three(pass: &mut Pass<'_>, values: &Values, k: usize, index: usize) -> Option<Three> {
    let problem = pass.problem;
    let stop = &problem.plan.stops[k];
    let reading = &problem.recordings[stop.flight].readings[index];
    let dt = Pass::after_knot(stop, reading.t_valid, values) - values.constants[constant::COMPASS_DELAY];
    let mut state = pass.state_at(k, values, dt);
    state.x[knot::TILT_ERROR..knot::TILT_ERROR + 2].fill(0.0);
    let read = left_over(pass, values, &state, (0.0, FeltTilt::Attitude), index, k)?;
    let [attitude, force] = [FeltTilt::Attitude, FeltTilt::Force]
        .map(|kind| left_over(pass, values, &state, (1.0, kind), index, k).map(|left| read - left));
    Some([read, attitude?, force?])
}

/// The reading less what a sensor of this kind would read, of which it reads a share.
fn left_over(
    pass: &mut Pass<'_>,
    values: &Values,
    state: &Knot,
    (share, kind): (f64, FeltTilt),
    index: usize,
    k: usize,
) -> Option<Vector2<f64>> {
    let problem = pass.problem;
    let mut constants = values.constants.clone();
    constants[constant::TILT_SHARE] = share;
    constants[constant::TILT_BIAS..constant::TILT_BIAS + 2].fill(0.0);
    let changed = Values { knots: Vec::new(), landmarks: Vec::new(), shakes: Vec::new(), constants };
    pass.predictor.set_felt(Some(kind));
    changed.put(state, &Aside::NONE, &problem.places, &mut pass.means, &mut pass.predictor);
    let sample = &problem.recordings[problem.plan.stops[k].flight].readings[index].value;
    let linear = pass.predictor.tilt(sample).filter(|linear| linear.is_finite())?;
    Some(Vector2::new(linear.residual(0), linear.residual(1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Differences of a sensor that reads so much of attitude and of force, with some noise.
    fn read(of_attitude: f64, of_force: f64, motion: f64) -> Vec<Three> {
        (0..40)
            .map(|i| {
                let t = f64::from(i);
                let d = Vector2::new((0.7 * t).sin(), (1.1 * t).cos()) * motion;
                let u = Vector2::new((0.3 * t).cos(), (0.9 * t).sin()) * motion;
                let noise = Vector2::new((7.3 * t).sin(), (5.9 * t).sin()) * 0.003;
                [d * of_attitude + u * of_force + noise, d, u]
            })
            .collect()
    }

    #[test]
    fn each_kind_is_found_where_there_is_motion() {
        assert_eq!(decided(&read(1.0, 0.0, 0.03)), Some(FeltTilt::Attitude));
        assert_eq!(decided(&read(0.0, 1.0, 0.03)), Some(FeltTilt::Force));
        let Some(FeltTilt::Share(share)) = decided(&read(0.15, 0.0, 0.03)) else { panic!("a share") };
        assert!((share - 0.15).abs() < 0.02, "{share}");
        assert_eq!(decided(&read(1.0, 0.0, 1e-4)), None);
        assert_eq!(decided(&read(1.0, 0.0, 0.03)[..FEWEST - 1]), None);
    }
}
