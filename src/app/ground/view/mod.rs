//! The station's state of each payload, and the messages for its web page.

mod payload;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use prost::Message as _;
use serde_json::{Value, json};
use tokio::time::Instant;

use crate::app::openmetrics::{self, PayloadMetrics};
use crate::io::link::{Arrival, PayloadStatus};
use crate::io::proto::{foxglove, host_time, link::Thumbnail, windhover as wh};
use crate::io::records::topic;
use windhover_base::time::{MonoTime, NS_PER_S, Span, UtcTime};

use crate::app::ground::freshness::{CURRENT, PayloadClock, status_at};

/// Estimates kept for pages that are opened later: ten minutes at 15 Hz.
const TRAIL: usize = 9_000;
/// Targets of a payload that are shown; the recorded flight has all of them.
const TARGETS: usize = 64;
/// Notices kept for pages that are opened later.
const NOTICES: usize = 60;

/// What the payload's receiver reports about its fix.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Receiver {
    /// 0 none, 2 two-dimensional, 3 three-dimensional.
    pub fix: u32,
    /// Satellites used.
    pub sats: u32,
    /// Horizontal dilution of precision.
    pub hdop: Option<f64>,
    /// Geoid over ellipsoid, metres.
    pub geoid_m: Option<f64>,
}

/// The last known state of a vehicle.
#[derive(Clone, Debug)]
pub struct Vehicle {
    /// Name of the payload.
    pub payload: String,
    /// Name of the target.
    pub target: String,
    /// Its latest known state.
    pub state: wh::TargetState,
    /// Its status at present.
    pub status: &'static str,
    /// Age of that state.
    pub age: Span,
    /// UTC of that state, where the payload's receiver reported UTC.
    pub utc: Option<UtcTime>,
    /// The present report of the payload's receiver; `None` where it has reported nothing for seconds.
    pub receiver: Option<Receiver>,
    /// Latitude and longitude over time, oldest first.
    pub trail: Vec<(MonoTime, f64, f64)>,
}

impl Vehicle {
    /// Whether its state is a current position; else it is the last known place and does not state where the vehicle
    /// is.
    pub fn is_current(&self) -> bool {
        self.status != "lost"
    }
}

/// The last known state of a helicopter.
#[derive(Clone, Debug)]
pub struct Helicopter {
    /// Name of the payload.
    pub payload: String,
    /// Its own state.
    pub state: wh::Ownship,
    /// Age of that state.
    pub age: Span,
    /// UTC of that state, where the payload's receiver reported UTC.
    pub utc: Option<UtcTime>,
}

#[derive(Default)]
struct Target {
    latest: Option<wh::TargetState>,
    known: Option<wh::TargetState>,
    trail: BTreeMap<i64, Arc<str>>,
    places: BTreeMap<i64, (f64, f64)>,
}

#[derive(Default)]
struct Payload {
    targets: BTreeMap<String, Target>,
    own: Option<(i64, Arc<str>)>,
    own_state: Option<wh::Ownship>,
    health: Option<(i64, Arc<str>)>,
    health_reported: Option<wh::Health>,
    linked: Option<(bool, f64)>,
    datum: Option<Arc<str>>,
    notices: VecDeque<Arc<str>>,
    thumbnail: Option<(Arc<str>, Arc<[u8]>)>,
    clock: PayloadClock,
    receiver: Option<(MonoTime, Receiver)>,
    live: (u64, u64),
    live_hz: f64,
    kbps: f64,
}

/// Everything that pages show, by payload.
#[derive(Default)]
pub struct View {
    payloads: BTreeMap<String, Payload>,
    /// The link's state when it was last sent.
    link: Option<Arc<str>>,
}

fn ms(t: MonoTime) -> f64 {
    t.ns() as f64 * 1e-6
}

/// The name of a state's status at an age.
fn status_name(state: &wh::TargetState, age: Span) -> &'static str {
    status_at(state.status(), age)
}

/// (nn, ne, ee, hh, vv, ww) of the covariance's upper triangle; `null` without one.
fn covariance(p: &[f64]) -> Value {
    match p {
        [nn, ne, _, _, _, ee, _, _, _, hh, _, _, vv, _, ww] => json!([nn, ne, ee, hh, vv, ww]),
        _ => Value::Null,
    }
}

