//! Flights as directories: their names, their marks, and their descriptions.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::scan::SegmentFile;
use super::summary::TopicStats;
use super::volume::{StoreError, StoreResult, Volume};
use windhover_base::time::UtcTime;

/// Directory of all flights, under the store's path.
pub const FLIGHTS: &str = "FLIGHTS";

/// A file of this name in a flight keeps it from being deleted to make room.
pub const KEEP: &str = "keep";

/// Description of a closed flight, so that lists need not open its segments.
pub const FLIGHT_FILE: &str = "flight.json";

/// Description of a flight on the card. `flight.json` contains it; it can be made again from the segments.
#[derive(Clone, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
pub struct FlightInfo {
    /// Number of the daemon's run on this card, counting up.
    pub session: u32,
    /// Name of the directory.
    #[serde(skip)]
    pub name: String,
    /// Whether it is protected from deletion.
    #[serde(skip)]
    pub keep: bool,
    /// Whether it was closed properly or sealed; one that is not is being recorded, or was cut.
    pub closed: bool,
    /// Number of segments.
    pub segments: u32,
    /// Bytes of all segments.
    pub bytes: u64,
    /// Segments that had to be repaired.
    pub repaired: u32,
    /// Versions of program and models, and the other metadata of the head.
    pub metadata: BTreeMap<String, String>,
    /// Counts and times by topic.
    pub topics: BTreeMap<String, TopicStats>,
}

impl FlightInfo {
    /// Log time of the first and the last message, ns.
    pub fn span_ns(&self) -> Option<(u64, u64)> {
        let first = self.topics.values().map(|t| t.first_ns).min()?;
        let last = self.topics.values().map(|t| t.last_ns).max()?;
        Some((first, last))
    }

    /// Counts and times of the estimates: topics `/target/NAME/state`.
    pub fn estimates(&self) -> Option<TopicStats> {
        let mut all: Option<TopicStats> = None;
        for (_, stats) in self.topics.iter().filter(|(topic, _)| is_estimate(topic)) {
            let joined = all.get_or_insert(*stats);
            if joined != stats {
                joined.count += stats.count;
                joined.first_ns = joined.first_ns.min(stats.first_ns);
                joined.last_ns = joined.last_ns.max(stats.last_ns);
            }
        }
        all
    }
}

/// Whether a topic contains estimates of a target.
pub fn is_estimate(topic: &str) -> bool {
    topic.starts_with("/target/") && topic.ends_with("/state")
}

/// Whether a directory name is a flight's: `YYYYMMDDTHHMMSSZ` with an optional `-N`, or `boot-N`.
pub fn is_flight_name(name: &str) -> bool {
    let digits = |s: &str| !s.is_empty() && s.bytes().all(|b| b.is_ascii_digit());
    if let Some(number) = name.strip_prefix("boot-") {
        return number.split('-').all(digits);
    }
    let (stamp, suffix) = name.split_once('-').map_or((name, None), |(a, b)| (a, Some(b)));
    let stamped = stamp.len() == 16
        && digits(&stamp[..8])
        && &stamp[8..9] == "T"
        && digits(&stamp[9..15])
        && stamp.ends_with('Z');
    stamped && suffix.is_none_or(digits)
}

/// Names of a flight's segments, in order.
pub fn segment_names(dir: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(dir)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .filter(|name| {
            name.strip_suffix(".mcap").is_some_and(|n| n.len() == 6 && n.bytes().all(|b| b.is_ascii_digit()))
        })
        .collect();
    names.sort_unstable();
    names
}

/// Name of segment `number`.
pub fn segment_name(number: u32) -> String {
    format!("{number:06}.mcap")
}

/// Names of all flights on the card, unsorted.
pub fn flight_names(root: &Path) -> StoreResult<Vec<String>> {
    let dir = root.join(FLIGHTS);
    let entries = match std::fs::read_dir(&dir) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        other => other.map_err(|e| StoreError::new("read directory", &dir, e))?,
    };
    let names = entries.flatten().map(|e| e.file_name().to_string_lossy().into_owned());
    Ok(names.filter(|name| is_flight_name(name)).collect())
}

/// Makes the directory of a new flight, durably; returns its name.
pub fn create_flight(volume: &Volume, session: u32, start: Option<UtcTime>) -> StoreResult<String> {
    volume.ensure_dir(FLIGHTS, "")?;
    let base = start.map_or_else(|| format!("boot-{session}"), UtcTime::compact);
    for n in 1.. {
        let name = if n == 1 { base.clone() } else { format!("{base}-{n}") };
        match volume.create_dir(&format!("{FLIGHTS}/{name}")) {
            Err(e) if e.source.kind() == std::io::ErrorKind::AlreadyExists && n < 10_000 => {}
            Err(e) => return Err(e),
            Ok(()) => {
                volume.sync_dir(FLIGHTS)?;
                return Ok(name);
            }
        }
    }
    unreachable!("the loop ends by returning")
}

/// Gives a flight called `boot-N` the name of its start. One rename within one directory: a power cut leaves the old
/// name or the new one, and open segments stay open. (A hard link would leave two names, and vfat has none.)
pub fn name_flight(volume: &Volume, name: &str, start: UtcTime) -> StoreResult<String> {
    let base = start.compact();
    for n in 1..10_000 {
        let new = if n == 1 { base.clone() } else { format!("{base}-{n}") };
        if volume.rename_new(&format!("{FLIGHTS}/{name}"), &format!("{FLIGHTS}/{new}"))? {
            volume.sync_dir(FLIGHTS)?;
            return Ok(new);
        }
    }
    Ok(name.to_owned())
}

