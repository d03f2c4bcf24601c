//! Errors and NEES of an estimator over flights, as rows of the table.

use nalgebra::{Matrix3, SMatrix, SVector};
use windhover_base::geo::wrap_angle;
use windhover_base::msg::{FrameObservations, MarkerId, TargetEstimate, TrackStatus};
use windhover_base::settings::Rig;
use windhover_simulate::World;

/// Scores start here, seconds into the flight.
pub(crate) const BURN_S: f64 = 6.0;

/// Squared errors of one run.
#[derive(Default, Clone)]
pub(crate) struct Score {
    frames: usize,
    owed: usize,
    squared: SVector<f64, 5>,
    sum: SVector<f64, 5>,
    nees3: f64,
    nees5: f64,
    nees2: f64,
    /// Of heading, speed and yaw rate each.
    apart: [f64; 3],
    lost: usize,
}

impl Score {
    pub(crate) fn add(&mut self, estimate: &TargetEstimate, world: &World) {
        let truth = world.vehicle(estimate.target, estimate.t_valid);
        if world.seconds(estimate.t_valid) < BURN_S {
            return;
        }
        self.owed += 1;
        let live = matches!(estimate.status, TrackStatus::Tracking | TrackStatus::Coasting);
        let Some(state) = estimate.state.filter(|_| live) else {
            self.lost += 1;
            return;
        };
        let reference = truth.reference(world.scenario().rig.target[estimate.target].reference_m);
        let e = SVector::<f64, 5>::from([
            state.north_m - reference.x,
            state.east_m - reference.y,
            wrap_angle(state.heading_rad - truth.heading_rad),
            state.speed_mps - truth.speed_mps,
            state.yaw_rate_radps - truth.yaw_rate_radps,
        ]);
        self.frames += 1;
        self.squared += e.component_mul(&e);
        self.sum += e;
        if let Some(p) = state.covariance {
            let last: Matrix3<f64> = p.fixed_view::<3, 3>(2, 2).into();
            let e3 = e.fixed_rows::<3>(2).into_owned();
            self.nees3 += last.try_inverse().map_or(f64::NAN, |i| (e3.transpose() * i * e3)[0]);
            for (i, sum) in self.apart.iter_mut().enumerate() {
                *sum += e[2 + i] * e[2 + i] / p[(2 + i, 2 + i)];
            }
            self.nees5 +=
                p.try_inverse().map_or(f64::NAN, |i: SMatrix<f64, 5, 5>| (e.transpose() * i * e)[0]);
            let two = p.fixed_view::<2, 2>(0, 0).into_owned();
            let e2 = e.fixed_rows::<2>(0).into_owned();
            self.nees2 += two.try_inverse().map_or(f64::NAN, |i| (e2.transpose() * i * e2)[0]);
        }
    }

    pub(crate) fn figures(&self) -> Figures {
        let n = self.frames.max(1) as f64;
        let mean = self.sum / n;
        let rms = |i: usize| (self.squared[i] / n).sqrt();
        let rel = ((self.squared[0] + self.squared[1]) / n - mean[0] * mean[0] - mean[1] * mean[1]).max(0.0);
        Figures([
            rel.sqrt(),
            rms(2).to_degrees(),
            rms(3),
            rms(4),
            self.nees3 / n,
            self.nees5 / n,
            self.nees2 / n,
            self.frames as f64 / self.owed.max(1) as f64,
        ])
    }

    pub(crate) fn apart(&self) -> [f64; 3] {
        self.apart.map(|sum| sum / self.frames.max(1) as f64)
    }
}

/// An estimate and the truth: each error with its sigma.
pub(crate) fn line(e: &TargetEstimate, world: &World) -> String {
    let head = format!("{:6.2} target {} {:?}", world.seconds(e.t_valid), e.target, e.status);
    let Some((state, p)) = e.state.as_ref().and_then(|s| Some((s, s.covariance?))) else { return head };
    let truth = world.vehicle(e.target, e.t_valid);
    let reference = truth.reference(world.scenario().rig.target[e.target].reference_m);
    let sigma = |i: usize| p[(i, i)].sqrt();
    format!(
        "{head} north {:.2}±{:.2} m, east {:.2}±{:.2} m, heading {:.2}±{:.2} deg, speed {:.3}±{:.3} m/s, \
         yaw rate {:.4}±{:.4} rad/s",
        state.north_m - reference.x,
        sigma(0),
        state.east_m - reference.y,
        sigma(1),
        wrap_angle(state.heading_rad - truth.heading_rad).to_degrees(),
        sigma(2).to_degrees(),
        state.speed_mps - truth.speed_mps,
        sigma(3),
        state.yaw_rate_radps - truth.yaw_rate_radps,
        sigma(4),
    )
}

/// Whether a frame shows a marker of a target.
pub(crate) fn shows(seen: &FrameObservations, rig: &Rig, target: usize) -> bool {
    seen.markers.iter().any(|detection| match detection.marker {
        MarkerId::Disc { target: of, .. } => of == target,
        MarkerId::Tag { id, .. } => rig.target[target].marker.iter().any(|marker| marker.id == Some(id)),
    })
}

/// rel m, heading deg, speed, yaw rate, NEES of three, of five, of position, coverage.
#[derive(Clone, Copy)]
pub(crate) struct Figures(pub(crate) [f64; 8]);

/// Mean (or root mean square) over runs, and the spread about it.
pub(crate) fn mean_and_spread(values: impl Iterator<Item = f64> + Clone, squared: bool) -> (f64, f64) {
    let n = values.clone().count().max(1) as f64;
    let mean = if squared {
        (values.clone().map(|x| x * x).sum::<f64>() / n).sqrt()
    } else {
        values.clone().sum::<f64>() / n
    };
    (mean, (values.map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt())
}

/// A row of the table: root mean squares of the errors over runs, means of NEES and coverage, with their spread.
pub(crate) fn summary(runs: &[Figures]) -> String {
    let mut text = String::new();
    for i in 0..8 {
        let (mean, spread) = mean_and_spread(runs.iter().map(|f| f.0[i]), i < 4);
        let cell = match i {
            // An estimator without a covariance has no NEES.
            4..7 if mean == 0.0 => format!("{:>7} {:6}", "–", ""),
            7 => format!("{mean:6.3}"),
            _ => format!("{mean:7.3}±{spread:<6.3}"),
        };
        text += &cell;
        text.push(' ');
    }
    text
}
