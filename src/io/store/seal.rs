//! Sealing: a segment that lacks its end, or has holes, becomes one that every reader opens, with
//! every whole chunk kept.

use std::collections::{BTreeMap, BTreeSet};

use super::record::Definitions;
use super::scan::{Salvage, SegmentFile};
use super::segment::{Head, PAGE, put_head};
use super::summary::{PlacedChunk, Summary};
use super::volume::{StoreResult, Volume};
use super::{flight, format};

/// What sealing did.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Sealing {
    /// It was whole already.
    Whole,
    /// Its end was missing and was written behind the last whole chunk.
    Closed {
        /// Chunks kept.
        chunks: usize,
        /// Bytes behind them that were no whole chunk.
        cut_bytes: u64,
    },
    /// It had holes and was written anew.
    Rewritten {
        /// Chunks kept.
        chunks: usize,
        /// Bytes given up.
        lost_bytes: u64,
    },
    /// It held no whole chunk and was removed.
    Removed,
}

/// How a segment lies on the card.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Condition {
    /// Sealed, and as its seal says.
    Whole,
    /// Without its end, and whole up to there: what a kill or a power cut leaves.
    CutOff {
        /// Whole chunks.
        chunks: usize,
        /// Bytes behind them.
        cut_bytes: usize,
    },
    /// Otherwise than it was written.
    Damaged,
}

/// Looks at a segment, every byte of it.
pub fn condition(segment: &SegmentFile) -> Condition {
    let salvage = segment.salvage();
    if let Some(sealed) = segment.sealed() {
        return if segment.agrees(&sealed, &salvage) { Condition::Whole } else { Condition::Damaged };
    }
    let chunks = salvage.chunks.len();
    let end = salvage.last_commit_end.unwrap_or(salvage.chunks_end);
    let cut_bytes = usize::try_from(salvage.length.saturating_sub(end)).unwrap_or(usize::MAX);
    let is_whole = salvage.head_whole
        && salvage.config.is_some()
        && salvage.metadata.is_some()
        && salvage.head_definitions.agrees_with(&salvage.definitions)
        && salvage.contiguous;
    // The head alone was still being written where there is no chunk.
    if is_whole || chunks == 0 { Condition::CutOff { chunks, cut_bytes } } else { Condition::Damaged }
}

/// Seals one segment of a flight directory. `deep` also reads every chunk of one that looks whole.
pub fn seal_segment(volume: &Volume, dir: &str, name: &str, deep: bool) -> StoreResult<Sealing> {
    let path = format!("{dir}/{name}");
    let segment = SegmentFile::open(&volume.path(&path))?;
    let sealed = segment.sealed();
    if sealed.is_some() && !deep {
        return Ok(Sealing::Whole);
    }
    let mut salvage = segment.salvage();
    if let Some(sealed) = sealed {
        if segment.agrees(&sealed, &salvage) {
            return Ok(Sealing::Whole);
        }
        // The summary has a checksum, the head has none.
        let found = std::mem::replace(&mut salvage.definitions, sealed.definitions);
        salvage.definitions.complete_from(&found);
    }
    if salvage.chunks.is_empty() {
        volume.remove_file(&path)?;
        volume.sync_dir(dir)?;
        return Ok(Sealing::Removed);
    }
    let missing =
        |d: &Definitions| salvage.chunks.iter().flat_map(|c| c.messages.keys()).any(|id| !d.has(*id));
    if missing(&salvage.definitions) || salvage.config.is_none() || salvage.metadata.is_none() {
        complete_from_neighbours(volume, dir, name, &mut salvage);
    }
    let invented = invent_missing(&mut salvage);
    let head_holds = salvage.head_whole && salvage.head_definitions.agrees_with(&salvage.definitions);
    if head_holds && salvage.contiguous && !invented {
        close_in_place(volume, &path, &salvage)
    } else {
        rewrite(volume, dir, name, &segment, &salvage)
    }
}

