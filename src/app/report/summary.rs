//! The flight as text and numbers.

use super::Context;
use super::accuracy::{covariance, errors_of, is_held};
use super::page::{Section, list, paragraph, tiles};
use super::pictures::Pictures;
use super::sensors::{quantile, streams};
use crate::app::flight::Track;
use crate::io::proto::windhover as wh;

/// A sensor is reported as silent after this many of its median gaps (and a third of a second).
const LONG_GAP: f64 = 3.5;

/// The section.
pub(super) fn section(context: &Context<'_>, pictures: &Pictures) -> Option<Section> {
    let mut body = paragraph(&opening(context));
    for (name, track) in &context.flight.targets {
        body += &paragraph(&of_target(context, name, track));
    }
    if let Some(words) = without_targets(context) {
        body += &paragraph(words);
    }
    body += &tiles(&figures(context));
    let troubles = troubles(context, pictures);
    if troubles.is_empty() {
        body += "<p class=\"good\">Nothing out of the ordinary.</p>\n";
    } else {
        body += "<h3>Worth a look</h3>\n";
        body += &list("", &troubles);
    }
    Some(Section { id: "summary", title: "Summary", body })
}

/// The text where there are no data of any vehicle.
fn without_targets(context: &Context<'_>) -> Option<&'static str> {
    let flight = context.flight;
    match (flight.targets.is_empty(), flight.ownship.is_empty()) {
        (false, _) => None,
        (true, false) => Some(
            "No frame was received from the camera, so no vehicle was searched for: the report covers the helicopter's own \
             flight alone.",
        ),
        (true, true) => Some(
            "It has no estimates: it is a capture. Replay it (windhover replay CAPTURE.mcap --out \
             FLIGHT.mcap) and report the result.",
        ),
    }
}

fn opening(context: &Context<'_>) -> String {
    let flight = context.flight;
    let began =
        flight.utc.map_or("at an unknown date".to_owned(), |utc| format!("on {}", spoken(&utc.to_string())));
    let sensors: Vec<String> = streams(context)
        .iter()
        .filter_map(|s| {
            Some(format!("{} {} ({:.1} a second)", s.times.len(), unit_of(s.name), s.timing()?.rate_hz))
        })
        .collect();
    let received = if sensors.is_empty() { "no decoded messages".to_owned() } else { sensors.join(", ") };
    let mut text = format!("Recorded {began}, {} long: {received}.", length(flight.duration_s()));
    let heights: Vec<f64> = flight.ownship.iter().map(|o| -o.down_m).collect();
    if !heights.is_empty() {
        text += &format!(
            " The helicopter flew {:.0} to {:.0} m over the datum.",
            quantile(&heights, 0.02),
            quantile(&heights, 0.98)
        );
    }
    text
}

fn unit_of(stream: &str) -> &'static str {
    match stream {
        "gps" => "fixes",
        "compass" => "compass samples",
        _ => "frames",
    }
}

/// `2026-11-18T15:04:05.200Z` as `2026-11-18 15:04:05 UTC`.
fn spoken(iso: &str) -> String {
    let seconds = iso.split('.').next().unwrap_or(iso);
    format!("{} UTC", seconds.replace('T', " "))
}

fn length(seconds: f64) -> String {
    if seconds < 120.0 {
        return format!("{seconds:.0} s");
    }
    format!("{} min {:02} s", (seconds / 60.0) as u64, (seconds % 60.0) as u64)
}

/// Data of a track for text and tiles.
struct Known {
    held: f64,
    distance_m: f64,
    fastest_mps: f64,
    sigma: [f64; 5],
}

fn known(track: &Track) -> Option<Known> {
    let held: Vec<&wh::TargetState> = track.filtered.iter().filter(|s| is_held(s)).collect();
    let first = held.first()?;
    // The distance is speed over time, not the length of the path: noise of position would lengthen that.
    let mut distance_m = 0.0;
    let mut before = first;
    for s in &held {
        let dt = crate::io::proto::host_time(s.timestamp.as_ref())
            - crate::io::proto::host_time(before.timestamp.as_ref());
        if dt.s() < 1.0 {
            distance_m += s.speed_mps.abs() * dt.s();
        }
        before = s;
    }
    let sigma = std::array::from_fn(|k| {
        let all: Vec<f64> =
            held.iter().filter_map(|s| covariance(s)).map(|p| p[(k, k)].max(0.0).sqrt()).collect();
        quantile(&all, 0.5)
    });
    let speeds: Vec<f64> = held.iter().map(|s| s.speed_mps.abs()).collect();
    Some(Known {
        held: held.len() as f64 / track.filtered.len().max(1) as f64,
        distance_m,
        fastest_mps: quantile(&speeds, 0.995),
        sigma,
    })
}

fn of_target(context: &Context<'_>, name: &str, track: &Track) -> String {
    let Some(k) = known(track) else {
        return format!("{name} was never tracked: its state is not known.");
    };
    let lost = track.filtered.iter().filter(|s| !is_held(s)).count();
    let mut text = format!(
        "{name} was tracked in {:.1} % of {} frames{}. It drove about {:.0} m, up to {:.1} m/s. ",
        100.0 * k.held,
        track.filtered.len(),
        if lost == 0 { ", without a break".to_owned() } else { String::new() },
        k.distance_m,
        k.fastest_mps
    );
    if k.sigma[2].is_finite() {
        text += &format!(
            "In real time its heading was known to {:.2}°, its speed to {:.2} m/s, its yaw rate to {:.2}°/s, \
             its position to {:.2} m (one sigma, median).",
            k.sigma[2].to_degrees(),
            k.sigma[3],
            k.sigma[4].to_degrees(),
            k.sigma[0].hypot(k.sigma[1]) / 2f64.sqrt()
        );
    }
    if let (Some(truth), Some(frame)) = (context.truth, context.frame()) {
        let at = |s: &wh::TargetState| context.flight.at(s.timestamp.as_ref());
        let first = context.flight.targets.keys().next().is_some_and(|n| n == name);
        if let Some((all, relative)) =
            errors_of(&track.filtered, truth, &frame, at).position_rms().filter(|_| first)
        {
            text += &format!(
                " Against the truth its position was off by {all:.2} m, {relative:.2} m without the mean."
            );
        }
    }
    text
}

