//! What a station received, on its disk: the payload's flights as MCAP segments, each record once.
//!
//! A flight is the directory `PAYLOAD/FLIGHT/` with segments `000000.mcap`, …; a record's number in its run
//! is the MCAP message's sequence, so that a restarted station knows from the files alone what it has.

mod segment;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use prost::Message as _;

use crate::io::link::{Arrival, RangeSet};
use crate::io::mcap_read::{McapReader, RawMessage};
use crate::io::proto::windhover as wh;
use crate::io::store::flight::is_flight_name;
use segment::Segment;

/// File in a flight's directory that holds the number of its run.
pub(super) const RUN_FILE: &str = "run";
/// The field of health messages that names the flight on the payload's card.
const FLIGHT_WORD: &str = "flight";
/// Prefix of the name of a flight without a date.
const UNDATED: &str = "boot-";
/// A segment ends at this many bytes of messages.
const SEGMENT_BYTES: u64 = 64 << 20;
/// Segments that one payload has open at a time: of the current run, and of those being filled.
const OPEN: usize = 4;

/// Why something could not be stored.
#[derive(Debug, thiserror::Error)]
pub enum MirrorError {
    /// The system's refusal.
    #[error("cannot write {}: {source}", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The MCAP writer refused.
    #[error("cannot write {}: {source}", path.display())]
    Mcap {
        /// The file.
        path: PathBuf,
        /// Its error.
        source: mcap::McapError,
    },
    /// The file no longer exists.
    #[error("{} was removed while it was written", path.display())]
    Removed {
        /// The file.
        path: PathBuf,
    },
    /// More channels, or longer schemas, than any payload has.
    #[error("{}: more channels and schemas than the limit", path.display())]
    Overfull {
        /// The file.
        path: PathBuf,
    },
}

/// Numbers of a payload's run that are on disk now.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct OnDisk {
    /// Name of the payload.
    pub payload: String,
    /// The run.
    pub run: u32,
    /// The numbers.
    pub numbers: RangeSet,
}

/// The result for what was given to a mirror since the last sync.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Kept {
    /// On the disk now.
    pub done: Vec<OnDisk>,
    /// Not on the disk, or no longer there: to be received again.
    pub lost: Vec<OnDisk>,
    /// An error of the disk; it is tried again.
    pub trouble: Option<String>,
    /// Payloads that sent more than the limit, and of what.
    pub excess: BTreeMap<String, String>,
}

/// Writes what arrives under one directory. It never fails: what cannot be written is reported, and tried again after
/// the next sync.
pub struct Mirror {
    root: PathBuf,
    open: BTreeMap<(String, u32), Segment>,
    turn: u64,
    done: Vec<OnDisk>,
    lost: BTreeMap<(String, u32), RangeSet>,
    trouble: Option<String>,
    excess: BTreeMap<String, String>,
}

fn io_error(path: &Path) -> impl FnOnce(std::io::Error) -> MirrorError + '_ {
    move |source| MirrorError::Io { path: path.to_owned(), source }
}

impl Mirror {
    /// A mirror under `root`, which is made when needed.
    ///
    /// # Errors
    /// It cannot be made.
    pub fn at(root: impl Into<PathBuf>) -> Result<Self, MirrorError> {
        let root = root.into();
        std::fs::create_dir_all(&root).map_err(io_error(&root))?;
        let (open, lost, excess) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        Ok(Self { root, open, turn: 0, done: Vec::new(), lost, trouble: None, excess })
    }

    /// Stores a record; it is on disk after the next [`Mirror::sync`] that does not report it as lost.
    pub fn keep(&mut self, arrival: &Arrival) {
        let key = (arrival.payload.to_string(), arrival.run);
        if self.trouble.is_some() {
            // One attempt for each sync is enough for a disk that fails.
            return self.lose(key, RangeSet::of(arrival.number, arrival.number.saturating_add(1)));
        }
        match self.write(&key, arrival) {
            Ok(()) => {}
            Err(error @ MirrorError::Overfull { .. }) => {
                self.excess.insert(key.0, error.to_string());
            }
            Err(error) => {
                self.lose(key.clone(), RangeSet::of(arrival.number, arrival.number.saturating_add(1)));
                self.fail(key, &error);
            }
        }
    }