/// The content of `flight.json`, or of the segments where there is none.
pub fn flight_info(root: &Path, name: &str) -> StoreResult<FlightInfo> {
    let dir = root.join(FLIGHTS).join(name);
    let stored = std::fs::read(dir.join(FLIGHT_FILE)).ok();
    let stored = stored.and_then(|bytes| serde_json::from_slice::<FlightInfo>(&bytes).ok());
    let mut info = match stored {
        Some(info) => info,
        None => summarize(&dir)?,
    };
    name.clone_into(&mut info.name);
    info.keep = dir.join(KEEP).exists();
    Ok(info)
}

/// The description from the segments, without reading messages of sealed ones.
pub fn summarize(dir: &Path) -> StoreResult<FlightInfo> {
    let mut info = FlightInfo { closed: true, ..FlightInfo::default() };
    for name in segment_names(dir) {
        let segment = SegmentFile::open(&dir.join(&name))?;
        info.segments += 1;
        info.bytes += segment.len();
        let (metadata, topics) = match segment.sealed() {
            Some(sealed) => (sealed.metadata, sealed.topics),
            None => {
                info.closed = false;
                let salvage = segment.salvage();
                let topics = salvage.topics();
                (salvage.metadata.unwrap_or_default(), topics)
            }
        };
        for (topic, stats) in &topics {
            info.topics.entry(topic.clone()).or_default().join(stats);
        }
        if let Some(session) = metadata.get("session").and_then(|s| s.parse().ok()) {
            info.session = session;
        }
        if info.metadata.is_empty() {
            info.metadata = metadata;
        }
    }
    Ok(info)
}

/// The run of the daemon a flight belongs to, from `flight.json` or any segment's head.
pub fn session_of(dir: &Path) -> Option<u32> {
    let stored = std::fs::read(dir.join(FLIGHT_FILE)).ok();
    if let Some(info) = stored.and_then(|bytes| serde_json::from_slice::<FlightInfo>(&bytes).ok()) {
        return Some(info.session);
    }
    segment_names(dir).iter().find_map(|name| {
        let head = SegmentFile::open(&dir.join(name)).ok()?.salvage_head_only();
        head.metadata?.get("session")?.parse().ok()
    })
}

/// Writes `flight.json`, durably.
pub fn write_info(volume: &Volume, name: &str, info: &FlightInfo) -> StoreResult<()> {
    let mut bytes = serde_json::to_vec_pretty(info).expect("maps with string keys are valid JSON");
    bytes.push(b'\n');
    volume.write_whole(&format!("{FLIGHTS}/{name}"), FLIGHT_FILE, &bytes)
}

/// Sets or removes the mark that protects a flight.
pub fn set_keep(volume: &Volume, name: &str, keep: bool) -> StoreResult<()> {
    let dir = format!("{FLIGHTS}/{name}");
    let mark = format!("{dir}/{KEEP}");
    if keep == volume.path(&mark).exists() {
        return Ok(());
    }
    if keep {
        volume.create(&mark)?.sync()?
    } else {
        volume.remove_file(&mark)?
    }
    volume.sync_dir(&dir)
}

/// Deletes a flight, durably. A rename first removes it from the list: a power cut in the middle leaves something that
/// [`sweep`] removes, never part of a flight.
pub fn delete(volume: &Volume, name: &str) -> StoreResult<()> {
    let doomed = format!("{FLIGHTS}/{name}.deleted");
    volume.replace(&format!("{FLIGHTS}/{name}"), &doomed)?;
    volume.sync_dir(FLIGHTS)?;
    volume.remove_dir(&doomed)?;
    volume.sync_dir(FLIGHTS)
}

/// Removes the remains of an interrupted delete, seal or write.
pub fn sweep(volume: &Volume) -> StoreResult<()> {
    let dir = volume.path(FLIGHTS);
    for entry in std::fs::read_dir(&dir).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.ends_with(".deleted") {
            volume.remove_dir(&format!("{FLIGHTS}/{name}"))?;
        } else if is_flight_name(&name) {
            for left in std::fs::read_dir(entry.path()).into_iter().flatten().flatten() {
                let left = left.file_name().to_string_lossy().into_owned();
                if left.ends_with(".tmp") || left.ends_with(".repair") {
                    volume.remove_file(&format!("{FLIGHTS}/{name}/{left}"))?;
                }
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flight_names_are_distinguished_from_others() {
        for name in ["20261122T074438Z", "20261122T074438Z-2", "boot-7", "boot-7-2"] {
            assert!(is_flight_name(name), "{name}");
        }
        for name in
            ["lost+found", "20261122", "20261122T074438Z-", "boot-", "boot-x", "a.deleted", "é0261122T07443Z"]
        {
            assert!(!is_flight_name(name), "{name}");
        }
    }

    #[test]
    fn a_flight_gets_its_name_and_never_anothers() {
        let dir = tempfile::tempdir().expect("a directory");
        let volume = Volume::new(dir.path());
        let start = UtcTime::from_unix_ns(1_795_000_000_000_000_000);
        let first = create_flight(&volume, 1, Some(start)).expect("creates");
        let second = create_flight(&volume, 2, None).expect("creates");
        assert_eq!((first.as_str(), second.as_str()), ("20261118T110640Z", "boot-2"));
        assert_eq!(name_flight(&volume, &second, start).expect("renames"), "20261118T110640Z-2");
        assert_eq!(create_flight(&volume, 2, None).expect("creates"), "boot-2");
        assert_eq!(create_flight(&volume, 2, None).expect("creates"), "boot-2-2");
    }
}
