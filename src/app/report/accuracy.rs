//! Errors against truth: root mean squares, and whether the covariances are consistent (NEES).

use nalgebra::{SMatrix, SVector};

use super::page::{Section, figure, grid, paragraph, table};
use super::{Context, cloud, line};
use crate::app::flight::{Flight, Track};
use crate::app::truth::Truth;
use crate::io::proto::windhover as wh;
use crate::plot::{Ink, Mark, thin};
use windhover_base::geo::{Geodetic, LocalFrame, wrap_angle};

/// The filter settles in this time; statistics start after it, seconds.
const SETTLING_S: f64 = 6.0;

/// Estimated minus true at one frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ErrorRow {
    /// Seconds from the flight's start.
    pub t_s: f64,
    /// North, east (m), heading (rad), speed (m/s), yaw rate (rad/s); NaN where the truth has no value.
    pub error: [f64; 5],
    /// One-sigma of each; NaN where there is no covariance.
    pub sigma: [f64; 5],
    /// Normalised error squared of all five, and of heading, speed and yaw rate.
    pub nees: Option<(f64, f64)>,
}

/// Errors of one estimator.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Errors {
    /// By frame.
    pub rows: Vec<ErrorRow>,
}

/// Errors of estimates against truth; `at_s` gives a message's time.
pub fn errors_of(
    states: &[wh::TargetState],
    truth: &Truth,
    frame: &LocalFrame,
    at_s: impl Fn(&wh::TargetState) -> f64,
) -> Errors {
    let rows = states.iter().filter(|s| is_held(s)).filter_map(|s| {
        let row = truth.at(s.frame)?;
        let ned = |lat_deg: f64, lon_deg: f64| {
            frame.ned(Geodetic { lat_deg, lon_deg, height_m: frame.datum().height_m })
        };
        let off = ned(s.lat_deg, s.lon_deg) - ned(row.lat_deg, row.lon_deg);
        let minus = |a: f64, b: Option<f64>| b.map_or(f64::NAN, |b| a - b);
        let error = [
            off.x,
            off.y,
            row.heading_rad.map_or(f64::NAN, |h| wrap_angle(s.heading_rad - h)),
            minus(s.speed_mps, row.speed_mps),
            minus(s.yaw_rate_radps, row.yaw_rate_radps),
        ];
        let covariance = covariance(s);
        let sigma = covariance.map_or([f64::NAN; 5], |p| std::array::from_fn(|k| p[(k, k)].max(0.0).sqrt()));
        Some(ErrorRow { t_s: at_s(s), error, sigma, nees: covariance.and_then(|p| nees(&error, &p)) })
    });
    Errors { rows: rows.collect() }
}

/// Whether an estimate has values to compare.
pub(super) fn is_held(s: &wh::TargetState) -> bool {
    s.known && matches!(s.status(), wh::TrackStatus::Tracking | wh::TrackStatus::Coasting)
}

/// The covariance of (north, east, heading, speed, yaw rate), where there is one.
pub(super) fn covariance(s: &wh::TargetState) -> Option<SMatrix<f64, 5, 5>> {
    if s.covariance.len() != 15 {
        return None;
    }
    let mut p = SMatrix::<f64, 5, 5>::zeros();
    let pairs = (0..5).flat_map(|r| (r..5).map(move |c| (r, c)));
    for ((r, c), value) in pairs.zip(&s.covariance) {
        p[(r, c)] = *value;
        p[(c, r)] = *value;
    }
    Some(p)
}

fn nees(error: &[f64; 5], p: &SMatrix<f64, 5, 5>) -> Option<(f64, f64)> {
    let e = SVector::<f64, 5>::from(*error);
    let all = e.dot(&p.cholesky()?.solve(&e));
    let (e3, p3) = (e.fixed_rows::<3>(2).into_owned(), p.fixed_view::<3, 3>(2, 2).into_owned());
    let three = e3.dot(&p3.cholesky()?.solve(&e3));
    (all.is_finite() && three.is_finite()).then_some((all, three))
}