    fn write(&mut self, key: &(String, u32), arrival: &Arrival) -> Result<(), MirrorError> {
        if !self.open.contains_key(key) {
            self.make_room(&key.0);
            let dir = flight_dir(&self.root, &arrival.payload, &arrival.flight, arrival.run);
            self.open.insert(key.clone(), Segment::create(&dir, arrival.run)?);
        }
        self.turn += 1;
        let segment = self.open.get_mut(key).expect("inserted above when it was not there");
        segment.turn = self.turn;
        if arrival.channel.schema_name == "windhover.Health"
            && let Some(name) = dated_name(&arrival.data)
        {
            segment.rename_flight(&name)?;
        }
        segment.write(arrival)
    }

    /// Ends the payload's segment that was written to longest ago, where it has the most that may be open.
    fn make_room(&mut self, payload: &str) {
        let of_payload = || self.open.iter().filter(|((name, _), _)| name == payload);
        if of_payload().count() < OPEN {
            return;
        }
        let oldest = of_payload().min_by_key(|(_, segment)| segment.turn).map(|(key, _)| key.clone());
        let Some(key) = oldest else { return };
        match self.open.get_mut(&key).map(Segment::sync) {
            Some(Ok(numbers)) => {
                let (payload, run) = key.clone();
                self.done.push(OnDisk { payload, run, numbers });
            }
            Some(Err(error)) => self.fail(key.clone(), &error),
            None => {}
        }
        self.end(&key);
    }

    /// Ends a segment that was synced, if it is open. A segment without its end reads as one that was cut off, which
    /// readers accept.
    fn end(&mut self, key: &(String, u32)) {
        if let Some(Err(error)) = self.open.remove(key).map(Segment::finish) {
            self.trouble.get_or_insert(error.to_string());
        }
    }

    fn lose(&mut self, key: (String, u32), numbers: RangeSet) {
        if !numbers.is_empty() {
            self.lost.entry(key).or_default().union(&numbers);
        }
    }

    fn fail(&mut self, key: (String, u32), error: &MirrorError) {
        if let Some(segment) = self.open.remove(&key) {
            let lost = segment.give_up();
            self.lose(key, lost);
        }
        self.trouble.get_or_insert(error.to_string());
    }

    /// Writes everything through to the disk, ends segments that are long enough, and returns the results.
    pub fn sync(&mut self) -> Kept {
        let mut done = std::mem::take(&mut self.done);
        let keys: Vec<_> = self.open.keys().cloned().collect();
        for key in keys {
            let Some(segment) = self.open.get_mut(&key) else { continue };
            if segment.unsynced.is_empty() {
                continue;
            }
            let is_full = segment.bytes >= SEGMENT_BYTES;
            match segment.sync() {
                Ok(numbers) => {
                    let (payload, run) = key.clone();
                    done.push(OnDisk { payload, run, numbers });
                }
                Err(error) => self.fail(key.clone(), &error),
            }
            if is_full {
                self.end(&key);
            }
        }
        let lost = std::mem::take(&mut self.lost).into_iter();
        let lost = lost.map(|((payload, run), numbers)| OnDisk { payload, run, numbers }).collect();
        let (trouble, excess) = (self.trouble.take(), std::mem::take(&mut self.excess));
        Kept { done, lost, trouble, excess }
    }

    /// Ends every segment.
    pub fn finish(mut self) -> Kept {
        let mut kept = self.sync();
        for segment in std::mem::take(&mut self.open).into_values() {
            if let Err(error) = segment.finish() {
                kept.trouble.get_or_insert(error.to_string());
            }
        }
        kept
    }
}

/// The name that the payload gave its flight after it got the date, from its health messages.
fn dated_name(health: &[u8]) -> Option<String> {
    let health = wh::Health::decode(health).ok()?;
    let name = health.words.get(FLIGHT_WORD)?;
    // The name comes from another machine and becomes a directory here: only names of flights are accepted.
    (is_flight_name(name) && !name.starts_with(UNDATED)).then(|| name.clone())
}

