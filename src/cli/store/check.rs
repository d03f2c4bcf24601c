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
use crate::io::store::volume::Volume;
use crate::text::counted;

/// Reads every byte of the flights; says what is wrong; compares with the index where `all` are
/// looked at and nobody else has it open. `called` is how `store` was called, for advice.
pub(super) fn verify(root: &Path, names: &[String], all: bool, called: &str) -> CliResult {
    let present = inspect::in_the_air(root)?;
    let mut wrong = 0;
    let mut segments = 0;
    for name in names.iter().filter(|name| Some(*name) != present.as_ref()) {
        let dir = root.join(FLIGHTS).join(name);
        for segment_name in flight::segment_names(&dir) {
            segments += 1;
            let segment = SegmentFile::open(&dir.join(&segment_name))?;
            let fault = match segment.sealed() {
                None => Some("is not sealed"),
                Some(sealed) => (!segment.agrees(&sealed, &segment.salvage())).then_some("is damaged"),
            };
            if let Some(fault) = fault {
                wrong += 1;
                outln!("{name}/{segment_name}: {fault}")?;
            }
        }
        if !dir.join(flight::FLIGHT_FILE).exists() {
            wrong += 1;
            outln!("{name}: not closed")?;
        }
    }
    if all {
        wrong += verify_index(root, called)?;
    }
    let (segments, flights) = (counted(segments, "segment"), counted(names.len(), "flight"));
    outln!("{segments} of {flights} read, {} wrong", counted(wrong, "thing"))?;
    if wrong == 0 {
        return Ok(());
    }
    Err(CliError::failed(format!("the store is not whole; `{called} repair` and `{called} rebuild` mend it")))
}

fn verify_index(root: &Path, called: &str) -> Result<usize, CliError> {
    let dir = root.join(INDEX);
    if !dir.exists() {
        outln!("no index; the daemon makes it, or `{called} rebuild`")?;
        return Ok(1);
    }
    if inspect::is_recording(root) {
        outln!("the daemon has the index; it was not compared")?;
        return Ok(0);
    }
    match Index::open(&dir) {
        Ok(index) => {
            let told = rebuild::differences(root, &index)?;
            told.iter().try_for_each(|line| outln!("index: {line}"))?;
            Ok(told.len())
        }
        Err(IndexError::InUse { .. }) => {
            outln!("the daemon has the index; it was not compared")?;
            Ok(0)
        }
        Err(error) => {
            outln!("{error}")?;
            Ok(1)
        }
    }
}

/// Seals what is not whole.
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
            outln!("{name}: held nothing and was removed")?;
        }
    }
    outln!("{} mended", counted(mended, "segment"))?;
    Ok(())
}

/// Makes the index again. The new one is made beside the old and takes its place when it is whole.
pub(super) fn rebuild(root: &Path) -> CliResult {
    if inspect::is_recording(root) {
        return Err(CliError::failed(
            "the daemon records to this store and mends its index itself; stop it first",
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
    outln!("index of {} made again", counted(flights.len(), "flight"))?;
    Ok(())
}
