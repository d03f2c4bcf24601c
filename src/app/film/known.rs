//! States of the helicopter and the targets at each frame, from the records of a flight or of the running daemon.

use std::collections::BTreeMap;

use prost::Message as _;

use crate::io::proto::windhover::{Datum, Health, Ownship, TargetState, TrackStatus};
use crate::io::records::topic;
use windhover_base::geo::{Geodetic, LocalFrame};
use windhover_base::settings::TargetConfig;
use windhover_base::time::MonoTime;

/// Whether records of a topic are used.
pub fn is_of_film(name: &str) -> bool {
    matches!(name, topic::OWNSHIP | topic::DATUM | topic::HEALTH)
        || (name.starts_with("/target/") && name.ends_with("/state"))
}

/// What is known of frames.
#[derive(Debug, Default)]
pub struct Known {
    pub(super) own: BTreeMap<u32, Ownship>,
    pub(super) targets: BTreeMap<u32, Vec<TargetState>>,
    /// Numbers of targets, from 1.
    pub(super) ids: BTreeMap<String, u32>,
    pub(super) datum: Option<LocalFrame>,
    /// UTC less host time, nanoseconds, where the receiver reported the date.
    pub utc_minus_host_ns: Option<i64>,
    pub(super) geoid_m: Option<f64>,
}

impl Known {
    /// Nothing yet; the targets are numbered in this order.
    pub fn new(targets: &[TargetConfig]) -> Self {
        let ids = targets.iter().zip(1..).map(|(target, id)| (target.name.clone(), id)).collect();
        Self { ids, ..Self::default() }
    }

    /// Takes a record of one of the topics for which [`is_of_film`] holds; others are ignored.
    pub fn message(&mut self, name: &str, data: &[u8]) {
        match name {
            topic::OWNSHIP => self.ownship(Ownship::decode(data).ok()),
            topic::DATUM => {
                if let Some(d) = Datum::decode(data).ok().filter(Datum::is_sound) {
                    let at = Geodetic { lat_deg: d.lat_deg, lon_deg: d.lon_deg, height_m: d.height_m };
                    self.datum = Some(LocalFrame::new(at));
                }
            }
            topic::HEALTH => {
                let health = Health::decode(data).unwrap_or_default();
                self.utc_minus_host_ns = health.utc_minus_host_ns.or(self.utc_minus_host_ns);
                self.geoid_m = health.geoid_m.filter(|m| m.is_finite()).or(self.geoid_m);
            }
            _ if is_of_film(name) => self.target(TargetState::decode(data).ok()),
            _ => {}
        }
    }

    /// Forgets what is known of frames up to this one.
    pub fn forget(&mut self, frame: u32) {
        self.own.retain(|number, _| *number > frame);
        self.targets.retain(|number, _| *number > frame);
    }

    fn ownship(&mut self, own: Option<Ownship>) {
        if let Some(own) = own.filter(|own| own.is_sound() && !own.between_frames) {
            self.own.insert(own.frame, own);
        }
    }

    fn target(&mut self, state: Option<TargetState>) {
        let usable = |s: &TargetState| s.known && s.is_sound() && s.status() != TrackStatus::Lost;
        if let Some(state) = state.filter(usable) {
            self.targets.entry(state.frame).or_default().push(state);
        }
    }

    pub(super) fn unix_us(&self, t: MonoTime) -> u64 {
        let ns = t.ns().saturating_add(self.utc_minus_host_ns.unwrap_or(0));
        u64::try_from(ns.div_euclid(1_000)).unwrap_or(0)
    }
}