pub(super) fn segments(dir: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut files: Vec<_> =
        entries.map(|entry| entry.path()).filter(|p| p.extension().is_some_and(|e| e == "mcap")).collect();
    files.sort();
    files
}

/// The directory of a run: the one that has it, whatever its present name; else one named after its flight, with -2,
/// -3, … where another run has that name.
fn flight_dir(root: &Path, payload: &str, flight: &str, run: u32) -> PathBuf {
    let payload = root.join(payload);
    let entries = std::fs::read_dir(&payload).into_iter().flatten().flatten();
    let has_run = |dir: &PathBuf| {
        let text = std::fs::read_to_string(dir.join(RUN_FILE));
        text.is_ok_and(|text| text.trim() == format!("{run:08x}"))
    };
    if let Some(dir) = entries.map(|entry| entry.path()).find(has_run) {
        return dir;
    }
    let names = std::iter::once(flight.to_owned()).chain((2..).map(|n| format!("{flight}-{n}")));
    let of_run = |dir: &PathBuf| match std::fs::read_to_string(dir.join(RUN_FILE)) {
        Ok(text) => text.trim() == format!("{run:08x}"),
        Err(_) => !dir.exists() || segments(dir).is_empty(),
    };
    let mut dirs = names.map(|name| payload.join(name));
    dirs.find(of_run).expect("some number is free")
}

/// Messages of a flight's directory, as far as they are on the disk: every whole chunk of a segment that is being
/// written or was cut off.
pub(super) fn messages(dir: &Path) -> impl Iterator<Item = RawMessage> {
    McapReader::open(dir).into_iter().flatten()
}

