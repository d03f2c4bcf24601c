//! Making room: which flights are deleted, oldest first; never the current one, never one marked `keep`.

use std::path::Path;

use super::flight::{self, FLIGHTS, FlightInfo};
use super::volume::{StoreResult, Volume};
use crate::config::StoreConfig;
use windhover_base::time::UtcTime;

/// Orders flights by age: by run of the daemon, which counts up independently of the clock; by name where the run is
/// not known.
pub fn age_order(root: &Path, name: &str) -> (u32, String) {
    (flight::session_of(&root.join(FLIGHTS).join(name)).unwrap_or(0), name.to_owned())
}

/// Start of a flight, from its name; `None` for `boot-N`.
pub fn start_of(name: &str) -> Option<UtcTime> {
    let field = |from: usize, to: usize| name.get(from..to)?.parse::<u32>().ok();
    UtcTime::from_civil(windhover_base::time::Civil {
        year: i32::try_from(field(0, 4)?).ok()?,
        month: field(4, 6)? as u8,
        day: field(6, 8)? as u8,
        hour: field(9, 11)? as u8,
        minute: field(11, 13)? as u8,
        second: field(13, 15)? as u8,
        nanosecond: 0,
    })
}

/// Bytes that must be free: as configured, but at most a tenth of the card, so that a small card is not emptied.
pub fn wanted_free(config: &StoreConfig, capacity: u64) -> u64 {
    (config.free_target_mb << 20).min(capacity / 10)
}

/// The flights to delete, oldest first, with the reasons. `free` and `wanted` in bytes; `present` is the current run,
/// which is kept; ages are relative to `now`, the start of the current flight by the receiver, and ignored where it is
/// not known.
pub fn doomed(
    flights: &[FlightInfo],
    present: Option<u32>,
    config: &StoreConfig,
    (free, wanted): (u64, u64),
    now: Option<UtcTime>,
) -> Vec<(FlightInfo, String)> {
    let mut total: u64 = flights.iter().map(|f| f.bytes).sum();
    let mut free = free;
    let limit = (config.max_gb * 1e9) as u64;
    let mut gone = Vec::new();
    for flight in flights.iter().filter(|f| !f.keep && Some(f.session) != present) {
        let age_days = now
            .zip(start_of(&flight.name))
            .map(|(now, start)| (now.unix_ns() - start.unix_ns()) as f64 / 86_400e9);
        let reason = if config.max_age_days > 0.0 && age_days.is_some_and(|days| days > config.max_age_days) {
            format!("older than {} days", config.max_age_days)
        } else if free < wanted {
            format!("to have {} MB free", wanted >> 20)
        } else if limit > 0 && total > limit {
            format!("all flights together took more than {} GB", config.max_gb)
        } else {
            continue;
        };
        total -= flight.bytes;
        free += flight.bytes;
        gone.push((flight.clone(), reason));
    }
    gone
}

/// Deletes flights; returns which, and why.
pub fn make_room(
    volume: &Volume,
    config: &StoreConfig,
    present: Option<u32>,
    now: Option<UtcTime>,
) -> StoreResult<Vec<(FlightInfo, String)>> {
    let (free, total) = volume.space()?;
    let wanted = wanted_free(config, total);
    if free >= wanted && config.max_gb <= 0.0 && (config.max_age_days <= 0.0 || now.is_none()) {
        return Ok(Vec::new());
    }
    let mut flights = Vec::new();
    for name in flight::flight_names(volume.root())? {
        flights.push(flight::flight_info(volume.root(), &name)?);
    }
    flights.sort_by(|a, b| (a.session, &a.name).cmp(&(b.session, &b.name)));
    let mut gone = Vec::new();
    for (info, reason) in doomed(&flights, present, config, (free, wanted), now) {
        // It may have been marked since.
        if flight::flight_info(volume.root(), &info.name).is_ok_and(|now| now.keep) {
            continue;
        }
        flight::delete(volume, &info.name)?;
        gone.push((info, reason));
    }
    Ok(gone)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flights() -> Vec<FlightInfo> {
        let flight = |session: u32, name: &str, gb: u64, keep: bool| FlightInfo {
            session,
            name: name.into(),
            bytes: gb << 30,
            keep,
            ..FlightInfo::default()
        };
        vec![
            flight(1, "boot-1", 1, false),
            flight(2, "20261101T100000Z", 2, true),
            flight(3, "20261110T100000Z", 2, false),
            flight(4, "20261120T100000Z", 2, false),
            flight(5, "boot-5", 9, false),
        ]
    }

    fn names(config: &StoreConfig, free: u64, now: Option<UtcTime>) -> Vec<String> {
        let wanted = wanted_free(config, 1 << 40);
        let gone = doomed(&flights(), Some(5), config, (free, wanted), now);
        gone.into_iter().map(|(f, _)| f.name).collect()
    }

    #[test]
    fn the_oldest_go_first_and_only_as_many_as_needed() {
        let config = StoreConfig { free_target_mb: 2048, ..StoreConfig::default() };
        assert_eq!(names(&config, 4 << 30, None), [""; 0]);
        assert_eq!(names(&config, (2 << 30) - 1, None), ["boot-1"]);
        assert_eq!(names(&config, 0, None), ["boot-1", "20261110T100000Z"]);
        let none_left = StoreConfig { free_target_mb: 1 << 20, ..config };
        assert_eq!(names(&none_left, 0, None), ["boot-1", "20261110T100000Z", "20261120T100000Z"]);
    }

    #[test]
    fn a_small_card_is_not_emptied() {
        let config = StoreConfig { free_target_mb: 1024, ..StoreConfig::default() };
        assert_eq!(wanted_free(&config, 512 << 20), (512 << 20) / 10);
        assert_eq!(wanted_free(&config, 64 << 30), 1024 << 20);
    }

    #[test]
    fn age_counts_only_where_both_dates_are_known() {
        let config = StoreConfig { free_target_mb: 0, max_age_days: 7.0, ..StoreConfig::default() };
        let now = start_of("20261122T000000Z");
        assert!(now.is_some());
        assert_eq!(names(&config, 0, now), ["20261110T100000Z"]);
        assert_eq!(names(&config, 0, None), [""; 0]);
    }

    #[test]
    fn all_together_stay_within_their_share() {
        let config = StoreConfig { free_target_mb: 0, max_gb: 15.5, ..StoreConfig::default() };
        assert_eq!(names(&config, 0, None), ["boot-1", "20261110T100000Z"]);
    }
}
