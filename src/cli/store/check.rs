//! `windhover store verify`, `repair` and `rebuild`.

use std::path::Path;

use crate::cli::out::outln;
use crate::cli::{CliError, CliResult};
use crate::io::store::flight::{self, FLIGHTS};
use crate::io::store::index::{INDEX, Index, IndexError};
use crate::io::store::inspect;
use crate::io::store::keeper::{describe, settle_flight};
use crate::io::store::rebuild;
use crate::io::store::scan::SegmentFile;
use crate::io::store::seal::{Condition, condition};
use crate::io::store::volume::Volume;
use crate::text::counted;

/// The findings: errors, and what the daemon completes at its next start (after a kill or a power cut; nothing is
/// lost).
#[derive(Default)]
struct Found {
    wrong: usize,
    unfinished: usize,
}

impl Found {
    fn wrong(&mut self, line: &str) -> CliResult {
        self.wrong += 1;
        Ok(outln!("{line}")?)
    }

    fn unfinished(&mut self, line: &str) -> CliResult {
        self.unfinished += 1;
        Ok(outln!("{line}")?)
    }
}

/// Reads every byte of the flights; reports errors; compares with the index where `all` flights are read and no process
/// has the index open. `called` is the command line of `store`, for advice.
pub(super) fn verify(root: &Path, names: &[String], all: bool, called: &str) -> CliResult {
    let present = inspect::in_the_air(root)?;
    let mut found = Found::default();
    let mut segments = 0;
    for name in names.iter().filter(|name| Some(*name) != present.as_ref()) {
        segments += verify_flight(root, name, &mut found)?;
    }
    if all {
        verify_index(root, called, &mut found)?;
    }
    let (segments, flights) = (counted(segments, "segment"), counted(names.len(), "flight"));
    let Found { wrong, unfinished } = found;
    outln!("{segments} of {flights} read, {} wrong", counted(wrong, "thing"))?;
    if unfinished > 0 {
        let things = counted(unfinished, "thing");
        outln!(
            "{things} unfinished, without loss: completed by the daemon at its next start, or by `{called} repair`"
        )?;
    }
    if wrong == 0 {
        return Ok(());
    }
    Err(CliError::failed(format!(
        "the store has errors; `{called} repair` and `{called} rebuild` correct them"
    )))
}

/// Reads a flight's segments; returns their number.
fn verify_flight(root: &Path, name: &str, found: &mut Found) -> Result<usize, CliError> {
    let dir = root.join(FLIGHTS).join(name);
    let is_closed = dir.join(flight::FLIGHT_FILE).exists();
    let segments = flight::segment_names(&dir);
    for segment_name in &segments {
        let segment = SegmentFile::open(&dir.join(segment_name))?;
        match condition(&segment) {
            Condition::Whole => {}
            Condition::Damaged => found.wrong(&format!("{name}/{segment_name}: is damaged"))?,
            // A flight is closed when all its segments are.
            Condition::CutOff { .. } if is_closed => {
                found.wrong(&format!("{name}/{segment_name}: is not sealed"))?;
            }
            Condition::CutOff { chunks, cut_bytes } => {
                let (chunks, cut) = (counted(chunks, "chunk"), counted(cut_bytes, "byte"));
                let words =
                    format!("was cut off; {chunks} complete, {cut} after them were never acknowledged");
                found.unfinished(&format!("{name}/{segment_name}: {words}"))?;
            }
        }
    }
    if !is_closed {
        found.unfinished(&format!("{name}: not closed"))?;
    }
    Ok(segments.len())
}

fn verify_index(root: &Path, called: &str, found: &mut Found) -> CliResult {
    let dir = root.join(INDEX);
    if !dir.exists() {
        return found.unfinished(&format!("there is no index; the daemon makes it, or `{called} rebuild`"));
    }
    if inspect::is_recording(root) {
        return Ok(outln!("the daemon has the index; it was not compared")?);
    }
    match Index::open(&dir) {
        Ok(index) => rebuild::differences(root, &index)?.into_iter().try_for_each(|difference| {
            let line = format!("index: {difference}");
            if difference.is_finished_at_start() { found.unfinished(&line) } else { found.wrong(&line) }
        }),
        Err(IndexError::InUse { .. }) => Ok(outln!("the daemon has the index; it was not compared")?),
        Err(error) => found.wrong(&error.to_string()),
    }
}

/// Seals incomplete segments.
pub(super) fn repair(root: &Path, names: &[String]) -> CliResult {
    let present = inspect::in_the_air(root)?;
    let volume = Volume::new(root);
    if present.is_none() {
        flight::sweep(&volume)?;
    }
    let mut mended = 0;
    for name in names.iter().filter(|name| Some(*name) != present.as_ref()) {
        let mut done = Vec::new();
        let left = settle_flight(&volume, name, true, |segment, sealing| {
            done.push(format!("{segment}: {}", describe(sealing)));
        })?;
        mended += done.len();
        done.iter().try_for_each(|line| outln!("{line}"))?;
        if left.is_none() {
            outln!("{name}: was empty and was removed")?;
        }
    }
    outln!("{} mended", counted(mended, "segment"))?;
    Ok(())
}

/// Rebuilds the index. The new one is made beside the old and replaces it when it is complete.
pub(super) fn rebuild(root: &Path) -> CliResult {
    if inspect::is_recording(root) {
        return Err(CliError::failed(
            "the daemon records to this store and maintains its index; stop it first",
        ));
    }
    let (dir, fresh) = (root.join(INDEX), root.join("index.new"));
    if dir.exists() && matches!(Index::open(&dir), Err(IndexError::InUse { .. })) {
        return Err(CliError::failed(format!("{} is in use; stop the daemon first", dir.display())));
    }
    if fresh.exists() {
        std::fs::remove_dir_all(&fresh)?;
    }
    let index = Index::open(&fresh)?;
    let (mut flights, _) = inspect::list(root)?;
    flights.reverse();
    let mut room = crate::config::StoreConfig::default().backfill_records;
    for info in &flights {
        let queued = rebuild::index_flight(root, &info.name, &index, room)?;
        room = room.saturating_sub(queued);
    }
    drop(index);
    if dir.exists() {
        std::fs::remove_dir_all(&dir)?;
    }
    std::fs::rename(&fresh, &dir)?;
    Volume::new(root).sync_dir("")?;
    outln!("index of {} rebuilt", counted(flights.len(), "flight"))?;
    Ok(())
}