/// Numbers are one flight's, so a lost head is found again in the segments beside it.
fn complete_from_neighbours(volume: &Volume, dir: &str, name: &str, salvage: &mut Salvage) {
    for other in flight::segment_names(&volume.path(dir)).iter().filter(|other| *other != name) {
        let Ok(file) = SegmentFile::open(&volume.path(&format!("{dir}/{other}"))) else { continue };
        let head = file.salvage_head_only();
        salvage.definitions.complete_from(&head.head_definitions);
        salvage.config = salvage.config.take().or(head.config);
        salvage.metadata = salvage.metadata.take().or(head.metadata);
        if let Some(sealed) = file.sealed() {
            salvage.definitions.complete_from(&sealed.definitions);
        }
    }
}

/// Messages of a channel nobody defines any more are kept under a topic of their own, so that no
/// reader stumbles over them.
fn invent_missing(salvage: &mut Salvage) -> bool {
    let used: BTreeSet<u16> = salvage.chunks.iter().flat_map(|c| c.messages.keys().copied()).collect();
    let missing: Vec<u16> = used.into_iter().filter(|id| !salvage.definitions.has(*id)).collect();
    for id in &missing {
        let channel = mcap::records::Channel {
            id: *id,
            schema_id: 0,
            topic: format!("/unknown/{id}"),
            message_encoding: String::new(),
            metadata: BTreeMap::new(),
        };
        salvage.definitions.channels.entry(*id).or_insert(channel).schema_id = 0;
    }
    !missing.is_empty()
}

fn close_in_place(volume: &Volume, path: &str, salvage: &Salvage) -> StoreResult<Sealing> {
    let mut summary = salvage.head.clone();
    let (last, earlier) = salvage.chunks.split_last().expect("a segment without chunks is removed");
    for chunk in earlier {
        summary.chunk(&mut Vec::new(), chunk.offset + chunk.length, chunk);
    }
    // What was acknowledged ends on a page and is not touched again. Where the last commit is not
    // whole it was not acknowledged; its chunk is, so its indexes are written again.
    let mut out = Vec::new();
    let end = match salvage.last_commit_end {
        Some(end) => {
            summary.chunk(&mut Vec::new(), last.offset + last.length, last);
            end
        }
        None => {
            summary.chunk(&mut out, salvage.chunks_end, last);
            format::pad_to_page(&mut out, salvage.chunks_end, PAGE);
            salvage.chunks_end
        }
    };
    summary.put_end(&mut out, end, &salvage.definitions);
    let mut file = volume.reopen(path, end)?;
    file.append(&out)?;
    file.sync()?;
    Ok(Sealing::Closed { chunks: salvage.chunks.len(), cut_bytes: salvage.length.saturating_sub(end) })
}

fn head_of(salvage: &Salvage) -> Head {
    Head {
        config: salvage.config.clone().unwrap_or_default(),
        metadata: salvage
            .metadata
            .clone()
            .unwrap_or_else(|| BTreeMap::from([("lost".into(), "head".into())])),
        time_ns: salvage.chunks.first().map_or(0, |c| c.header.message_start_time),
    }
}

fn rewrite(
    volume: &Volume,
    dir: &str,
    name: &str,
    segment: &SegmentFile,
    salvage: &Salvage,
) -> StoreResult<Sealing> {
    let temporary = format!("{dir}/{name}.repair");
    volume.remove_file(&temporary)?;
    let mut file = volume.create(&temporary)?;
    let mut summary = Summary::default();
    let mut out = Vec::new();
    put_head(&mut out, &mut summary, &head_of(salvage), &salvage.definitions);
    file.append(&out)?;
    let mut kept = 0;
    for chunk in &salvage.chunks {
        let mut out = segment.copy_out(chunk.offset, chunk.length)?;
        let placed = PlacedChunk { offset: file.len(), ..chunk.clone() };
        let start = file.len();
        summary.chunk(&mut out, start, &placed);
        format::pad_to_page(&mut out, start, PAGE);
        file.append(&out)?;
        kept += chunk.length;
    }
    let mut end = Vec::new();
    summary.put_end(&mut end, file.len(), &salvage.definitions);
    file.append(&end)?;
    file.sync()?;
    volume.replace(&temporary, &format!("{dir}/{name}"))?;
    volume.sync_dir(dir)?;
    Ok(Sealing::Rewritten { chunks: salvage.chunks.len(), lost_bytes: salvage.length.saturating_sub(kept) })
}