impl Errors {
    fn settled(&self) -> impl Iterator<Item = &ErrorRow> {
        let long = self.rows.last().is_some_and(|r| r.t_s > 2.0 * SETTLING_S);
        self.rows.iter().filter(move |r| !long || r.t_s >= SETTLING_S)
    }

    /// Root mean square of one component.
    fn rms(&self, k: usize) -> Option<f64> {
        mean(self.settled().map(|r| r.error[k].powi(2))).map(f64::sqrt)
    }

    /// Root mean square of horizontal position, and of the same after its mean is taken off.
    pub fn position_rms(&self) -> Option<(f64, f64)> {
        let mean_of = |k: usize| mean(self.settled().map(|r| r.error[k]));
        let (n, e) = (mean_of(0)?, mean_of(1)?);
        let all = mean(self.settled().map(|r| r.error[0].powi(2) + r.error[1].powi(2)))?;
        Some((all.sqrt(), (all - n * n - e * e).max(0.0).sqrt()))
    }

    /// Mean normalised error squared: of all five (ideal 5) and of heading, speed, yaw rate (ideal 3).
    fn nees(&self) -> Option<(f64, f64)> {
        let of = |pick: fn((f64, f64)) -> f64| mean(self.settled().filter_map(|r| r.nees).map(pick));
        Some((of(|n| n.0)?, of(|n| n.1)?))
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, n) = values.filter(|v| v.is_finite()).fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
    (n > 0).then(|| sum / n as f64)
}

/// The section; nothing without truth.
pub(super) fn section(context: &Context<'_>) -> Option<Section> {
    let truth = context.truth?;
    let (name, track) = context.flight.targets.iter().next()?;
    let estimators = estimators_of(context.flight, track, truth)?;
    let mut body = paragraph(&format!(
        "Estimates of {name} against the given truth, root mean square after the first {SETTLING_S:.0} s. \
         The position's own mean error is the receiver's bias; the error without it is what matters for following. \
         Normalised error squared (NEES) is near 5 and 3 where the covariances are consistent; larger is overconfident."
    ));
    body += &table(&ERROR_COLUMNS, &error_rows(&estimators));
    let specs = [
        ("Error north", "m", 0, 1.0),
        ("Error east", "m", 1, 1.0),
        ("Error of heading", "°", 2, 1f64.to_degrees()),
        ("Error of speed", "m/s", 3, 1.0),
        ("Error of yaw rate", "°/s", 4, 1f64.to_degrees()),
    ];
    let mut charts = String::new();
    for (title, unit, k, scale) in specs {
        charts += &error_chart(context, title, unit, (k, scale), &estimators);
    }
    charts += &nees_chart(context, &estimators[0].1);
    body += &grid(&charts);
    Some(Section { id: "accuracy", title: "Errors", body })
}

/// Columns of the error table.
const ERROR_COLUMNS: [&str; 9] = [
    "estimator",
    "frames",
    "position m",
    "without mean m",
    "heading °",
    "speed m/s",
    "yaw rate °/s",
    "NEES of 5",
    "NEES of ψ v ω",
];

fn error_rows(estimators: &[(&str, Errors, Ink)]) -> Vec<Vec<String>> {
    let figure = |v: Option<f64>, digits: usize| v.map_or("–".to_owned(), |v| format!("{v:.digits$}"));
    estimators
        .iter()
        .filter(|(_, errors, _)| !errors.rows.is_empty())
        .map(|(name, errors, _)| {
            let (position, nees) = (errors.position_rms(), errors.nees());
            vec![
                (*name).to_owned(),
                errors.settled().count().to_string(),
                figure(position.map(|p| p.0), 3),
                figure(position.map(|p| p.1), 3),
                figure(errors.rms(2).map(f64::to_degrees), 2),
                figure(errors.rms(3), 3),
                figure(errors.rms(4).map(f64::to_degrees), 2),
                figure(nees.map(|n| n.0), 2),
                figure(nees.map(|n| n.1), 2),
            ]
        })
        .collect()
}