impl View {
    /// Takes a record; returns the message for the pages, where there is one.
    pub fn record(&mut self, arrival: &Arrival) -> Option<Arc<str>> {
        let name = arrival.payload.to_string();
        let payload = self.payloads.entry(name.clone()).or_default();
        payload.clock.received(arrival.publish_time, arrival.arrived);
        let data = &arrival.data[..];
        match arrival.channel.schema_name.as_str() {
            // The smoother's and the paper's states have schemas of the same name on other topics.
            "windhover.TargetState" if topic::is_target_now(&arrival.channel.topic) => {
                let state = wh::TargetState::decode(data).ok().filter(wh::TargetState::is_sound)?;
                payload.estimate(&name, state, arrival.live)
            }
            "windhover.Ownship" => {
                payload.ownship(&name, &wh::Ownship::decode(data).ok().filter(wh::Ownship::is_sound)?)
            }
            "windhover.Health" => payload.health(&name, &wh::Health::decode(data).ok()?),
            "windhover.Datum" => {
                let datum = wh::Datum::decode(data).ok().filter(wh::Datum::is_sound)?;
                let text = json!({"k": "datum", "p": name, "lat": datum.lat_deg, "lon": datum.lon_deg});
                payload.datum = Some(text.to_string().into());
                payload.datum.clone()
            }
            "foxglove.Log" => payload.notice(&name, &foxglove::Log::decode(data).ok()?),
            _ => None,
        }
    }

    /// Takes a thumbnail; returns the message for the pages.
    pub fn thumbnail(&mut self, name: &str, thumbnail: Thumbnail) -> Arc<str> {
        let found = wh::Detections::decode(&thumbnail.detections[..]).unwrap_or_default();
        let is_sound = |m: &&wh::Marker| {
            let figures = [m.center_u, m.center_v, m.size_px];
            figures.iter().chain(&m.corners).all(|figure| figure.is_finite())
        };
        let markers: Vec<Value> = found
            .markers
            .iter()
            .filter(is_sound)
            .map(|m| {
                json!({"id": format!("{} {}", m.family, m.id).trim(), "u": m.center_u, "v": m.center_v,
                    "corners": m.corners, "size": m.size_px})
            })
            .collect();
        let text: Arc<str> = json!({"k": "thumb", "p": name, "frame": thumbnail.frame,
            "t": ms(MonoTime::from_ns(thumbnail.time_ns)), "w": thumbnail.width, "h": thumbnail.height,
            "markers": markers})
        .to_string()
        .into();
        let payload = self.payloads.entry(name.to_owned()).or_default();
        payload.thumbnail = Some((Arc::clone(&text), thumbnail.jpeg.into()));
        text
    }

    /// The latest thumbnail of a payload, JPEG.
    pub fn picture(&self, payload: &str) -> Option<Arc<[u8]>> {
        self.payloads.get(payload)?.thumbnail.as_ref().map(|(_, jpeg)| Arc::clone(jpeg))
    }

    /// Takes the link's state; returns the message for the pages. `passed_s` is the time since the last call.
    pub fn link(&mut self, status: &[PayloadStatus], passed_s: f64, now: Instant) -> Arc<str> {
        let payloads: Vec<Value> = status
            .iter()
            .map(|s| {
                let payload = self.payloads.entry(s.name.clone()).or_default();
                // A new connection counts from zero again.
                let grown = |now: u64, before: u64| now.checked_sub(before).unwrap_or(now) as f64;
                payload.live_hz = grown(s.live, payload.live.0) / passed_s.max(0.1);
                payload.kbps = grown(s.bytes, payload.live.1) * 8e-3 / passed_s.max(0.1);
                payload.live = (s.live, s.bytes);
                payload.linked = Some((s.connected, s.rtt_ms));
                let (at, utc_ms) = (payload.clock.at(now).map(ms), payload.clock.utc_minus_host_ms());
                json!({"name": s.name, "up": s.connected, "now": at, "utc_ms": utc_ms, "address": s.address.to_string(),
                    "rtt_ms": s.rtt_ms, "silent_ms": s.silent.as_millis() as u64, "software": s.software,
                    "received": s.progress.received, "missing": s.progress.missing,
                    "overdue": s.progress.overdue,
                    "gone": s.progress.gone, "live_hz": payload.live_hz, "kbps": payload.kbps})
            })
            .collect();
        let text: Arc<str> = json!({"k": "link", "payloads": payloads}).to_string().into();
        self.link = Some(Arc::clone(&text));
        text
    }

    /// Takes a notice of the station itself about a payload.
    pub fn remark(&mut self, name: &str, t: MonoTime, level: u32, text: &str) -> Arc<str> {
        self.payloads.entry(name.to_owned()).or_default().remark(name, t, level, text)
    }

    /// Everything that a newly opened page needs.
    pub fn history(&self) -> Vec<Arc<str>> {
        let mut all = Vec::new();
        for payload in self.payloads.values() {
            all.extend(payload.datum.clone());
            for target in payload.targets.values() {
                all.extend(target.trail.values().cloned());
            }
            all.extend(payload.own.iter().map(|(_, text)| Arc::clone(text)));
            all.extend(payload.health.iter().map(|(_, text)| Arc::clone(text)));
            all.extend(payload.notices.iter().cloned());
            all.extend(payload.thumbnail.iter().map(|(text, _)| Arc::clone(text)));
        }
        // Last: it gives the age of everything before it.
        all.extend(self.link.clone());
        all
    }

