//! One payload's part of the station's state, and its messages.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::{Value, json};
use windhover_base::geo::euler_321;
use windhover_base::time::{MonoTime, Span};

use crate::io::proto::{foxglove, host_time, windhover as wh};
use crate::text::finite;

use super::{NOTICES, Payload, Receiver, TARGETS, TRAIL, covariance, ms, status_name};

impl Payload {
    pub(super) fn estimate(&mut self, name: &str, state: wh::TargetState, live: bool) -> Option<Arc<str>> {
        let t = host_time(state.timestamp.as_ref());
        if self.targets.len() >= TARGETS && !self.targets.contains_key(&state.target) {
            return None;
        }
        let target = self.targets.entry(state.target.clone()).or_default();
        let mut message = json!({"k": "est", "p": name, "target": state.target, "t": ms(t),
            "status": status_name(&state, Span::ZERO), "live": live});
        if state.known {
            let figures = json!({"lat": state.lat_deg, "lon": state.lon_deg, "n": state.north_m,
                "e": state.east_m, "h": state.heading_rad, "v": state.speed_mps,
                "w": state.yaw_rate_radps, "cov": covariance(&state.covariance)});
            if let (Value::Object(message), Value::Object(figures)) = (&mut message, figures) {
                message.extend(figures);
            }
        }
        let text: Arc<str> = message.to_string().into();
        target.trail.insert(t.ns(), Arc::clone(&text));
        if target.trail.len() > TRAIL {
            target.trail.pop_first();
        }
        let newer = |old: &Option<wh::TargetState>| {
            old.as_ref().is_none_or(|old| host_time(old.timestamp.as_ref()) <= t)
        };
        if state.known {
            target.places.insert(t.ns(), (state.lat_deg, state.lon_deg));
            if target.places.len() > TRAIL {
                target.places.pop_first();
            }
            if newer(&target.known) {
                target.known = Some(state.clone());
            }
        }
        if newer(&target.latest) {
            target.latest = Some(state);
        }
        Some(text)
    }

    pub(super) fn ownship(&mut self, name: &str, own: &wh::Ownship) -> Option<Arc<str>> {
        let t = host_time(own.timestamp.as_ref());
        let quaternion = nalgebra::Quaternion::new(own.qw, own.qx, own.qy, own.qz);
        let attitude = nalgebra::UnitQuaternion::try_new(quaternion, 1e-9)?;
        let (heading, ..) = euler_321(&attitude.to_rotation_matrix());
        let text: Arc<str> =
            json!({"k": "own", "p": name, "t": ms(t), "lat": own.lat_deg, "lon": own.lon_deg,
            "heading": heading, "above": -own.down_m})
            .to_string()
            .into();
        if self.own.as_ref().is_none_or(|(last, _)| *last <= t.ns()) {
            self.own = Some((t.ns(), Arc::clone(&text)));
            self.own_state = Some(own.clone());
        }
        Some(text)
    }

    pub(super) fn health(&mut self, name: &str, health: &wh::Health) -> Option<Arc<str>> {
        let t = host_time(health.timestamp.as_ref());
        if let Some(ahead_ns) = health.utc_minus_host_ns {
            self.clock.reported_utc(Span::from_ns(ahead_ns));
        }
        let sources: Vec<Value> = health
            .sources
            .iter()
            .map(|s| {
                // Values that are not finite are shown as zero.
                let (rate_hz, age_ms) = (finite(s.rate_hz).unwrap_or(0.0), finite(s.age_ms).unwrap_or(-1.0));
                json!({"name": s.name, "rate_hz": rate_hz, "age_ms": age_ms, "refused": s.refused,
                    "dropped": s.dropped})
            })
            .collect();
        let misfits: Vec<Value> = health
            .misfits
            .iter()
            .map(|m| json!({"source": m.source, "figure": m.figure, "cause": m.cause, "advice": m.advice}))
            .collect();
        let figures: BTreeMap<&str, f64> = health
            .figures
            .iter()
            .filter(|(_, x)| x.is_finite())
            .map(|(name, x)| (name.as_str(), *x))
            .collect();
        if self.receiver.is_none_or(|(last, _)| last <= t) {
            let (hdop, geoid_m) = (health.hdop.and_then(finite), health.geoid_m.and_then(finite));
            self.receiver = Some((t, Receiver { fix: health.fix, sats: health.sats, hdop, geoid_m }));
        }
        let text: Arc<str> = json!({"k": "health", "p": name, "t": ms(t), "sources": sources,
            "fix": health.fix, "sats": health.sats, "clock_sigma_ms": finite(health.clock_sigma_ms),
            "misfits": misfits, "words": health.words, "figures": figures})
        .to_string()
        .into();
        if self.health.as_ref().is_none_or(|(last, _)| *last <= t.ns()) {
            self.health = Some((t.ns(), Arc::clone(&text)));
            self.health_reported = Some(health.clone());
        }
        Some(text)
    }

    pub(super) fn notice(&mut self, name: &str, log: &foxglove::Log) -> Option<Arc<str>> {
        let t = host_time(log.timestamp.as_ref());
        let level = u32::try_from(log.level).unwrap_or(0);
        let text =
            if log.name.is_empty() { log.message.clone() } else { format!("{}: {}", log.name, log.message) };
        Some(self.remark(name, t, level, &text))
    }

    pub(super) fn remark(&mut self, name: &str, t: MonoTime, level: u32, text: &str) -> Arc<str> {
        let message = json!({"k": "event", "p": name, "t": ms(t), "level": level, "text": text});
        let message: Arc<str> = message.to_string().into();
        self.notices.push_back(Arc::clone(&message));
        if self.notices.len() > NOTICES {
            self.notices.pop_front();
        }
        message
    }
}