/// The error table of a flight's first target as text for a terminal; `None` where nothing can be
/// compared.
pub fn error_text(flight: &Flight, truth: &Truth) -> Option<String> {
    let (_, track) = flight.targets.iter().next()?;
    let rows = error_rows(&estimators_of(flight, track, truth)?);
    let head = ERROR_COLUMNS.map(String::from).to_vec();
    let all: Vec<Vec<String>> = std::iter::once(head).chain(rows).collect();
    let width = |k: usize| all.iter().map(|row| row[k].chars().count()).max().unwrap_or(0);
    let line = |row: &Vec<String>| {
        let cells = row.iter().enumerate().map(|(k, cell)| {
            let pad = " ".repeat(width(k) - cell.chars().count());
            if k == 0 { format!("{cell}{pad}") } else { format!("{pad}{cell}") }
        });
        cells.collect::<Vec<_>>().join("  ") + "\n"
    };
    (all.len() > 1).then(|| all.iter().map(line).collect())
}

/// Errors of each estimator, with its colour.
fn estimators_of(flight: &Flight, track: &Track, truth: &Truth) -> Option<[(&'static str, Errors, Ink); 4]> {
    let frame = LocalFrame::new(flight.datum?);
    let at = |s: &wh::TargetState| flight.at(s.timestamp.as_ref());
    Some([
        ("real time", errors_of(&track.filtered, truth, &frame, at), Ink::Blue),
        ("smoothed", errors_of(&track.smoothed, truth, &frame, at), Ink::Green),
        ("refined", errors_of(&track.refined, truth, &frame, at), Ink::Violet),
        ("paper", errors_of(&track.paper, truth, &frame, at), Ink::Orange),
    ])
}

fn error_chart(
    context: &Context<'_>,
    title: &str,
    unit: &str,
    (k, scale): (usize, f64),
    estimators: &[(&str, Errors, Ink)],
) -> String {
    let filtered = &estimators[0].1.rows;
    if filtered.iter().all(|r| !r.error[k].is_finite()) {
        return String::new();
    }
    let points =
        |rows: &[ErrorRow]| -> Vec<[f64; 2]> { rows.iter().map(|r| [r.t_s, r.error[k] * scale]).collect() };
    let mut chart = context.chart(title, unit);
    let reach = filtered
        .iter()
        .filter(|r| r.t_s >= SETTLING_S || filtered.len() < 200)
        .map(|r| r.error[k].abs().max(2.0 * r.sigma[k]) * scale)
        .filter(|v| v.is_finite())
        .fold(1e-6, f64::max);
    chart = chart.y_range(-1.15 * reach, 1.15 * reach);
    let step = filtered.len().div_ceil(super::LINE_POINTS).max(1);
    let band = filtered.iter().step_by(step).map(|r| [r.t_s, -r.sigma[k] * scale, r.sigma[k] * scale]);
    chart.mark(Mark::Band(band.collect()), Ink::Blue);
    for (name, errors, ink) in estimators.iter().rev().filter(|(_, e, _)| !e.rows.is_empty()) {
        let points = points(&errors.rows);
        if *name == "paper" {
            chart.named(*name, cloud(&points, 0.9), *ink);
        } else {
            chart.named(*name, line(&points), *ink);
        }
    }
    figure(&chart.render())
}

fn nees_chart(context: &Context<'_>, errors: &Errors) -> String {
    let points: Vec<[f64; 2]> = errors.rows.iter().filter_map(|r| Some([r.t_s, r.nees?.1])).collect();
    if points.is_empty() {
        return String::new();
    }
    let mut chart = context.chart("NEES of heading, speed, yaw rate", "").y_range(0.0, 15.0);
    chart.named("real time", Mark::Line(thin(&points, super::LINE_POINTS)), Ink::Blue);
    let end = context.flight.duration_s();
    chart.named("ideal mean", Mark::Dashed(vec![[0.0, 3.0], [end, 3.0]]), Ink::Grey);
    // The 99 % quantile of chi-squared with three degrees of freedom.
    chart.named("99 % below", Mark::Dashed(vec![[0.0, 11.345], [end, 11.345]]), Ink::Red);
    figure(&chart.render())
}