    /// Every vehicle that ever had a known position, in its present state.
    pub fn vehicles(&self, now: Instant) -> Vec<Vehicle> {
        let of = |(payload, p): (&String, &Payload)| -> Vec<Vehicle> {
            let receiver = p.receiver.filter(|(t, _)| p.clock.age(*t, now) <= CURRENT).map(|(_, said)| said);
            let known = |(target, t): (&String, &Target)| {
                let places = t.places.iter();
                let (state, latest) = (t.known.clone()?, t.latest.as_ref()?);
                let at = |state: &wh::TargetState| host_time(state.timestamp.as_ref());
                Some(Vehicle {
                    payload: payload.clone(),
                    target: target.clone(),
                    status: status_name(latest, p.clock.age(at(latest), now)),
                    age: p.clock.age(at(&state), now),
                    utc: p.clock.utc(at(&state)),
                    receiver,
                    state,
                    trail: places.map(|(ns, (lat, lon))| (MonoTime::from_ns(*ns), *lat, *lon)).collect(),
                })
            };
            p.targets.iter().filter_map(known).collect()
        };
        self.payloads.iter().flat_map(of).collect()
    }

    /// Every helicopter with a current position.
    pub fn helicopters(&self, now: Instant) -> Vec<Helicopter> {
        let of = |(name, p): (&String, &Payload)| {
            let state = p.own_state.clone()?;
            let t = host_time(state.timestamp.as_ref());
            let age = p.clock.age(t, now);
            (age <= CURRENT).then(|| Helicopter { payload: name.clone(), age, utc: p.clock.utc(t), state })
        };
        self.payloads.iter().filter_map(of).collect()
    }

    /// The health of every payload as OpenMetrics.
    pub fn metrics(&self, now: Instant) -> String {
        let reported = self.payloads.iter().filter_map(|(payload, p)| {
            let health = p.health_reported.as_ref()?;
            let age_s = Some(p.clock.age(host_time(health.timestamp.as_ref()), now).s());
            Some(PayloadMetrics { payload, health, age_s, link: p.linked })
        });
        openmetrics::render(&reported.collect::<Vec<_>>())
    }

    /// One line for each payload, for a terminal.
    pub fn line(&self, status: &PayloadStatus, now: Instant) -> String {
        let payload = self.payloads.get(&status.name);
        let link = match (status.connected, status.silent.as_secs_f64()) {
            (false, _) => "down".to_owned(),
            (true, silent) if silent > 2.0 => format!("silent {silent:.0} s"),
            _ => "up".to_owned(),
        };
        let mut line = format!("{:12} {link:10}", status.name);
        for (name, target) in payload.iter().flat_map(|p| &p.targets) {
            let Some(latest) = &target.latest else { continue };
            let age_of = |state: &wh::TargetState| {
                payload.map_or(Span::ZERO, |p| p.clock.age(host_time(state.timestamp.as_ref()), now))
            };
            let shown = status_name(latest, age_of(latest));
            line += &format!(" {name} {shown}");
            if let ("lost", Some(known)) = (shown, &target.known) {
                line += &format!(", last known {:.0} s ago", age_of(known).s());
            } else if latest.known {
                line += &format!(
                    " N {:.2} E {:.2} m, {:.0}°, {:.2} m/s, {:.1}°/s",
                    latest.north_m,
                    latest.east_m,
                    latest.heading_rad.to_degrees().rem_euclid(360.0),
                    latest.speed_mps,
                    latest.yaw_rate_radps.to_degrees()
                );
            }
        }
        let (live_hz, kbps) = payload.map_or((0.0, 0.0), |p| (p.live_hz, p.kbps));
        let progress = status.progress;
        line += &format!(
            " | {live_hz:.0}/s live, {kbps:.0} kbit/s, rtt {:.1} ms | {} stored, {} missing",
            status.rtt_ms, progress.received, progress.overdue
        );
        if progress.gone > 0 {
            line += &format!(", {} lost on board", progress.gone);
        }
        line
    }
}

/// UTC as `hhmmss.ss` and `ddmmyy`; empty where it is not known.
pub fn nmea_time(utc: Option<UtcTime>) -> (String, String) {
    let Some(civil) = utc.map(UtcTime::civil) else { return Default::default() };
    let hundredths = i64::from(civil.nanosecond) / (NS_PER_S / 100);
    (
        format!("{:02}{:02}{:02}.{hundredths:02}", civil.hour, civil.minute, civil.second),
        format!("{:02}{:02}{:02}", civil.day, civil.month, civil.year.rem_euclid(100)),
    )
}