/// Numbers of a run in the files of earlier runs of the program.
pub fn recall(root: &Path, payload: &str, flight: &str, run: u32) -> RangeSet {
    let mut numbers = RangeSet::new();
    for message in messages(&flight_dir(root, payload, flight, run)) {
        numbers.insert(message.sequence);
    }
    numbers
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::io::link::Channel;
    use windhover_base::time::MonoTime;

    #[test]
    fn a_flight_gets_the_date_that_it_has_on_the_card() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        mirror.keep(&arrival(7, 0));
        // A name that is not a flight's does not become a directory, whoever sends it.
        for name in ["boot-1", "../../elsewhere", "20261118T150405Z"] {
            let words = [(FLIGHT_WORD.to_owned(), name.to_owned())].into();
            let data = wh::Health { words, ..Default::default() }.encode_to_vec();
            let channel = Channel {
                topic: "/health".into(),
                schema_name: "windhover.Health".into(),
                schema: Vec::new(),
            };
            let health = Arrival { channel: Arc::new(channel), data, ..arrival(7, 1) };
            mirror.keep(&health);
        }
        mirror.keep(&arrival(7, 2));
        mirror.finish();
        let names: Vec<_> = std::fs::read_dir(dir.path().join("alpha"))
            .expect("a directory")
            .map(|entry| entry.expect("an entry").file_name())
            .collect();
        assert_eq!(names, ["20261118T150405Z"]);
        // The payload keeps using the name with which it began.
        assert_eq!(recall(dir.path(), "alpha", "boot-1", 7).len(), 3);
        let mut again = Mirror::at(dir.path()).expect("a mirror");
        again.keep(&arrival(7, 3));
        again.finish();
        assert_eq!(segments(&dir.path().join("alpha/20261118T150405Z")).len(), 2);
    }

    fn arrival(run: u32, number: u32) -> Arrival {
        Arrival {
            payload: "alpha".into(),
            run,
            flight: "boot-1".into(),
            number,
            channel: Arc::new(Channel {
                topic: "/target/ugv/state".into(),
                schema_name: "windhover.TargetState".into(),
                schema: Vec::new(),
            }),
            log_time: MonoTime::from_ns(i64::from(number) * 1_000_000),
            publish_time: MonoTime::from_ns(i64::from(number) * 1_000_000),
            data: vec![8, 1],
            live: true,
            arrived: tokio::time::Instant::now(),
        }
    }

    #[test]
    fn what_was_synced_is_known_after_a_restart_even_without_an_end() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        for number in [0, 1, 2, 5] {
            mirror.keep(&arrival(7, number));
        }
        let done = mirror.sync().done;
        assert_eq!(done[0].numbers.iter().collect::<Vec<_>>(), [(0, 3), (5, 6)]);
        mirror.keep(&arrival(7, 9));
        // As after a kill: neither the end nor what was not synced is there.
        std::mem::forget(mirror);
        let known = recall(dir.path(), "alpha", "boot-1", 7);
        assert_eq!(known.iter().collect::<Vec<_>>(), [(0, 3), (5, 6)]);
        let mut again = Mirror::at(dir.path()).expect("a mirror");
        again.keep(&arrival(7, 3));
        again.finish();
        assert_eq!(recall(dir.path(), "alpha", "boot-1", 7).len(), 5);
        assert_eq!(segments(&dir.path().join("alpha/boot-1")).len(), 2);
    }

    #[test]
    fn another_run_of_the_same_name_gets_a_directory_of_its_own() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        mirror.keep(&arrival(1, 0));
        mirror.keep(&arrival(2, 0));
        mirror.finish();
        assert!(dir.path().join("alpha/boot-1-2/000000.mcap").exists());
        assert!(recall(dir.path(), "alpha", "boot-1", 3).is_empty());
        assert_eq!(recall(dir.path(), "alpha", "boot-1", 2).len(), 1);
    }

    #[test]
    fn a_payload_with_a_thousand_runs_has_few_files_open_and_all_is_kept() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        for run in 0..40 {
            mirror.keep(&arrival(run, 0));
            assert!(mirror.open.len() <= OPEN);
        }
        let kept = mirror.sync();
        assert_eq!((kept.done.len(), kept.lost.len(), kept.trouble), (40, 0, None));
        assert_eq!(recall(dir.path(), "alpha", "boot-1", 7).len(), 1);
    }

    #[test]
    fn a_disk_that_fails_loses_nothing_silently_and_is_tried_again() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        // Given a file where the payload's directory belongs.
        std::fs::write(dir.path().join("alpha"), "in the way").expect("written");
        mirror.keep(&arrival(7, 3));
        mirror.keep(&arrival(7, 4));
        let kept = mirror.sync();
        // Then what came is reported as lost, with the reason, once for each sync.
        assert!(kept.done.is_empty() && kept.trouble.is_some_and(|why| why.contains("alpha")));
        assert_eq!(kept.lost[0].numbers.iter().collect::<Vec<_>>(), [(3, 5)]);
        // When the disk works again, then so does the mirror.
        std::fs::remove_file(dir.path().join("alpha")).expect("removed");
        mirror.keep(&arrival(7, 3));
        let kept = mirror.sync();
        assert_eq!((kept.done.len(), kept.lost.len(), kept.trouble), (1, 0, None));
    }

    #[test]
    fn files_removed_under_the_station_are_reported_and_begun_anew() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        mirror.keep(&arrival(7, 0));
        assert_eq!(mirror.sync().done.len(), 1);
        std::fs::remove_dir_all(dir.path().join("alpha")).expect("removed");
        mirror.keep(&arrival(7, 1));
        let kept = mirror.sync();
        assert!(kept.done.is_empty() && kept.trouble.is_some_and(|why| why.contains("removed")));
        assert_eq!(kept.lost[0].numbers.iter().collect::<Vec<_>>(), [(0, 2)], "the content from before");
        mirror.keep(&arrival(7, 0));
        assert_eq!((mirror.sync().done.len(), recall(dir.path(), "alpha", "boot-1", 7).len()), (1, 1));
    }

    #[test]
    fn channels_without_end_are_that_payloads_trouble_alone() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        for number in 0..3_000 {
            let channel = Channel {
                topic: format!("/made/up/{number}"),
                schema_name: "x.Y".into(),
                schema: vec![0; 100],
            };
            mirror.keep(&Arrival { channel: Arc::new(channel), ..arrival(7, number) });
        }
        mirror.keep(&Arrival { payload: "beta".into(), ..arrival(9, 0) });
        let kept = mirror.sync();
        assert_eq!(kept.excess.keys().collect::<Vec<_>>(), ["alpha"]);
        assert_eq!((kept.done.len(), kept.trouble), (2, None));
    }
}