fn figures(context: &Context<'_>) -> Vec<(String, String)> {
    let flight = context.flight;
    let mut tiles = vec![(length(flight.duration_s()), "recorded".to_owned())];
    for (name, track) in &flight.targets {
        if let Some(k) = known(track) {
            tiles.push((format!("{:.1} %", 100.0 * k.held), format!("{name} held")));
            if k.sigma[2].is_finite() {
                tiles.push((format!("{:.2}°", k.sigma[2].to_degrees()), format!("{name} heading, 1σ")));
                tiles.push((format!("{:.2} m/s", k.sigma[3]), format!("{name} speed, 1σ")));
                tiles.push((format!("{:.2}°/s", k.sigma[4].to_degrees()), format!("{name} yaw rate, 1σ")));
            }
        }
    }
    for stream in streams(context) {
        if let Some(timing) = stream.timing() {
            tiles.push((format!("{:.1} Hz", timing.rate_hz), stream.name.to_owned()));
        }
    }
    tiles
}

fn troubles(context: &Context<'_>, pictures: &Pictures) -> Vec<String> {
    let flight = context.flight;
    let mut found = flight.warnings.clone();
    if !flight.had_frames() && !flight.health.is_empty() {
        found.push("No frame was received from the camera.".to_owned());
    }
    for stream in streams(context) {
        let Some(t) = stream.timing() else { continue };
        if t.longest.0 > LONG_GAP * t.median_ms && t.longest.0 > 333.0 {
            found.push(format!(
                "The {} was silent for {:.2} s at {:.1} s.",
                stream.name,
                t.longest.0 / 1e3,
                flight.seconds(t.longest.1)
            ));
        }
        if t.latency_ms.0 < 0.0 {
            found.push(format!(
                "The {} is stamped later than it was received: its clock or latency is wrong.",
                stream.name
            ));
        }
    }
    found.extend(misfits(context));
    if let Some(last) = flight.health.last() {
        for s in &last.sources {
            if s.refused > 0 {
                found.push(format!("{}: {} messages were refused.", s.name, s.refused));
            }
            if s.dropped > 0 {
                found.push(format!(
                    "{}: {} messages were lost before they could be recorded.",
                    s.name, s.dropped
                ));
            }
        }
    }
    for (name, track) in &flight.targets {
        let held: Vec<bool> = track.filtered.iter().map(is_held).collect();
        let breaks = held.windows(2).filter(|w| w[0] && !w[1]).count();
        if breaks > 0 {
            found.push(format!("{name} was lost {breaks} times after it had been found."));
        }
    }
    let resets = flight
        .notices
        .iter()
        .filter(|n| n.name == windhover_base::msg::NoticeKind::FilterReset.name())
        .count();
    if resets > 0 {
        found.push(format!("The filter was reset {resets} times."));
    }
    if pictures.unreadable > 0 {
        found.push(format!("{} of the examined frames could not be read.", pictures.unreadable));
    }
    found
}

/// Misfits of the configuration: each one once, with its last value, and its first and last time.
fn misfits(context: &Context<'_>) -> Vec<String> {
    let mut known: Vec<(&wh::Misfit, f64, f64)> = Vec::new();
    for health in &context.flight.health {
        let t = context.flight.at(health.timestamp.as_ref());
        for misfit in &health.misfits {
            let same = |m: &wh::Misfit| m.source == misfit.source && m.kind == misfit.kind;
            match known.iter_mut().find(|(known, ..)| same(known)) {
                Some((last, _, until)) => (*last, *until) = (misfit, t),
                None => known.push((misfit, t, t)),
            }
        }
    }
    let sentence = |(m, from, until): &(&wh::Misfit, f64, f64)| {
        let wh::Misfit { source, figure, cause, advice, .. } = m;
        format!("{source} does not fit, {from:.0} to {until:.0} s: {cause} ({figure}). What to do: {advice}.")
    };
    known.iter().map(sentence).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::flight::Flight;

    #[test]
    fn what_did_not_fit_is_worth_a_look_once_with_its_last_figure() {
        let misfit = |figure: &str| wh::Misfit {
            source: "ugv tag 1".into(),
            kind: "marker_size".into(),
            figure: figure.into(),
            cause: format!("tag 1 is wrong by {figure}"),
            advice: "measure it".into(),
        };
        let health = |misfits| wh::Health { misfits, ..wh::Health::default() };
        let health = vec![health(vec![]), health(vec![misfit("-4 %")]), health(vec![misfit("-5 %")])];
        let flight = Flight { health, ..Flight::default() };
        let page = section(&Context { flight: &flight, truth: None }, &Pictures::default());
        let body = page.expect("there is always a summary").body;
        assert!(
            body.contains("Worth a look") && body.contains("-5 %") && body.contains("measure it"),
            "{body}"
        );
        assert_eq!(body.matches("does not fit").count(), 1, "{body}");
    }
}
