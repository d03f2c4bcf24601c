//! Compares what a ground station received of a flight with the flight on the card:
//! `hil_stream FLIGHT STATION_FOLDER` prints one JSON object.
//!
//! The station's files of a run are those whose `run` files agree; the run is the one that has most in common with the
//! flight. A message is the same where topic, time and bytes are. Only topics that the station has are counted.
//! `only_received_since_ns` is the time of the first message that is on the ground and not on the card.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use windhover::io::mcap_read::{McapReader, RawMessage, ReadError};

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [flight, station] = args.as_slice() else {
        eprintln!("usage: hil_stream FLIGHT STATION_FOLDER");
        return ExitCode::from(2);
    };
    match compare(Path::new(flight), Path::new(station)) {
        Ok(figures) => {
            println!("{figures}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("hil_stream: {error}");
            ExitCode::FAILURE
        }
    }
}

/// How often each message is there, by time, topic and bytes.
type Messages = BTreeMap<(i64, String, Vec<u8>), u32>;

fn read(path: &Path, found: &mut Messages, wanted: impl Fn(&RawMessage) -> bool) -> Result<(), ReadError> {
    for raw in McapReader::open(path)?.filter(wanted) {
        *found.entry((raw.log_time.ns(), raw.channel.topic.clone(), raw.data)).or_default() += 1;
    }
    Ok(())
}

fn children(folder: &Path) -> Vec<PathBuf> {
    folder.read_dir().into_iter().flatten().flatten().map(|entry| entry.path()).collect()
}

/// What the station has, by run.
fn runs(station: &Path) -> Result<BTreeMap<String, Messages>, ReadError> {
    let mut runs = BTreeMap::<String, Messages>::new();
    for folder in children(station).iter().flat_map(|payload| children(payload)) {
        if let Ok(run) = std::fs::read_to_string(folder.join("run")) {
            read(&folder, runs.entry(run).or_default(), |_| true)?;
        }
    }
    Ok(runs)
}

fn compare(flight: &Path, station: &Path) -> Result<serde_json::Value, ReadError> {
    let mut flown = Messages::new();
    read(flight, &mut flown, |_| true)?;
    let common = |run: &Messages| run.keys().filter(|message| flown.contains_key(*message)).count();
    let received = runs(station)?.into_values().max_by_key(common).unwrap_or_default();
    let topics: BTreeSet<&str> = received.keys().map(|(_, topic, _)| topic.as_str()).collect();
    flown.retain(|(_, topic, _), _| topics.contains(topic.as_str()));
    let only_received: Vec<i64> = received.keys().filter(|m| !flown.contains_key(*m)).map(|m| m.0).collect();
    let only_flown: Vec<i64> = flown.keys().filter(|m| !received.contains_key(*m)).map(|m| m.0).collect();
    Ok(serde_json::json!({
        "topics": topics.len(),
        "flown": flown.values().sum::<u32>(),
        "received": received.values().sum::<u32>(),
        "received_twice": received.iter().filter(|(m, count)| flown.get(*m).is_some_and(|f| f < *count)).count(),
        "only_flown": only_flown.len(),
        "only_flown_since_ns": only_flown.first(),
        "only_received": only_received.len(),
        "only_received_since_ns": only_received.first(),
        "last_flown_ns": flown.keys().next_back().map(|m| m.0),
        "last_received_ns": received.keys().next_back().map(|m| m.0),
    }))
}
