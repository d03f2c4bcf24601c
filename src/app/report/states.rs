//! States over time: heading, speed and yaw rate of each target; the helicopter's own state.

use nalgebra::{Quaternion, UnitQuaternion};

use super::accuracy::{covariance, is_held};
use super::page::{Section, figure, grid};
use super::{Context, cloud, line, single};
use crate::app::flight::Track;
use crate::app::truth::TruthRow;
use crate::io::proto::windhover as wh;
use crate::plot::{Ink, Mark};
use windhover_base::geo::{euler_321, wrap_angle};

/// One quantity of a target.
struct Quantity {
    title: &'static str,
    unit: &'static str,
    /// Row of the covariance.
    row: usize,
    scale: f64,
    of: fn(&wh::TargetState) -> f64,
    of_truth: fn(&TruthRow) -> Option<f64>,
    angle: bool,
}

const QUANTITIES: [Quantity; 3] = [
    Quantity {
        title: "heading",
        unit: "°",
        row: 2,
        scale: 180.0 / std::f64::consts::PI,
        of: |s| s.heading_rad,
        of_truth: |t| t.heading_rad,
        angle: true,
    },
    Quantity {
        title: "speed",
        unit: "m/s",
        row: 3,
        scale: 1.0,
        of: |s| s.speed_mps,
        of_truth: |t| t.speed_mps,
        angle: false,
    },
    Quantity {
        title: "yaw rate",
        unit: "°/s",
        row: 4,
        scale: 180.0 / std::f64::consts::PI,
        of: |s| s.yaw_rate_radps,
        of_truth: |t| t.yaw_rate_radps,
        angle: false,
    },
];

/// The section; empty without targets.
pub(super) fn section(context: &Context<'_>) -> Option<Section> {
    let mut charts = String::new();
    for (k, (name, track)) in context.flight.targets.iter().enumerate() {
        for quantity in &QUANTITIES {
            charts += &chart_of(context, name, track, quantity, k == 0);
        }
    }
    (!charts.is_empty()).then(|| Section { id: "states", title: "States", body: grid(&charts) })
}

/// Keeps an angle continuous: adds the turns that bring it nearest to the last one.
struct Unwrap {
    last: Option<f64>,
}

impl Unwrap {
    fn next(&mut self, value: f64, angle: bool) -> f64 {
        if !angle || !value.is_finite() {
            return value;
        }
        let unwrapped = self.last.map_or(value, |last| last + wrap_angle(value - last));
        self.last = Some(unwrapped);
        unwrapped
    }
}

fn chart_of(context: &Context<'_>, name: &str, track: &Track, q: &Quantity, with_truth: bool) -> String {
    let mut unwrap = Unwrap { last: None };
    let mut reference: Vec<(u32, f64)> = Vec::new();
    let (mut filtered, mut band) = (Vec::new(), Vec::new());
    for s in &track.filtered {
        let t = context.flight.at(s.timestamp.as_ref());
        if !is_held(s) {
            filtered.push([t, f64::NAN]);
            band.push([t, f64::NAN, f64::NAN]);
            continue;
        }
        let value = unwrap.next((q.of)(s), q.angle);
        reference.push((s.frame, value));
        filtered.push([t, value * q.scale]);
        let sigma = covariance(s).map_or(f64::NAN, |p| p[(q.row, q.row)].max(0.0).sqrt());
        band.push([t, (value - sigma) * q.scale, (value + sigma) * q.scale]);
    }
    if reference.is_empty() {
        return String::new();
    }
    // Other curves use the same number of turns as the filter's at the same frame.
    let beside = |frame: u32, value: f64| {
        if !q.angle {
            return value * q.scale;
        }
        let k = reference.partition_point(|r| r.0 < frame).min(reference.len() - 1);
        (reference[k].1 + wrap_angle(value - reference[k].1)) * q.scale
    };
    let others = |states: &[wh::TargetState]| -> Vec<[f64; 2]> {
        let held = states.iter().filter(|s| is_held(s));
        held.map(|s| [context.flight.at(s.timestamp.as_ref()), beside(s.frame, (q.of)(s))]).collect()
    };
    let (smoothed, paper, refined) = (others(&track.smoothed), others(&track.paper), others(&track.refined));
    let title = format!("{name}: {}", q.title);
    let mut chart = context.chart(&title, q.unit).y_range_of(filtered.iter().chain(&smoothed).map(|p| p[1]));
    let step = band.len().div_ceil(super::LINE_POINTS).max(1);
    chart.mark(Mark::Band(band.into_iter().step_by(step).collect()), Ink::Blue);
    if !paper.is_empty() {
        chart.named("paper", cloud(&paper, 0.9), Ink::Orange);
    }
    if let Some(truth) = context.truth.filter(|_| with_truth) {
        let at = |s: &wh::TargetState| {
            let value = (q.of_truth)(truth.at(s.frame)?)?;
            Some([context.flight.at(s.timestamp.as_ref()), beside(s.frame, value)])
        };
        let points: Vec<[f64; 2]> = track.filtered.iter().filter_map(at).collect();
        if !points.is_empty() {
            chart.named("truth", line(&points), Ink::Black);
        }
    }
    chart.named("real time, one-sigma band", line(&filtered), Ink::Blue);
    if !smoothed.is_empty() {
        chart.named("smoothed", line(&smoothed), Ink::Green);
    }
    if !refined.is_empty() {
        chart.named("refined", line(&refined), Ink::Violet);
    }
    figure(&chart.render())
}

/// The helicopter's own flight; empty where its state is not known.
pub(super) fn ownship_section(context: &Context<'_>) -> Option<Section> {
    let flight = context.flight;
    if flight.ownship.is_empty() {
        return None;
    }
    let points = |of: &dyn Fn(&wh::Ownship) -> f64| -> Vec<[f64; 2]> {
        flight.ownship.iter().map(|o| [flight.at(o.timestamp.as_ref()), of(o)]).collect()
    };
    let mut charts = single(context, "Height over the datum", "m", &points(&|o| -o.down_m), Ink::Violet);
    charts += &single(context, "Ground speed", "m/s", &points(&|o| o.vn_mps.hypot(o.ve_mps)), Ink::Violet);
    let attitude = |o: &wh::Ownship| {
        let q = UnitQuaternion::from_quaternion(Quaternion::new(o.qw, o.qx, o.qy, o.qz));
        euler_321(&q.to_rotation_matrix())
    };
    let mut tilt = context.chart("Pitch and roll", "°");
    tilt.named("pitch", line(&points(&|o| attitude(o).1.to_degrees())), Ink::Blue);
    tilt.named("roll", line(&points(&|o| attitude(o).2.to_degrees())), Ink::Orange);
    charts += &figure(&tilt.render());
    let mut unwrap = Unwrap { last: None };
    let heading: Vec<[f64; 2]> = flight
        .ownship
        .iter()
        .map(|o| [flight.at(o.timestamp.as_ref()), unwrap.next(attitude(o).0, true).to_degrees()])
        .collect();
    charts += &single(context, "Heading of the helicopter", "°", &heading, Ink::Violet);
    Some(Section { id: "ownship", title: "Helicopter", body: grid(&charts) })
}
